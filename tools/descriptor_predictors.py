"""Fits the weights by which the wire expects a descriptor's bits: `src/fcslam/wire/predictors/CHANNEL.npy`.

    python tools/descriptor_predictors.py RECORDINGS... --images FOLDERS... --output src/fcslam/wire/predictors

Needs torch, which what is fitted never does. Places are what robots with default settings would send of RECORDINGS
(`LOG` or `LOG:PARTS`, cut into so many robots); photographs in FOLDERS stand for camera places whose keypoints all lie
at one distance. The weights belong to the format: new ones make a new version of it. Of every tenth place nothing is
learnt; the bytes of a descriptor that are printed are those of these places.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.features.classical import make_detector
from fcslam.learning.images import find_images, read_image
from fcslam.mission.mission import MissionConfig
from fcslam.records import Channel, Codes, Place
from fcslam.robot.frontend import RobotFrontend
from fcslam.sources import open_source, split
from fcslam.wire.prediction import BIAS_UNIT, WEIGHT_UNIT, nearest_before
from fcslam.wire.quantisation import quantise_keypoints
from fcslam.wire.streams import ascending

BITS = 256
BATCH = 512
STEPS = 2000
PIXEL_M = 0.01
DISTANCE_M = 3.0
HELD_OUT = 10

Pairs = NDArray[np.uint8]
"""Bits of descriptors and of those at the nearest keypoint before, shape (N, 2, 256)."""


def main() -> None:
    """Read the arguments, gather places and write one file a channel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--images", type=Path, nargs="*", default=[])
    parser.add_argument("--most-images", type=int, default=400, help="of each folder, evenly spread")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    torch.manual_seed(0)
    gathered: dict[Channel, list[Pairs]] = {channel: [] for channel in Channel}
    for name in arguments.recordings:
        for place in places_of(name):
            gathered[place.channel].append(pairs_of(quantise_keypoints(place.keypoints), place.descriptors))
        print(name, {str(channel): len(places) for channel, places in gathered.items()}, flush=True)
    for folder in arguments.images:
        gathered[Channel.CAMERA] += photographs(folder, arguments.most_images)
        print(folder, len(gathered[Channel.CAMERA]), flush=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    for channel, places in gathered.items():
        if places:
            np.save(arguments.output / f"{channel}.npy", fit(channel, places))


def places_of(name: str) -> Iterator[Place]:
    """What robots would send of one recording."""
    path, _, parts = name.partition(":")
    source = open_source(Path(path))
    config = MissionConfig()
    for part in split(source, int(parts)) if parts else [source]:
        robot = RobotFrontend(part.name, config.robot)
        packets = (packet for record in part.records() for packet in robot.process(record))
        yield from (packet.body for packet in packets if isinstance(packet.body, Place))
        yield from (packet.body for packet in robot.finish() if isinstance(packet.body, Place))


def photographs(folder: Path, most: int) -> Iterator[Pairs]:
    """Photographs as a camera would show them that looks along x."""
    views = MissionConfig().robot.views
    detector = make_detector(views.detector, views.orb, views.onnx)
    files = find_images([folder])
    for file in files[:: max(1, len(files) // most)]:
        image = read_image(file.path)
        if image is None:
            continue
        features = detector.detect(image)
        if len(features.descriptors):
            u, v = features.keypoints_px.T
            position = np.column_stack((np.full(len(u), DISTANCE_M), -PIXEL_M * u, -PIXEL_M * v))
            yield pairs_of(quantise_keypoints(position.astype(np.float32)), features.descriptors)


def pairs_of(keypoints: NDArray[np.int16], descriptors: Codes) -> Pairs:
    """Each descriptor of a place but the first, with its neighbour."""
    order = ascending(keypoints)
    sorted_keypoints, bits = keypoints[order].astype(np.int64), np.unpackbits(descriptors[order], axis=1)
    neighbours = [nearest_before(sorted_keypoints, i) for i in range(1, len(bits))]
    return np.stack((bits[1:], bits[neighbours]), axis=1)


def fit(channel: Channel, places: Sequence[Pairs]) -> NDArray[np.int8]:
    """Weights as they are stored: the bias, rows of `own`, rows of `neighbour`; shape (513, 256)."""
    learnt = torch.tensor(np.concatenate([p for k, p in enumerate(places) if k % HELD_OUT]))
    held_out = torch.tensor(np.concatenate(places[::HELD_OUT]))
    earlier = torch.triu(torch.ones(BITS, BITS), 1)
    mask = torch.cat((torch.ones(1, BITS), earlier, torch.ones(BITS, BITS)))
    weights = torch.zeros(1 + 2 * BITS, BITS, requires_grad=True)
    optimizer = torch.optim.Adam([weights], lr=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=STEPS)
    for _ in range(STEPS):
        loss = mean_bytes(weights * mask, learnt[torch.randint(len(learnt), (BATCH,))])
        optimizer.zero_grad()
        (loss + 1e-5 * weights.abs().sum()).backward()  # weights that tell little stay 0
        optimizer.step()
        schedule.step()
    units = torch.full((1 + 2 * BITS, 1), WEIGHT_UNIT)
    units[0] = BIAS_UNIT
    table = torch.clamp(torch.round(weights.detach() * mask / units), -127, 127)
    with torch.no_grad():
        size = mean_bytes(table * units, held_out)
    print(f"{channel}: {len(learnt)} descriptors learnt from, {len(held_out)} held out: {size:.2f} bytes each")
    stored: NDArray[np.int8] = table.numpy().astype(np.int8)
    return stored


def mean_bytes(weights: torch.Tensor, pairs: torch.Tensor) -> torch.Tensor:
    """What a descriptor costs by these weights."""
    signs = 2.0 * pairs.float() - 1.0
    z = weights[0] + signs.flatten(1) @ weights[1:]
    bits = torch.nn.functional.binary_cross_entropy_with_logits(z, pairs[:, 0].float(), reduction="none")
    return bits.sum(1).mean() / np.log(2.0) / 8.0


if __name__ == "__main__":
    main()
