"""Small flats: two robots in one flat must join, robots of two flats must not.

    python benchmarks/flats.py
    python benchmarks/flats.py --channels lidar --cases flat --seeds 1 2 3

Simulated flats of about 10 m by 10 m, 15 m of path for each robot, mapped by LiDAR places alone and by both kinds of
places. "flat": two robots in one flat. "two flats": the first robot of one flat and the second of another, every pair
of ten. "corridor": two robots, 30 m each, in a corridor whose twenty doors are alike; they may join, but not falsely.
A join is false if the relative pose of the two robots is off by more than 0.5 m or 10 deg, or if they never met.

Recordings are kept in the folder WORK, so that a further run only maps; delete it after a change of the simulator.
Passed: robots of one flat join in at least nine of ten flats, and no join is false; the script fails otherwise. Places
of cameras need a GL library.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import combinations
from pathlib import Path

import common

from fcslam.config import load
from fcslam.lab.evaluation.report import evaluate_fleet
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import Channel, ClosureStatus
from fcslam.runs import Run
from fcslam.sources import open_source

WORK = common.REPOSITORY / "build" / "flats"
CHANNELS = {"lidar": (Channel.LIDAR,), "both": (Channel.LIDAR, Channel.CAMERA)}
CASES = ("flat", "two flats", "corridor")
SEEDS = {"flat": tuple(range(1, 21)), "two flats": tuple(range(1, 11)), "corridor": tuple(range(1, 11))}
PATH_M = {"flat": 15.0, "corridor": 30.0}
LEAST_JOINED = 0.9

COLUMNS = {"case": "", "seeds": "", "places": "", "maps": "", "true joins": "", "false joins": "",
           "worst join, m": ".3f", "candidates": "", "verified": "", "accepted": "", "why not more": ""}  # fmt: skip
SUMMARY = {"case": "", "places": "", "fleets": "", "joined": "", "false joins": "", "verified": "", "accepted": "",
           "passed": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES, help="only these")
    parser.add_argument("--channels", nargs="+", choices=CHANNELS, default=list(CHANNELS), help="kinds of places")
    parser.add_argument("--seeds", nargs="+", type=int, help="of the buildings, instead of those of each case")
    parser.add_argument("--work", type=Path, default=WORK, help="folder of the recordings")
    parser.add_argument("--config", type=Path, help="settings of the missions in place of the defaults")
    chosen = parser.parse_args()
    config = load(MissionConfig, chosen.config) if chosen.config else MissionConfig()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    for case in chosen.cases:
        for places in chosen.channels:
            for row in case_rows(case, chosen.seeds or SEEDS[case], places, chosen.work, config):
                rows.append(row)
                print(*row, flush=True)
    counts = list(summary(rows))
    report.table("Summary", SUMMARY, counts)
    report.table("Fleets", COLUMNS, rows)
    report.write()
    if any(row[-1] == "NO" for row in counts):
        sys.exit("robots were joined falsely, or too few were joined")


def case_rows(case: str, seeds: Iterable[int], places: str, work: Path, config: MissionConfig) -> Iterator[tuple]:
    """One row for each fleet of two robots."""
    if case == "two flats":
        for a, b in combinations(seeds, 2):
            robots = [recorded("flat", a, places, work) / "robot_1", recorded("flat", b, places, work) / "robot_2"]
            run = mapped(robots, places, config)
            joins = 2 - map_count(run)
            yield case, f"{a}, {b}", places, map_count(run), 0, joins, float("nan"), *closures(run)
        return
    for seed in seeds:
        folder = recorded(case, seed, places, work)
        run = mapped([folder / "robot_1", folder / "robot_2"], places, config)
        with tempfile.TemporaryDirectory() as place:
            run.save(Path(place) / "run")
            found = evaluate_fleet(Path(place) / "run", folder)
        false = len(found.false_joins)
        worst_m = max((join.translation_m for join in found.joins), default=float("nan"))
        yield case, str(seed), places, found.maps, len(found.joins) - false, false, worst_m, *closures(run)


def recorded(building: str, seed: int, places: str, work: Path) -> Path:
    """The fleet of one building; with cameras it is another recording of the same drives."""
    camera = () if Channel.CAMERA in CHANNELS[places] else ("--no-camera",)
    arguments = ("--building", building, "--seed", seed, "--robots", 2, "--path-length", PATH_M[building], *camera)
    return common.simulated(work / f"{building}-{seed}{'-lidar' if camera else ''}", *arguments)


def mapped(robots: Iterable[Path], places: str, config: MissionConfig) -> Run:
    robot = config.robot.model_copy(update={"channels": CHANNELS[places]})
    return run_mission([open_source(path) for path in robots], config.model_copy(update={"robot": robot}))


def map_count(run: Run) -> int:
    return len({trajectory.map_index for trajectory in run.trajectories.values()})


def closures(run: Run) -> tuple[int, int, int, str]:
    """Closures between the robots: candidates, verified ones, accepted ones, the commonest reason of the others."""
    between = [closure for closure in run.closures if closure.robot_i != closure.robot_j]
    verified = [closure for closure in between if closure.status is not ClosureStatus.CANDIDATE]
    accepted = [closure for closure in between if closure.status is ClosureStatus.ACCEPTED]
    reasons = Counter(str(c.reason) for c in verified if c.status is not ClosureStatus.ACCEPTED).most_common(1)
    return len(between), len(verified), len(accepted), reasons[0][0] if reasons else ""


def summary(rows: list[tuple]) -> Iterator[tuple]:
    """Each case and kind of places over all fleets."""
    for case, places in dict.fromkeys((row[0], row[2]) for row in rows):
        some = [dict(zip(COLUMNS, row, strict=True)) for row in rows if (row[0], row[2]) == (case, places)]
        joined, false, verified, accepted = (
            sum(row[name] for row in some) for name in ("true joins", "false joins", "verified", "accepted")
        )
        passed = not false and (case != "flat" or joined >= LEAST_JOINED * len(some))
        yield case, places, len(some), joined, false, verified, accepted, "yes" if passed else "NO"


if __name__ == "__main__":
    main()
