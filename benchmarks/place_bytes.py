"""What coding ranges, keypoints and descriptors saves: bytes by kind of packet, plain and as they travel.

    FCSLAM_DATA=/path/to/data python benchmarks/place_bytes.py

Packets of two split logs, of the five runs of Wean Hall and of two simulated fleets with cameras (seeds 101 and 105; it
needs a GL library, or FLEETS that `fcslam tools simulate` recorded).
"Plain" is the same packet with 2 bytes a range, 2 a coordinate and 32 a descriptor; "deflated" is that with each of
the three fields deflated by zlib at level 9. "A place with 300 descriptors" is every place that has as many, cut to
its 300 strongest. Times are processor time of whole packets with all their checks.
"""

import tempfile
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
from convert_logs import readable

from fcslam.mission.mission import MissionConfig
from fcslam.records import PLACE_CHANNELS, Keyscan, Place
from fcslam.robot.frontend import RobotFrontend
from fcslam.sources import Source, open_source, split
from fcslam.wire import fcslam_pb2 as pb
from fcslam.wire.limits import KEYPOINT_AXES
from fcslam.wire.messages import Packet
from fcslam.wire.packets import Label, decode, encode, read_label
from fcslam.wire.quantisation import quantise, quantise_keypoints
from fcslam.wire.streams import ascending

LOGS = {"intel": 3, "mit-csail": 2}
WEAN_HALL = tuple(f"wean-hall/robotdata{number}.log.gz" for number in range(1, 6))
SEEDS = (101, 105)
STATED = 300
KINDS = {"recording": "", "kind": "", "packets": ",", "plain, B": ",", "deflated, B": ",", "sent, B": ",",
         "sent / plain": ".3f", "write, ms": ".2f", "read, ms": ".2f"}  # fmt: skip
RATES = {"recording": "", "robots": "", "plain, kB/s a robot": ".2f", "sent, kB/s a robot": ".2f"}
PARTS = {"recording": "", "channel": "", "places": "", "descriptors a place": ".0f", "keypoint, B": ".2f",
         "plain, B": ".0f", "descriptor, B": ".2f", "plain, B ": ".0f", "places with 300": "",
         "kB a place with 300": ".2f", "largest": ".2f", "plain, kB": ".2f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument(
        "--fleets", type=Path, nargs="+", default=[], help="recorded fleets, instead of simulating some"
    )
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files(), *WEAN_HALL)
    report = common.Report(__file__, __doc__, chosen)
    kinds, parts, rates = [], [], []
    with tempfile.TemporaryDirectory() as place:
        for name, sources in recordings(folder, chosen.fleets, Path(place)):
            packets = [packet for source in sources for packet in sent_by(source)]
            kinds += kind_rows(name, packets)
            parts += part_rows(name, packets)
            seconds = sum(source.survey().duration_s for source in sources)
            plain, sent = (sum(row[column] for row in kinds if row[0] == name) for column in (3, 5))
            rates.append((name, len(sources), plain / seconds / 1e3, sent / seconds / 1e3))
    report.table("By kind", KINDS, kinds)
    report.table("Uplink", RATES, rates)
    report.table("Places", PARTS, parts)
    report.write()


def recordings(folder: Path, fleets: Sequence[Path], place: Path) -> Iterator[tuple[str, list[Source]]]:
    """Names and robots; without ``fleets`` some are simulated into ``place``."""
    for name, robots in LOGS.items():
        yield name, split(open_source(common.log_path(folder, name)), robots)
    yield "wean-hall", [open_source(readable(folder / run)) for run in WEAN_HALL]
    for seed in SEEDS if not fleets else ():
        common.run_fcslam("tools", "simulate", "--robots", 3, "--seed", seed, "--output", place / f"seed-{seed}")
    for fleet in fleets or sorted(place.iterdir()):
        yield f"simulated, {fleet.name}", [open_source(robot) for robot in sorted(fleet.glob("robot_*"))]


def sent_by(source: Source) -> Iterator[Packet]:
    robot = RobotFrontend(source.name, MissionConfig().robot)
    for record in source.records():
        yield from robot.process(record)
    yield from robot.finish()


def kind_rows(name: str, packets: Sequence[Packet]) -> list[tuple]:
    groups: dict[Label, list[tuple]] = {}
    for packet in packets:
        began = time.process_time()
        data = encode(packet)
        written = time.process_time()
        decode(data)
        read = time.process_time()
        plain, deflated = plain_sizes(packet, data)
        label = read_label(data)._replace(robot="")
        groups.setdefault(label, []).append((plain, deflated, len(data), written - began, read - written))
    rows = []
    for label, sizes in groups.items():
        plain, deflated, sent, *_ = (int(column) for column in np.sum(sizes, axis=0))
        write_ms, read_ms = 1e3 * np.mean(sizes, axis=0)[3:]
        kind = label.kind if label.channel is None else f"{label.channel} {label.kind}"
        rows.append((name, str(kind), len(sizes), plain, deflated, sent, sent / plain, write_ms, read_ms))
    return rows


def plain_sizes(packet: Packet, data: bytes) -> tuple[int, int]:
    """Bytes of a packet with its three fields plain, and with each of them deflated."""
    message = pb.Packet.FromString(data)
    body = getattr(message, str(message.WhichOneof("body")))
    sizes = []
    for level in (0, 9):
        for field, content in plain_fields(packet).items():
            setattr(body, field, zlib.compress(content, level, wbits=-15) if level else content)
        sizes.append(message.ByteSize())
    return sizes[0], sizes[1]


def plain_fields(packet: Packet) -> dict[str, bytes]:
    body = packet.body
    if isinstance(body, Keyscan):
        return {"ranges": quantise(body.ranges_m).tobytes()}
    if isinstance(body, Place):
        codes = quantise_keypoints(body.keypoints)
        order = ascending(codes)
        return {"keypoints": codes[order].tobytes(), "descriptors": body.descriptors[order].tobytes()}
    return {}


def part_rows(name: str, packets: Sequence[Packet]) -> Iterator[tuple]:
    """What a keypoint, a descriptor and a place with as many as stated cost, by channel."""
    for channel in PLACE_CHANNELS:
        some = [p for p in packets if isinstance(p.body, Place) and p.body.channel is channel and len(p.body.keypoints)]
        if not some:
            continue
        count = sum(len(packet.body.keypoints) for packet in some)
        messages = [pb.Packet.FromString(encode(packet)).place for packet in some]
        keypoints, descriptors = (
            sum(len(getattr(message, field)) for message in messages) / count for field in ("keypoints", "descriptors")
        )
        axes = KEYPOINT_AXES[channel]
        stated = [strongest(packet) for packet in some if len(packet.body.keypoints) >= STATED]
        sizes = np.array([len(encode(packet)) for packet in stated] or [np.nan]) / 1e3
        plain = np.array([plain_sizes(packet, encode(packet))[0] for packet in stated] or [np.nan]) / 1e3
        per_place = (keypoints, 2 * axes, descriptors, 32, len(stated), sizes.mean(), sizes.max(), plain.mean())
        yield name, str(channel), len(some), count / len(some), *per_place


def strongest(packet: Packet) -> Packet:
    place = packet.body
    few = replace(place, keypoints=place.keypoints[:STATED], descriptors=place.descriptors[:STATED])
    return replace(packet, body=few)


if __name__ == "__main__":
    main()
