"""Is the verdict about a map right? 40 runs with truth, ten of them bad on purpose.

    FCSLAM_DATA=/path/to/data python benchmarks/verdict.py --work build/floors

The drives are those of `real_floors.py`, which are made if they are missing; runs in its folder are taken as they are.

- pair, year: two robots on one floor, in one year or in two.
- building: two robots that drive 40 m each in a simulated building (`fcslam.lab.simulation`).
- by hand: a closure by hand with a wrong pose, between robots on two floors or on one.
- cut off: both recordings end after a few seconds.
- strangers, other floor: two robots in two buildings, or on two floors of one.
- copy: one robot on a floor, the other one on a copy of it, half of which is shifted by 1.5 m.

A map is wrong if it shows less than 5 m of path, if the positions of its robots are off by 0.5 m (RMSE, after one
rigid alignment), or if a map within 10 m is bent by 0.25 m (95 %). The verdict is right if it is "do not use it yet"
for each wrong map and for no other, and never plain "use this map" if robots have several maps.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np
from certificate import Simulated, bends
from real_floors import YEARS, alone
from worlds.floor_worlds import FLOORS, Floor, drive, joint_errors, shifted, true_and_found

from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.runs import Run, Use, open_run
from fcslam.runs.tables import write_tum
from fcslam.sources import open_source
from fcslam.sources.bags.writer import write_bag
from fcslam.sources.source import Part

WRONG_M, BENT_M, LEAST_PATH_M = 0.5, 0.25, 5.0
FEWEST_RIGHT = 38
CUT_SCANS = 30
TWICE = ("aws_hospital", "eng2_7f_2015_02", "eng2_7f_2021_03", "kth", "g4s")
"""Floors with two pairs."""
BUILDINGS, BUILDING_PATH_M = 10, 40.0
SCANNERS = "rplidar", "sick", "short"
COLUMNS = {"kind": "", "run": "", "maps": ",d", "ATE, m": ".3f", "bent, m": ".3f", "wrong maps": ",d", "verdict": "",
           "right": "", "why": ""}  # fmt: skip


class Case(NamedTuple):
    kind: str
    name: str
    recordings: tuple[Path, Path]
    by_hand: str = ""
    """Pose of a closure by hand, as ``fcslam edit close`` takes it."""
    is_cut: bool = False
    same_floor: bool = True


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--work", type=Path, default=common.REPOSITORY / "build" / "floors", help="as of real_floors")
    chosen = parser.parse_args()
    common.recordings(kind="floors")
    rows = []
    for case in cases(chosen.work):
        rows.append(row(case, chosen.work))
        print(*rows[-1], flush=True)
    report = common.Report(__file__, __doc__, chosen)
    kinds = dict.fromkeys(row[0] for row in rows)
    counts = [(kind, sum(r[0] == kind for r in rows), sum(r[0] == kind and r[7] == "yes" for r in rows))
              for kind in kinds]  # fmt: skip
    right = sum(row[7] == "yes" for row in rows)
    report.table("Verdicts", {"kind": "", "runs": ",d", "right": ",d"}, [*counts, ("all", len(rows), right)])
    report.table("Runs", COLUMNS, rows)
    report.write()
    if right < FEWEST_RIGHT:
        sys.exit("a floor is missed")


def cases(work: Path) -> Iterator[Case]:
    for floor in FLOORS:
        for seed in (2, 3) if floor in TWICE else (2,):
            folder = work / f"{floor}-{seed}-0.4"
            drive(floor, folder, "--seed", seed, "--overlap", 0.4)
            yield Case("pair", f"{floor}-{seed}", (folder / "anna", folder / "ben"))
    pair = [alone(floor, 1, scanner, 5, work) / "anna" for floor, scanner in zip(YEARS[::2], SCANNERS[1:], strict=True)]
    yield Case("year", f"{YEARS[0]}-{YEARS[2]}-1", (pair[0], pair[1]))
    for seed in range(BUILDINGS):
        yield Case("building", str(seed), (Path(), Path()))
    on = {floor: alone(floor, 5, "rplidar", 3, work) / "anna" for floor in ("gdc1", "gdc2", "eng6_1f", "eng6_2f")}
    yield Case("by hand", "gdc1-gdc2", (on["gdc1"], on["gdc2"]), "0.5,0.3,0.4", same_floor=False)
    yield Case("by hand", "eng6_1f-eng6_2f", (on["eng6_1f"], on["eng6_2f"]), "0.2,-0.4,-1.2", same_floor=False)
    folder = work / "torino-2-0.4"
    yield Case("by hand", "torino-2", (folder / "anna", folder / "ben"), "1.5,0.5,0.8")
    for floor in ("kth", "g4s"):
        folder = work / f"{floor}-2-0.4"
        yield Case("cut off", f"{floor}-2", (folder / "anna", folder / "ben"), is_cut=True)
    yield Case("strangers", "gdc1-eng6_2f", (on["gdc1"], on["eng6_2f"]), same_floor=False)
    yield Case("strangers", "eng6_1f-gdc2", (on["eng6_1f"], on["gdc2"]), same_floor=False)
    yield Case("other floor", "gdc1-gdc2-5", (on["gdc1"], on["gdc2"]), same_floor=False)
    yield Case("other floor", "eng6_1f-eng6_2f-5", (on["eng6_1f"], on["eng6_2f"]), same_floor=False)
    copy = work / "copies" / "eng6_1f-shifted.npz"
    if not copy.exists():
        copy.parent.mkdir(parents=True, exist_ok=True)
        shifted(Floor.read("eng6_1f")).write(copy)
    pair = [alone("eng6_1f", 4, "rplidar", 3, work), alone(copy.stem, 5, "rplidar", 3, work, copy.parent)]
    yield Case("copy", "eng6_1f", (pair[0] / "anna", pair[1] / "anna"), same_floor=False)


def row(case: Case, work: Path) -> tuple:
    place = work / "runs" / f"{case.kind}-{case.name}".replace(" ", "-")
    if case.kind == "building" and not (place / "truth").exists():
        settings = SimulationSettings(robots=2, path_length_m=BUILDING_PATH_M, camera=None)
        robots = simulate_fleet(settings, int(case.name)).robots
        run_mission([Simulated(robot) for robot in robots], MissionConfig()).save(place / "run", force=True)
        (place / "truth").mkdir()
        for robot in robots:
            write_tum(place / "truth" / f"{robot.name}.truth.tum", robot.stamps, robot.T_building_base)
    if not (place / "truth").exists():
        recordings = [cut(path, place) for path in case.recordings] if case.is_cut else case.recordings
        begun = place / "first" if case.by_hand else place / "run"
        named = [f"{name}={path}" for name, path in zip("ab", recordings, strict=True)]
        common.run_fcslam("map", *named, "--output", begun, "--force")
        if case.by_hand:
            ends = [item for name, path in open_run(begun).trajectories.items() if "+" not in name
                    for item in (name, float(np.median(path.stamps)))]  # fmt: skip
            common.run_fcslam("edit", "close", begun, *ends, "--pose", case.by_hand)
            common.run_fcslam("map", "--onto", begun, "--output", place / "run", "--force")
        (place / "truth").mkdir()
        for name, path in zip("ab", case.recordings, strict=True):
            truth = path.with_name(f"{path.name}.truth.tum").read_bytes()
            (place / "truth" / f"{name}.truth.tum").write_bytes(truth)
    run = open_run(place / "run", maps=False)
    off, bent, wrong = zip(*(errors(run, one.robots, place, case.same_floor) for one in run.verdict), strict=True)
    as_wrong = [(one.use is Use.WAIT) == is_wrong for one, is_wrong in zip(run.verdict, wrong, strict=True)]
    is_plain = len(run.verdict) > 1 and any(one.use is Use.USE for one in run.verdict)
    worst = max(run.verdict, key=lambda one: list(Use).index(one.use))
    right = "yes" if all(as_wrong) and not is_plain else "NO"
    return (case.kind, case.name, len(run.verdict), max(off), max(bent), sum(wrong), worst.use.value, right, str(worst))


def cut(recording: Path, place: Path) -> Path:
    """The first scans of a recording, as a bag of its own."""
    target = place / f"{recording.name}.mcap"
    target.parent.mkdir(parents=True, exist_ok=True)
    if not target.exists():
        write_bag(target, Part(open_source(recording), 0, CUT_SCANS, recording.name).records())
    return target


def errors(run: Run, sessions: tuple[str, ...], place: Path, same_floor: bool) -> tuple[float, float, bool]:
    """Position error and bend of a map, metres, and whether it is wrong."""
    driven_m = sum(run.trajectories[session].path_length_m for session in sessions)
    if len({session.split("+")[0] for session in sessions}) > 1 and not same_floor:
        return float("nan"), float("nan"), True
    off_m = joint_errors(place / "truth", place / "run", sessions).rmse_m
    true, found = zip(*(true_and_found(place / "truth", place / "run", session) for session in sessions), strict=True)
    _, error_m = bends(np.concatenate(found), np.concatenate(true))
    bent_m = float(np.percentile(error_m, 95)) if len(error_m) else float("nan")
    return off_m, bent_m, driven_m < LEAST_PATH_M or off_m > WRONG_M or bent_m > BENT_M


if __name__ == "__main__":
    main()
