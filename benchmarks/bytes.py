"""Bytes between robots and cloud by kind of message, second, metre and place, and what thinner places cost.

    FCSLAM_DATA=/path/to/data python benchmarks/bytes.py

Counted on the split logs: encoded packets, without what a network adds to them. Keyscans,
constraints and places go up; corrections and acknowledgements come down. Seconds are those of the recordings, paths the
odometry's. "A place with 300 descriptors" is every place that has as many, cut to its 300 strongest and encoded.

Thinner places: the real command with `robot.lidar.keyscans.submap_every_m` at 2, 4 (the default), 8 and 16 m and
nothing else changed; a robot's own closures become rarer with its submaps. Errors are over the relations between
different robots, of which those between robots in different maps cannot be used. Closures as
`benchmarks/closures.py` says how they are judged.
"""

import heapq
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from evaluation.relation_closures import evaluate_closures

from fcslam.cloud.cloud import Cloud
from fcslam.lab.evaluation.closures import ClosureScope
from fcslam.lab.evaluation.relations import evaluate_relations
from fcslam.mission.mission import MissionConfig
from fcslam.records import ClosureStatus, Place
from fcslam.robot.frontend import RobotFrontend
from fcslam.sources import Source, open_source, split
from fcslam.wire.ledger import Ledger
from fcslam.wire.messages import UPLINK, Packet, PacketKind
from fcslam.wire.packets import encode, measure

STATED_DESCRIPTORS = 300
SPACINGS_M = (2.0, 4.0, 8.0, 16.0)
KINDS = {"log": "", "kind": "", "packets": ",", "bytes": ",", "bytes a packet": ".0f", "share": ".1%",
         "B/s a robot": ".1f", "B/m": ".0f"}  # fmt: skip
ROBOTS = {"robot": "", "recorded, s": ".0f", "path, m": ".0f", **{f"{kind}, kB": ".1f" for kind in PacketKind},
          "up, B/s": ".0f", "up, B/m": ".0f", "down, B/s": ".0f", "down, B/m": ".0f"}  # fmt: skip
PLACES = {"log": "", "places": "", "descriptors: least": "", "mean": ".0f", "most": "", "bytes a place": ".0f",
          "bytes a descriptor": ".1f", "places with 300": "", "kB a place with 300 descriptors": ".2f",
          "the largest": ".2f", "all that goes up, kB a place": ".2f"}  # fmt: skip
THINNED = {"log": "", "a place every, m": ".0f", "places": ".0f", "up, B/s a robot": ".0f", "of it places": ".1%",
           "closures within": ".0f", "between": ".0f", "covered": "", "wrong": "", "maps": ".0f",
           "relations across robots": "", "mean, m": ".4f", "max, m": ".3f", "mean, deg": ".3f"}  # fmt: skip


def main() -> None:
    chosen = common.options(__doc__).parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    kinds, robots, places = [], [], []
    for name, parts in common.SPLITS.items():
        sources = split(open_source(common.log_path(folder, name)), parts)
        surveys = {source.name: source.survey() for source in sources}
        seconds = {robot: survey.duration_s for robot, survey in surveys.items()}
        metres = {robot: survey.path_length_m for robot, survey in surveys.items()}
        ledger, seen = fly(sources)
        kinds += kind_rows(name, ledger, sum(seconds.values()), sum(metres.values()))
        robots += [robot_row(robot, ledger, seconds[robot], metres[robot]) for robot in surveys]
        places.append(place_row(name, ledger, seen))
    thinned = thinned_rows(folder)
    report.table("By kind, all robots of a log", KINDS, kinds)
    report.table("By robot", ROBOTS, robots)
    report.say(
        "A descriptor is 256 bits, 32 bytes; what is more of it is where it was seen and its share of the envelope."
    )
    report.table("A place", PLACES, places)
    report.table("Thinner places", THINNED, thinned)
    report.picture("Error across robots against uplink", draw(thinned))
    report.write()


def fly(sources: list[Source]) -> tuple[Ledger, list[Packet]]:
    """The whole traffic of a mission, and the packets that carried places."""
    config = MissionConfig()
    robots = [RobotFrontend(source.name, config.robot) for source in sources]
    cloud, traffic = Cloud(config.fleet, config.seed), Ledger()
    streams = [packets(source, robot) for source, robot in zip(sources, robots, strict=True)]
    places = []
    for packet in heapq.merge(*streams, key=lambda packet: packet.order):
        sent = measure(packet)
        for sized in (sent, *map(measure, cloud.apply(sent.packet))):
            traffic.accept(sized.label, len(sized.data))
        if isinstance(packet.body, Place):
            places.append(packet)
    return traffic, places


def packets(source: Source, robot: RobotFrontend) -> Iterator[Packet]:
    for record in source.records():
        yield from robot.process(record)
    yield from robot.finish()


