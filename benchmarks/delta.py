"""The threshold delta of the paper's system: on which fleets it was chosen, and what it does on ten others.

    python benchmarks/delta.py --fleets FOLDER [--chosen 201 202 ...] [--seeds 101 ...]

The fleets of `benchmarks/simulated_fleet.py` in the default building, recorded into FOLDER and mapped there by `fcslam
map --config paper`. The cloud then applies the packets of each fleet again, and every delta decides. The paper uses
0.85 for similarities whose scale it does not give; here a place has 4 with itself. The rule for two valid points was
chosen on the same fleets as delta.

A join of two robots is right if it is off by 0.5 m and 10 deg at most, otherwise false. A match is near if its two
places lie at most 2 m apart.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import common
import numpy as np
import simulated_fleet

from fcslam.cloud.closure_log import ClosureLog
from fcslam.cloud.cloud import Cloud
from fcslam.cloud.result import FleetResult
from fcslam.cloud.rigid_fusion import fuse_rigidly
from fcslam.config import load
from fcslam.lab.presets import Preset
from fcslam.metrics.closures import WRONG_DEG, WRONG_M
from fcslam.metrics.trajectory import interpolate, placement_error
from fcslam.mission.mission import MissionConfig
from fcslam.mission.mission_file import read_mission
from fcslam.places.matcher import PlaceMatch
from fcslam.records import ClosureStatus, FloatArray
from fcslam.runs import read_tum

DELTAS = (0.85, 1.0, 1.2, 1.4, 1.8)
CHOSEN = (201, 202, 203, 204)
NEAR_M, GAP_S = 2.0, 0.25
COLUMNS = {"delta": ".2f", "fleets": "d", "right joins": "d", "false joins": "d", "of": "d", "matches": "d",
           "near": ".2f", "worst join, m": ".2f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--fleets", type=Path, required=True, help="folder of recordings and runs; the rest is made")
    parser.add_argument("--chosen", nargs="+", type=int, default=CHOSEN, help="seeds of the fleets that choose delta")
    parser.add_argument("--seeds", nargs="+", type=int, default=simulated_fleet.SEEDS, help="of the other fleets")
    parser.add_argument("--keep", type=Path, help="file that keeps finished fleets; the same one resumes")
    chosen = parser.parse_args()
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__ or "", chosen)
    rows: list[tuple] = []
    for seed in (*chosen.chosen, *chosen.seeds):
        rows += kept.rows((seed,), lambda seed=seed: list(fleet_rows(chosen.fleets, seed)))
    report.table("Fleets that choose", COLUMNS, summary(rows, chosen.chosen))
    report.table("Other fleets", COLUMNS, summary(rows, chosen.seeds))
    report.table("Each fleet", {"seed": "", **COLUMNS}, [(row[0], row[1], 1, *row[2:]) for row in rows])
    report.write()


def papers_run(fleets: Path, seed: int) -> tuple[Path, Path]:
    """A fleet's recordings, and its run by the preset; each is made if it is not in the folder."""
    fleet, run = fleets / f"default-{seed}", fleets / f"paper-{seed}"
    common.simulated(fleet, "--robots", simulated_fleet.ROBOTS, "--seed", seed)
    if not run.exists():
        common.run_fcslam("map", *sorted(fleet.glob("robot_*")), "--config", Preset.PAPER, "--output", run)
    return fleet, run


def fleet_rows(fleets: Path, seed: int) -> Iterator[tuple]:
    fleet, run = papers_run(fleets, seed)
    saved, preset = read_mission(run), load(MissionConfig, Preset.PAPER.file)
    matcher = preset.fleet.matcher.model_copy(update={"delta": min(DELTAS)})
    cloud = Cloud(preset.fleet.model_copy(update={"matcher": matcher}), preset.seed)
    packets = [sent.packet for its in saved.packets.values() for sent in its]
    for packet in sorted(packets, key=lambda packet: packet.order):
        cloud.apply(packet)
    result = cloud.finalize()
    true = {each.robot: _truth(fleet / each.robot / "ground_truth.tum", each.stamps) for each in result.robots}
    for delta in DELTAS:
        yield seed, delta, *judged(result, delta, true)


def judged(result: FleetResult, delta: float, true: Mapping[str, FloatArray]) -> tuple[float, ...]:
    """The columns after the number of fleets.

    ``result`` is that of the least delta: where words decide, a greater one only leaves matches out.
    """
    log = ClosureLog()
    for each in result.closures:
        if each.i.robot != each.j.robot:
            log.add(PlaceMatch.similar(each.i, each.j, each.channel, each.similarity, delta))
    fusion = fuse_rigidly(log, {each.robot: each.T_local_base for each in result.robots})
    errors = [
        placement_error((true[a], fusion.T_map_base[a]), (true[b], fusion.T_map_base[b]))
        for robots in fusion.maps
        for a, b in combinations(robots, 2)
    ]
    right = sum(metres <= WRONG_M and degrees <= WRONG_DEG for metres, degrees in errors)
    matches = [each for each in fusion.closures if each.status is not ClosureStatus.CANDIDATE]
    pairs, worst = len(list(combinations(result.robots, 2))), max((metres for metres, _ in errors), default=0.0)
    return right, len(errors) - right, pairs, len(matches), _near(matches, true), worst


def _truth(path: Path, stamps: FloatArray) -> FloatArray:
    return interpolate(*read_tum(path), stamps, GAP_S)


def _near(matches: Sequence, true: Mapping[str, FloatArray]) -> float:
    apart = [np.hypot(*(true[m.i.robot][m.i.number] - true[m.j.robot][m.j.number])[:2]) for m in matches]
    return float(np.mean(np.array(apart) <= NEAR_M)) if apart else float("nan")


def summary(rows: Sequence[tuple], seeds: Sequence[int]) -> Iterator[tuple]:
    """All fleets of these seeds together, by delta."""
    for delta in DELTAS:
        mine = [row[2:] for row in rows if row[0] in seeds and row[1] == delta]
        right, false, pairs, matches = (sum(column) for column in list(zip(*mine, strict=True))[:4])
        near = sum(row[3] * row[4] for row in mine if row[3])
        worst = max((row[5] for row in mine), default=0.0)
        yield delta, len(mine), right, false, pairs, matches, near / max(matches, 1), worst


if __name__ == "__main__":
    main()
