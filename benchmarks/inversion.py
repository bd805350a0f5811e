"""What of an image comes back from what a camera place reveals: an attack on keypoints and 256-bit codes.

    FCSLAM_DATA=/path/to/data python benchmarks/inversion.py --fleet FLEET

The attacker has the packets, the network, and photographs of elsewhere (BSDS500 and COCO), and is even told each
keypoint's pixel, which a place does not say: it holds metric positions. For every code a patch of 48 x 48 pixels is
made and blended in at its keypoint; what no patch covers becomes the mean grey of the photographs. Two ways to a
patch: that of the photographs' keypoint with the nearest code, and ridge regression from the bits to pixels, fitted
to the photographs. Nothing is trained beyond that; a deep network could be expected to bring back more.

Targets: frames of IE tower (four floors) and images of FLEET, which `fcslam tools simulate` recorded, at 320 x 240.
PSNR and SSIM are against the true image, over all pixels and over those within a patch. "Baseline" is a grey image of
the photographs' mean; "told the mean" one of the target's own mean, which the attacker does not know. Recognised: the
true image is, of all targets of its kind, the one whose picture of 32 x 24 pixels correlates most with that of the
reconstruction; chance is one in so many.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import common
import cv2
import numpy as np
from numpy.typing import NDArray

from fcslam.features.classical import make_detector
from fcslam.features.detector import FeatureDetector, GreyImage, OnnxConfig, decode_grey
from fcslam.learning.images import find_images, read_image
from fcslam.mission.mission import MissionConfig
from fcslam.records import CameraImage
from fcslam.sources import open_source

SIZE = (320, 240)
HALF = 24
RIDGE = 50.0
SHOWN = 4
THUMBNAIL = (32, 24)
PHOTOGRAPHS = ("bsds500/train", "coco_subset/train2017")
FLOORS = ("floor3", "floor6", "floor9", "floor20")
COLUMNS = {"targets": "", "attack": "", "images": "", "keypoints": ".0f", "covered": ".0%", "PSNR, dB": ".2f",
           "SSIM": ".3f", "PSNR in patches": ".2f", "SSIM in patches": ".3f", "recognised": ".0%",
           "chance": ".0%"}  # fmt: skip

T = TypeVar("T")
Image = NDArray[np.float32]
Inverter = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Bits as +1 and -1 (N, 256) to patches (N, 48, 48)."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One image as the attacker knows it, and the image."""

    image: Image
    keypoints_px: NDArray[np.float32]
    signs: NDArray[np.float32]
    """Bits as +1 and -1, shape (N, 256)."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--fleet", type=Path, required=True, help="a folder that `fcslam tools simulate` recorded")
    parser.add_argument("--photographs", type=int, default=150, help="that the attacker has, of each collection")
    parser.add_argument("--targets", type=int, default=40, help="images of each kind")
    chosen = parser.parse_args()
    folder = common.recordings(*PHOTOGRAPHS, *(f"ie_tower/{floor}" for floor in FLOORS), kind="vision")
    report = common.Report(__file__, __doc__, chosen)
    views = MissionConfig().robot.views
    detector = make_detector(views.detector, OnnxConfig(weights=views.weights))
    known = [seen for name in PHOTOGRAPHS for seen in look(pictures([folder / name], chosen.photographs), detector)]
    grey = float(np.mean([seen.image.mean() for seen in known]))
    attacks = {"nearest code": nearest_code(known), "regression": regression(known)}
    targets = {
        "IE tower": list(look(pictures([folder / "ie_tower" / floor for floor in FLOORS], chosen.targets), detector)),
        "simulated": list(look(seen_by(sorted(chosen.fleet.glob("robot_*")), chosen.targets), detector)),
    }
    rows = []
    for name, seen in targets.items():
        made = {attack: [rebuild(one, invert, grey) for one in seen] for attack, invert in attacks.items()}
        made["baseline"] = [(np.full_like(one.image, grey), made["regression"][k][1]) for k, one in enumerate(seen)]
        told = [(np.full_like(one.image, one.image.mean()), made["regression"][k][1]) for k, one in enumerate(seen)]
        made["told the mean"] = told
        rows += [row(name, attack, seen, results) for attack, results in made.items()]
    report.say(f"{sum(len(seen.signs) for seen in known):,} keypoints of {len(known)} photographs.")
    report.table("Reconstructions", COLUMNS, rows)
    few = targets["simulated"][:: max(1, len(targets["simulated"]) // SHOWN)][:SHOWN]
    report.picture(
        "Simulated images and what regression brings back",
        draw([(seen.image, rebuild(seen, attacks["regression"], grey)[0]) for seen in few]),
    )
    report.write()


def pictures(folders: Sequence[Path], most: int) -> Iterator[GreyImage | None]:
    """Evenly spread images of all folders together."""
    return (read_image(file.path) for file in spread(find_images(folders), most))


def seen_by(robots: Sequence[Path], most: int) -> Iterator[GreyImage | None]:
    """Evenly spread images of all recordings together."""
    records = (record for robot in robots for record in open_source(robot).records())
    images = [record.encoded for record in records if isinstance(record, CameraImage)]
    return map(decode_grey, spread(images, most))


def spread(values: Sequence[T], most: int) -> Sequence[T]:
    return values[:: max(1, len(values) // most)][:most]


def look(images: Iterable[GreyImage | None], detector: FeatureDetector) -> Iterator[Seen]:
    """Images as a robot's camera gives them, with what is detected in them."""
    for image in images:
        if image is None:
            continue
        picture = np.asarray(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA), np.uint8)
        features = detector.detect(picture)
        if len(features.descriptors):
            signs = 2.0 * np.unpackbits(features.descriptors, axis=1).astype(np.float32) - 1.0
            yield Seen(picture.astype(np.float32), features.keypoints_px, signs)