def kind_rows(log: str, ledger: Ledger, seconds: float, metres: float) -> list[tuple]:
    whole = ledger.total()
    rows = []
    for kind in (*PacketKind, None):
        total = ledger.total(kind=kind)
        name = "all" if kind is None else kind.value
        figures = (total.bytes / max(total.count, 1), total.bytes / whole.bytes)
        rows.append((log, name, total.count, total.bytes, *figures, total.bytes / seconds, total.bytes / metres))
    return rows


def robot_row(robot: str, ledger: Ledger, seconds: float, metres: float) -> tuple:
    by_kind = {kind: ledger.total(robot, kind).bytes for kind in PacketKind}
    up = ledger.uplink(robot).bytes
    down = sum(by_kind.values()) - up
    kilobytes = [count / 1e3 for count in by_kind.values()]
    return robot, seconds, metres, *kilobytes, up / seconds, up / metres, down / seconds, down / metres


def place_row(log: str, ledger: Ledger, places: list[Packet]) -> tuple:
    counts = np.array([len(packet.body.descriptors) for packet in places])
    size = sum(len(encode(packet)) for packet in places)
    stated = [size_of(packet) for packet in places if len(packet.body.descriptors) >= STATED_DESCRIPTORS]
    up = sum(ledger.total(kind=kind).bytes for kind in UPLINK)
    count = (len(places), int(counts.min()), counts.mean(), int(counts.max()))
    kilobytes = (np.mean(stated) / 1e3, max(stated) / 1e3, up / len(places) / 1e3)
    return log, *count, size / len(places), size / counts.sum(), len(stated), *kilobytes


def size_of(packet: Packet) -> int:
    """Bytes of a place's packet with its STATED_DESCRIPTORS strongest descriptors."""
    place = packet.body
    few = replace(
        place,
        keypoints=place.keypoints[:STATED_DESCRIPTORS],
        descriptors=place.descriptors[:STATED_DESCRIPTORS],
    )
    return len(encode(replace(packet, body=few)))


def thinned_rows(folder: Path) -> list[tuple]:
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for name, parts in common.SPLITS.items():
            for spacing_m in SPACINGS_M:
                run, config = Path(place) / f"{name}-{spacing_m:g}", Path(place) / "config.yaml"
                config.write_text(f"robot: {{lidar: {{keyscans: {{submap_every_m: {spacing_m}}}}}}}", encoding="utf-8")
                log = common.log_path(folder, name)
                common.run_fcslam("map", log, "--output", run, "--split", parts, "--config", config)
                rows.append((name, spacing_m, *thinned_row(run, common.relations_path(folder, name))))
    return rows


def thinned_row(run: Path, reference: Path) -> tuple:
    found = common.metrics(run)
    up = sum(found.get(f"{kind}_bytes", 0.0) for kind in UPLINK)
    judged = evaluate_closures(run, reference).scores[ClosureScope.FLEET, ClosureStatus.ACCEPTED].graph
    errors = evaluate_relations(run, reference, across_robots=True)
    accuracy = (errors.translation.mean, errors.translation.maximum, errors.rotation.mean)
    traffic = (found["place_packets"], up / found["recorded_time"], found["place_bytes"] / up)
    closures = (found["intra_robot_closures_accepted"], found["inter_robot_closures_accepted"])
    used = f"{errors.used} of {errors.total}"
    return *traffic, *closures, judged.covered, judged.wrong, found["maps"], used, *accuracy


def draw(rows: list[tuple]) -> Any:
    """Mean error across robots against bytes a second, a line for each log; hollow where some maps stayed apart."""
    from matplotlib.figure import Figure

    axes = (figure := Figure(figsize=(7.0, 4.2))).subplots()
    names = ("a place every, m", "up, B/s a robot", "maps", "mean, m")
    spacing, up, maps, error = (list(THINNED).index(name) for name in names)
    for log in common.SPLITS:
        points = [row for row in rows if row[0] == log and np.isfinite(row[error])]
        (line,) = axes.plot([row[up] for row in points], [row[error] for row in points], label=log)
        for row in points:
            face = line.get_color() if row[maps] == 1 else "white"
            axes.plot(row[up], row[error], "o", color=line.get_color(), markerfacecolor=face)
            place = (row[up], row[error])
            axes.annotate(f"{row[spacing]:g} m", place, textcoords="offset points", xytext=(-8, 7), fontsize=8)
    axes.set(
        xscale="log", yscale="log", xlabel="uplink of a robot, B/s of recording", ylabel="mean error across robots, m"
    )
    axes.set_xticks([500, 1000, 2000, 5000], ["500", "1,000", "2,000", "5,000"])
    axes.set_yticks([0.01, 0.03, 0.1, 0.3, 1.0], ["0.01", "0.03", "0.1", "0.3", "1"])
    axes.minorticks_off()
    axes.set_title("A place every 2, 4, 8, 16 m (missing: no joint map)", fontsize=10)
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
