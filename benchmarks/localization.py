"""Localization in a finished map: found after how far, how exactly, and never in the wrong place.

    FCSLAM_DATA=/path/to/data python benchmarks/localization.py [--keep rows.jsonl]

**Parts**: the last part of a log in the map of the parts before it, by the map files of the run folder alone. Errors
are those of the believed poses by the reference relations.

**Wean Hall**: each of five runs in the map that the other four made. The corridors repeat themselves. Reference: the
map of all five runs, moved onto that map by a robot that is in both.

**Other buildings**: in the map of each log, the first 60 m of the two logs before it. Any fix is wrong.

**Carried away**: a simulated robot is put down at least 10 m away and turned by at least 30 degrees; its wheels never
notice. The map is that of three other robots. After each fix the robot must be within 0.5 m of the truth; "believed
wrongly" counts the metres that it drove from then on until it noticed that it is elsewhere; "in known area" those where
the map knows at least half of the walls in its sight. Who drives in unknown area only cannot be found.

Without FCSLAM_DATA only the last part runs. Seeds below 100 chose the settings.
"""

import itertools
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import common
import numpy as np
from convert_logs import readable
from relocalization import Drive, kidnap
from strangers import CORRECTED, RAW
from wean_hall import LOGS as WEAN_HALL

import fcslam
from fcslam import sources
from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.lab.evaluation.relations import evaluate_relations
from fcslam.lab.simulation.options import Building
from fcslam.lab.simulation.simulated_fleet import SimulationSettings, simulate_fleet
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.metrics.trajectory import align
from fcslam.mission.localization import read_map
from fcslam.records import FloatArray, LaserScan, SensorRecord
from fcslam.runs import LocalizedPoses, Run
from fcslam.sources.faults import Faults

WRONG_M = 0.5
STRANGER_M, STRANGERS = 60.0, 2
SECTIONS = "parts", "wean", "others", "carried"
BUILDINGS, SEEDS, PATH_M = ("default", "office"), tuple(range(101, 117)), 60.0
MAPPING = (0, 3, 4)
"""Robots of a fleet of five that make the map."""

FOUND = {"scans": ",.0f", "localized": ".3f", "fixed after, m": ".1f", "fixes": ".0f", "losses": ".0f"}
PARTS = {"log": "", **FOUND, "relations, m": ".4f", "deg": ".3f", "largest, m": ".3f", "CPU, s": ".1f",
         "of a core at 10 Hz": ".4f"}  # fmt: skip
WEAN = {"run": "", **FOUND, "driven, m": ".1f", "off, median, m": ".3f", "largest, m": ".3f", "wrong": ".0f"}
OTHERS = {"log": "", "map": "", "scans": ",.0f", "fixes": ".0f", "CPU, s": ".1f"}
BEHIND_M = 0.1
"""Walls are looked up this far before them: a return may lie just behind its wall."""
KNOWN_SHARE, ENOUGH_M = 0.5, 10.0
"""Share of the walls in sight that the map knows in known area, and how far a robot drives there to be found."""
CARRIED = {"building": "", "seed": "", "fixed before": "", "noticed after, m": ".1f", "found": "",
           "found after, m": ".1f", "off, m": ".3f", "believed wrongly, m": ".1f", "wrong fixes": ".0f",
           "driven, m": ".1f", "in known area, m": ".1f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--keep", type=Path, help="file that keeps finished rows; the same one resumes")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the robots that are carried away")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS, help="what is measured")
    chosen = parser.parse_args()
    kept, report = common.Kept(chosen.keep), common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        work = Path(place)
        if os.environ.get("FCSLAM_DATA"):
            logs = [*RAW, *CORRECTED]
            folder = common.recordings(*common.slam_benchmark_files(), *WEAN_HALL, *logs)
            if "parts" in chosen.sections:
                parts = [
                    kept.rows(("part", log), lambda log=log: [part(folder, log, work)])[0] for log in common.SPLITS
                ]
                report.table("Parts", PARTS, parts)
            if "wean" in chosen.sections:
                report.table("Wean Hall", WEAN, kept.rows(("wean",), lambda: wean_hall(folder, work)))
            if "others" in chosen.sections:
                others = [kept.rows(("other", log), lambda log=log: strangers(folder, logs, log, work)) for log in logs]
                report.table("Other buildings", OTHERS, itertools.chain(*others))
    if "carried" in chosen.sections:
        cases = itertools.product(BUILDINGS, chosen.seeds)
        carried = [
            row for case in cases for row in kept.rows(("carried", *case), lambda case=case: carried_away(*case))
        ]
        report.table("Carried away: summary", {"": "", "value": ".2f"}, summary(carried))
        report.table("Carried away", CARRIED, carried)
    report.write()


