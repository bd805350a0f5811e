"""One byte of a mission's file is damaged: does the service find it, and is the map the same?

    FCSLAM_DATA=/path/to/data python benchmarks/flipped_bytes.py [--seeds 1000] [--keep FILE]

Two robots of the Intel log (two of eight parts) send a mission, with an edit and a result. Each seed draws a byte of
the file and another value for it; then the service's check runs, which opens the mission if it can. "Closed": the
service was stopped, so all of the mission is in one file. "Killed": half of the packets are in the file and half in its
write-ahead log, and the byte is drawn from both; only the rows have checksums then. A map is a function of packets,
refusals, edits and configuration, which are compared with those from before. "Found": the service says so. "Same map":
they are all as before. "Packets refused": some packets cannot be read; they are named and refused, and nothing else
changed. "Unused": nothing was said, and they are all as before, so the byte means nothing. "Wrong": all else, that is,
another map, or one that is not as the service says. With `--keep`, an interrupted run goes on.
"""

import collections
import contextlib
import heapq
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import common
import numpy as np

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import StoreError
from fcslam.mission import MissionConfig
from fcslam.records import Veto
from fcslam.robot.frontend import RobotFrontend
from fcslam.service.mission_recovery import DAMAGED, recover_mission
from fcslam.service.mission_store import CONFIG, MissionStore, StoredPacket
from fcslam.sources import open_source, split
from fcslam.wire.packets import encode, read_label

SEEDS = 1000
PARTS = 8
COLUMNS = {
    "mission": "", "bytes": ",d", "packets": ",d", "flipped": ",d", "found": ",d", "same map": ",d",
    "packets refused": ",d", "not opened": ",d", "unused": ",d", "wrong": ",d", "check of an undamaged file, s": ".2f",
}  # fmt: skip
AT_ONCE = 20


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS, help="flipped bytes of each mission")
    parser.add_argument("--keep", type=Path, help="file of finished seeds")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report, kept = common.Report(__file__, __doc__, chosen), common.Kept(chosen.keep)
    with tempfile.TemporaryDirectory() as place:
        missions, expected = made(Path(place), list(packets(common.log_path(folder, "intel"))))
        rows = []
        for name, path in missions.items():
            files = sorted(file for file in path.parent.iterdir() if file.name in (path.name, f"{path.name}-wal"))
            outcomes = collections.Counter(
                outcome
                for seed in range(chosen.seeds)
                for (outcome,) in kept.rows((name, seed), lambda n=name, s=seed: [(flipped(missions[n], s, expected),)])
            )
            size = sum(file.stat().st_size for file in files)
            found = chosen.seeds - outcomes["unused"] - outcomes["wrong"]
            told = (outcomes["same map"], outcomes["packets refused"], outcomes["not opened"])
            silent = (outcomes["unused"], outcomes["wrong"])
            rows.append((name, size, len(expected[0]), chosen.seeds, found, *told, *silent, check_s(path)))
    report.table("Flipped bytes", COLUMNS, rows)
    report.write()


def packets(log: Path) -> Iterator[StoredPacket]:
    """The packets of two robots, in the order of their times."""
    streams = []
    for source in split(open_source(log), PARTS)[:2]:
        front = RobotFrontend(source.name, MissionConfig().robot)
        said = [packet for record in source.records() for packet in front.process(record)]
        streams.append(said + list(front.finish()))
    for packet in heapq.merge(*streams, key=lambda packet: packet.order):
        data = encode(packet)
        label = read_label(data)
        yield StoredPacket(packet.robot, packet.epoch, packet.sequence, packet.time, label.kind, label.channel, data)


def made(place: Path, said: list[StoredPacket]) -> tuple[dict[str, Path], Any]:
    """The two missions, and what they hold."""
    paths = {name: place / name / "mission.sqlite" for name in ("closed", "killed")}
    for path in paths.values():
        path.parent.mkdir()
    store = MissionStore(paths["closed"])
    store.configure(CloudConfig())
    store.edit(Veto(said[0].robot, said[1].robot), "admin", 0.0)
    for first in range(0, len(said), AT_ONCE):
        store.put(said[first : first + AT_ONCE], 0.0)
        if first // AT_ONCE == len(said) // AT_ONCE // 2:
            with contextlib.closing(sqlite3.connect(paths["closed"])) as connection:
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    store.answer(store.ask_to_finalize(), "1")
    expected = content(store)
    for suffix in ("", "-wal"):
        shutil.copyfile(f"{paths['closed']}{suffix}", f"{paths['killed']}{suffix}")
    store.close()
    return paths, expected


def content(store: MissionStore) -> Any:
    """All that determines a map."""
    stored = [packet for _, packet in store.arrivals(0, 10**6)]
    return sorted(stored, key=lambda p: (p.robot, p.epoch, p.sequence)), store.edits(), store.fact(CONFIG)


def flipped(path: Path, seed: int, expected: Any) -> str:
    """The outcome of one flipped byte."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as place:
        for file in path.parent.glob(f"{path.name}*"):
            if not file.name.endswith("-shm"):
                shutil.copyfile(file, Path(place) / file.name)
        damaged = Path(place) / path.name
        log = damaged.with_name(f"{damaged.name}-wal")
        files = [file for file in (damaged, log) if file.exists()]
        content_before = b"".join(file.read_bytes() for file in files)
        at, by = int(rng.integers(len(content_before))), int(rng.integers(1, 256))
        chosen = damaged if at < damaged.stat().st_size else log
        with chosen.open("r+b") as file:
            file.seek(at if chosen == damaged else at - damaged.stat().st_size)
            file.write(bytes((content_before[at] ^ by,)))
        try:
            told = recover_mission(damaged)
        except StoreError:
            return "not opened"
        store = MissionStore(damaged)
        found = content(store)
        store.close()
    if found == expected:
        return "unused" if told is None else "same map"
    lost = [packet for packet in found[0] if packet.refusal == DAMAGED]
    numbers = {(packet.robot, packet.epoch, packet.sequence) for packet in lost}
    others = [packet for packet in expected[0] if (packet.robot, packet.epoch, packet.sequence) not in numbers]
    is_honest = told is not None and all(f"packet {packet.sequence} of" in told for packet in lost[:20])
    is_rest_right = [packet for packet in found[0] if packet.refusal != DAMAGED] == others and found[1:] == expected[1:]
    return "packets refused" if is_honest and is_rest_right else "wrong"


def check_s(path: Path) -> float:
    """Time of the check, nothing being damaged."""
    began = time.perf_counter()
    assert recover_mission(path) is None
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