def patches(seen: Seen) -> NDArray[np.float32]:
    """The image around each keypoint, mirrored at its edges, shape (N, 48, 48)."""
    padded = cv2.copyMakeBorder(seen.image, HALF, HALF, HALF, HALF, cv2.BORDER_REFLECT)
    corners = np.rint(seen.keypoints_px).astype(int)
    return np.stack([padded[v : v + 2 * HALF, u : u + 2 * HALF] for u, v in corners])


def nearest_code(known: Sequence[Seen]) -> Inverter:
    signs = np.concatenate([seen.signs for seen in known])
    content = np.concatenate([patches(seen).astype(np.uint8) for seen in known])
    return lambda bits: content[np.argmax(bits @ signs.T, axis=1)].astype(np.float32)


def regression(known: Sequence[Seen]) -> Inverter:
    """Least squares from the bits and a constant to all pixels of the patch, with a small penalty."""
    width = 1 + known[0].signs.shape[1]
    squares, products = RIDGE * np.eye(width), np.zeros((width, 4 * HALF * HALF))
    for seen in known:
        inputs = np.column_stack((np.ones(len(seen.signs)), seen.signs)).astype(np.float64)
        squares += inputs.T @ inputs
        products += inputs.T @ patches(seen).reshape(len(inputs), -1)
    weights = np.linalg.solve(squares, products).astype(np.float32)
    return lambda bits: (weights[0] + bits @ weights[1:]).reshape(-1, 2 * HALF, 2 * HALF)


def rebuild(seen: Seen, invert: Inverter, grey: float) -> tuple[Image, NDArray[np.bool_]]:
    """The attacker's picture, and which of its pixels lie in a patch."""
    offsets = np.arange(2 * HALF) - HALF + 0.5
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2.0 * (HALF / 3.0) ** 2)).astype(np.float32)
    shape = (SIZE[1] + 2 * HALF, SIZE[0] + 2 * HALF)
    total, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    corners = np.rint(seen.keypoints_px).astype(int)
    for (u, v), patch in zip(corners, invert(seen.signs), strict=True):
        total[v : v + 2 * HALF, u : u + 2 * HALF] += window * patch
        weight[v : v + 2 * HALF, u : u + 2 * HALF] += window
    total, weight = (part[HALF:-HALF, HALF:-HALF] for part in (total, weight))
    floor = 0.02  # where hardly a patch reaches, the picture fades to grey
    return np.clip((total + floor * grey) / (weight + floor), 0.0, 255.0), weight > floor


def row(name: str, attack: str, seen: Sequence[Seen], made: Sequence[tuple[Image, NDArray[np.bool_]]]) -> tuple:
    quality = []
    for one, (picture, covered) in zip(seen, made, strict=True):
        error, likeness = (one.image - picture) ** 2, structural_similarity(one.image, picture)
        whole = (psnr(error), likeness.mean())
        quality.append((len(one.signs), covered.mean(), *whole, psnr(error[covered]), likeness[covered].mean()))
    truth = thumbnails([one.image for one in seen])
    found = np.argmax(thumbnails([picture for picture, _ in made]) @ truth.T, axis=1) == np.arange(len(seen))
    known = attack in ("nearest code", "regression")
    return name, attack, len(seen), *np.mean(quality, axis=0), found.mean() if known else np.nan, 1.0 / len(seen)


def psnr(squared_error: NDArray[np.float32]) -> float:
    return float(10.0 * np.log10(255.0**2 / squared_error.mean()))


def structural_similarity(a: Image, b: Image) -> Image:
    """SSIM of each pixel (Wang et al. 2004): Gaussian windows with a standard deviation of 1.5 pixels."""

    def mean(image: Image) -> Image:
        return np.asarray(cv2.GaussianBlur(image, (11, 11), 1.5), np.float32)

    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    level, contrast = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2
    luminance = (2.0 * mean_a * mean_b + level) / (mean_a**2 + mean_b**2 + level)
    return luminance * (2.0 * covariance + contrast) / (variance_a + variance_b + contrast)


def thumbnails(images: Sequence[Image]) -> NDArray[np.float64]:
    """Small pictures without mean and of length 1, shape (N, 768)."""
    small = np.stack([cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA).ravel() for image in images])
    level = small - small.mean(axis=1, keepdims=True)
    return level / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)


def draw(pairs: Sequence[tuple[Image, Image]]) -> Any:
    """Above the true images, below the attacker's; of photographs that are not ours nothing is shown."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.6 * len(pairs), 4.2))
    for column, axes in zip(pairs, figure.subplots(2, len(pairs)).T, strict=True):
        for one, image in zip(axes, column, strict=True):
            one.imshow(image, cmap="gray", vmin=0, vmax=255)
            one.axis("off")
    figure.subplots_adjust(wspace=0.03, hspace=0.03)
    return figure


if __name__ == "__main__":
    main()