class Head:
    """The first metres of a recording."""

    def __init__(self, source: sources.Source, length_m: float) -> None:
        self.name, self._source, self._length_m = source.name, source, length_m

    def records(self) -> Iterator[SensorRecord]:
        before, driven_m = None, 0.0
        for record in self._source.records():
            if isinstance(record, LaserScan):
                here = np.array(record.T_odom_base[:2])
                driven_m += 0.0 if before is None else float(np.hypot(*(here - before)))
                before = here
            if driven_m > self._length_m:
                return
            yield record


class Scans:
    """Scans in memory as a recording."""

    faults = Faults({})

    def __init__(self, name: str, scans: Sequence[LaserScan]) -> None:
        self.name, self._scans = name, scans

    def records(self) -> Iterator[SensorRecord]:
        return iter(self._scans)


def found(run: Run) -> tuple[float, ...]:
    names = ("scans", "localized_share", "first_fix_after", "fixes", "losses")
    return tuple(run.metrics[name].value for name in names)


def localized(source: Any, place: Path | Any) -> tuple[Run, float]:
    """The run of a localization, and its CPU time."""
    from fcslam.mission.localization import FinishedMap, run_localization
    from fcslam.mission.mission import MissionConfig

    occupancy = read_map(place) if isinstance(place, Path) else place
    began = time.process_time()
    return run_localization(source, FinishedMap(occupancy), MissionConfig()), time.process_time() - began


def part(folder: Path, log: str, work: Path) -> tuple:
    """The last part of a log in the map of the others."""
    parts = sources.split(sources.open_source(common.log_path(folder, log)), common.SPLITS[log])
    fcslam.map_recordings(parts[:-1], output=work / log)
    run, cpu_s = localized(parts[-1], work / log)
    run.save(work / f"{log}-localized")
    reference = common.relations_path(folder, log)
    errors = evaluate_relations(work / f"{log}-localized", reference)
    scans = run.metrics["scans"].value
    means = errors.translation.mean, errors.rotation.mean, errors.translation.maximum
    return (log, *found(run), *means, cpu_s, 10.0 * cpu_s / scans)


def wean_hall(folder: Path, work: Path) -> Iterable[tuple]:
    recordings = [sources.open_source(readable(folder / log)) for log in WEAN_HALL]
    together = fcslam.map_recordings(recordings)
    for own in recordings:
        run, off = in_map_of_others(recordings, own, together, work)
        believed = np.hypot(*off[run.localized[own.name].is_localized, :2].T)
        largest, wrong = believed.max(initial=0.0), int((believed > WRONG_M).sum())
        driven_m = together.trajectories[own.name].path_length_m
        yield own.name, *found(run), driven_m, float(np.median(believed)), largest, wrong


def in_map_of_others(
    recordings: Sequence[sources.Source], own: sources.Source, together: Run, work: Path
) -> tuple[Run, FloatArray]:
    """A robot localized in the map of the others, and how far each scan is from its pose in the map of all, (N, 3).

    The map of all is moved onto that of the others by a robot that is in both.
    """
    others = [recording for recording in recordings if recording.name != own.name]
    mapped = fcslam.map_recordings(others, output=work / f"without-{own.name}")
    run, _ = localized(own, work / f"without-{own.name}")
    T_map_all = align(*(each.trajectories[others[0].name].T_map_base for each in (mapped, together)))
    poses, truth = run.localized[own.name], together.trajectories[own.name]
    assert np.array_equal(poses.stamps, truth.stamps), "one pose for each scan"
    return run, se2.between(se2.compose(T_map_all, truth.T_map_base), poses.T_map_base)


def strangers(folder: Path, logs: Sequence[str], mapped: str, work: Path) -> Iterable[tuple]:
    """Robots of other logs in the map of one."""
    try:
        fcslam.map_recordings(readable(folder / mapped), output=work / "other")
        occupancy = read_map(work / "other")
    finally:
        shutil.rmtree(work / "other", ignore_errors=True)
    first = logs.index(mapped)
    for log in [logs[first - k] for k in range(1, STRANGERS + 1)]:
        try:
            run, cpu_s = localized(Head(sources.open_source(readable(folder / log)), STRANGER_M), occupancy)
            yield log, mapped, run.metrics["scans"].value, run.metrics["fixes"].value, cpu_s
        except SourceError as error:
            print(error, flush=True)


class Carried(NamedTuple):
    """A robot that was carried away, and what it believed."""

    poses: LocalizedPoses
    drive: Drive
    moment: int
    """Number of the first scan at the other place."""
    T_building_map: FloatArray
    occupancy: OccupancyMap


def carry_away(building: str, seed: int) -> Carried | None:
    """Localize a robot that is carried away; None if the building is too small."""
    settings = SimulationSettings(building=Building(building), robots=5, path_length_m=PATH_M, camera=None)
    robots = simulate_fleet(settings, seed).robots
    drives = [Drive(robot.name, list(robot.scans()), robot.T_building_base) for robot in robots]
    drive, moment = kidnap(drives[1], drives[2], np.random.default_rng(seed))
    if not moment:
        return None
    run = fcslam.map_recordings([Scans(drives[k].name, drives[k].scans) for k in MAPPING])
    first = run.trajectories[drives[0].name]
    T_building_map = align(drives[0].truth(first.stamps), first.T_map_base)
    occupancy = run.maps[first.map_index]
    poses = localized(Scans(drive.name, drive.scans), occupancy)[0].localized[drive.name]
    return Carried(poses, drive, moment, T_building_map, occupancy)


def carried_away(building: str, seed: int) -> Iterable[tuple]:
    carried = carry_away(building, seed)
    if carried is not None:
        yield building, seed, *outcome(carried)


def outcome(carried: Carried) -> tuple:
    """What the robot believed before and after it was carried away."""
    poses, drive, moment = carried.poses, carried.drive, carried.moment
    known = poses.is_localized
    off_m = np.hypot(*(se2.compose(carried.T_building_map, poses.T_map_base) - drive.truth(poses.stamps))[:, :2].T)
    step_m = np.append(0.0, np.hypot(*np.diff(drive.T_building_base[:, :2], axis=0).T))
    step_m[moment] = 0.0
    driven_m = np.cumsum(step_m)
    fixed = np.flatnonzero(known & ~np.append(False, known[:-1]))
    wrong_fixes = int((off_m[fixed] > WRONG_M).sum())
    since = np.arange(len(known)) >= moment
    silent = np.flatnonzero(since & ~known)
    noticed_m = driven_m[silent[0]] - driven_m[moment] if known[moment - 1] and len(silent) else np.nan
    right = np.flatnonzero(since & known & (off_m <= WRONG_M))
    found_m = driven_m[right[0]] - driven_m[moment] if len(right) else np.nan
    off = float(np.median(off_m[right])) if len(right) else np.nan
    wrongly = float(step_m[since & known & (off_m > WRONG_M)].sum())
    before = "yes" if known[:moment].any() else "no"
    known_m = sum(step_m[k] for k in np.flatnonzero(since) if known_share(carried, k) >= KNOWN_SHARE)
    is_found = "yes" if len(right) else "no"
    return before, noticed_m, is_found, found_m, off, wrongly, wrong_fixes, step_m[since].sum(), known_m


def known_share(carried: Carried, number: int) -> float:
    """Share of the returns of a scan that lie on cells that the map knows."""
    scan, occupancy = carried.drive.scans[number], carried.occupancy
    T_map_base = se2.compose(se2.inverse(carried.T_building_map), carried.drive.T_building_base[number])
    x, y, heading = se2.compose(T_map_base, np.array(scan.laser.T_base_laser))
    seen = (scan.ranges_m > 0.0) & (scan.ranges_m < scan.laser.max_range_m)
    reach_m, angles = scan.ranges_m[seen] - BEHIND_M, heading + scan.laser.angles_rad()[seen]
    ends = np.column_stack((x + reach_m * np.cos(angles), y + reach_m * np.sin(angles)))
    column, row = np.floor((ends - occupancy.origin_xy) / occupancy.resolution_m).astype(np.int64).T
    inside = (row >= 0) & (column >= 0) & (row < occupancy.cells.shape[0]) & (column < occupancy.cells.shape[1])
    return float((occupancy.cells[row[inside], column[inside]] != Occupancy.UNKNOWN).sum() / max(1, len(ends)))


def summary(rows: Sequence[tuple]) -> Iterator[tuple[str, float]]:
    some = [dict(zip(CARRIED, row, strict=True)) for row in rows]
    yield "carried away", len(some)
    yield "localized before", sum(row["fixed before"] == "yes" for row in some)
    yield "found again", sum(row["found"] == "yes" for row in some)
    able = [row for row in some if row["in known area, m"] >= ENOUGH_M]
    yield f"at least {ENOUGH_M:.0f} m in known area", len(able)
    yield "of these found again", sum(row["found"] == "yes" for row in able)
    yield "wrong fixes", sum(row["wrong fixes"] for row in some)
    for name in ("noticed after, m", "found after, m", "off, m", "believed wrongly, m"):
        values = np.array([row[name] for row in some], dtype=np.float64)
        yield f"{name}: median", float(np.nanmedian(values))
        yield f"{name}: largest", float(np.nanmax(values))


if __name__ == "__main__":
    main()
