"""Is a confident pose right? Quality of poses and corrections against how often they are wrong.

    FCSLAM_DATA=/path/to/data python benchmarks/localization_quality.py [--keep rows.jsonl]

**Carried robots**: poses of the simulated robots of `localization.py` that are carried away half-way, in the map of
three others. **Real robots**: poses of five runs in Wean Hall, each in the map of the other four, and of the last part
of three logs in the map of the parts before it; reference: the map of all of them. A pose is wrong if it is more than
0.5 m or 0.1 rad off.

**Corrections**: all those that the cloud sends to the simulated robots of `relocalization.py` before and after they are
carried away half-way, while they are mapped together with another one. Wrong: more than 0.3 m or 5 degrees off.

Per range of quality: how many, wrong ones, and the upper end of the 95 % confidence interval of their share, with each
drive as one sample of its share (bootstrap over drives). No wrong pose among n drives bounds the share of drives with
one by 3 / n. A robot that nobody carries away has no wrong pose in `localization.py`, so the simulated shares are those
of the worst case.

Seeds below 100 may choose settings; those here were not looked at. Without FCSLAM_DATA the real robots are left out.
"""

import functools
import itertools
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np
import relocalization
from convert_logs import readable
from localization import BUILDINGS, SEEDS, WRONG_M, carry_away, in_map_of_others
from numpy.typing import NDArray
from wean_hall import LOGS as WEAN_HALL

import fcslam
from fcslam import sources
from fcslam.geometry import se2
from fcslam.records import FloatArray
from fcslam.runs import Run

WRONG_RAD = 0.1
EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
CONFIDENT = 0.9
RESAMPLES = 10_000
SECTIONS = "carried", "corrections", "real"
CARRIED, REAL, CORRECTIONS = "Poses of carried robots", "Poses of real robots", "Corrections"
COLUMNS = {"quality over": ".2f", "up to": ".2f", "number": ",.0f", "wrong": ",.0f", "share wrong": ".4f",
           "at most": ".4f"}  # fmt: skip

Counts = Iterable[tuple[int, int]]
"""How many lie in each range of quality, and how many of these are wrong."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--keep", type=Path, help="file that keeps finished rows; the same one resumes")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the fleets")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS, help="what is measured")
    chosen = parser.parse_args()
    kept, report = common.Kept(chosen.keep), common.Report(__file__, __doc__, chosen)
    tables = {}
    with tempfile.TemporaryDirectory() as place:
        simulated = list(itertools.product(BUILDINGS, chosen.seeds))
        cases: dict[str, list[tuple[tuple, Callable[[], Counts]]]] = {}
        if "carried" in chosen.sections:
            cases[CARRIED] = [(case, functools.partial(carried, *case)) for case in simulated]
        if "corrections" in chosen.sections:
            cases[CORRECTIONS] = [(case, functools.partial(corrected, *case)) for case in simulated]
        if "real" in chosen.sections and os.environ.get("FCSLAM_DATA"):
            cases[REAL] = [((name,), compute) for name, compute in real_drives(Path(place))]
        for title, drives in cases.items():
            counts = [np.array(kept.rows((title, *key), compute)) for key, compute in drives]
            some = np.array([drive for drive in counts if len(drive)])
            tables[title] = list(reliability(some))
            report.table(f"{title}: {len(some)} drives", COLUMNS, tables[title])
    report.picture("Share of wrong ones by quality", draw(tables))
    report.write()


def carried(building: str, seed: int) -> Counts:
    """Poses of a robot that is carried away; nothing if the building is too small."""
    robot = carry_away(building, seed)
    if robot is None:
        return ()
    off = se2.between(robot.drive.truth(robot.poses.stamps), se2.compose(robot.T_building_map, robot.poses.T_map_base))
    return in_ranges(robot.poses.quality, is_wrong(off), robot.poses.is_localized)


def corrected(building: str, seed: int) -> Counts:
    """Corrections of a robot that is carried away while it is mapped together with another one; 0 is not counted."""
    drives = relocalization.recorded(building, seed)
    kidnapped, _ = relocalization.kidnap(drives[1], drives[2], np.random.default_rng(seed))
    others, packets = (relocalization.driven(drive, relocalization.WATCHED)[0] for drive in (drives[0], kidnapped))
    sent, _ = relocalization.mission((drives[0], kidnapped), others, packets)
    quality, wrong = np.array([one.quality for one in sent]), np.array([not one.is_right for one in sent])
    return in_ranges(quality, wrong, quality > 0.0)


def real_drives(work: Path) -> Iterator[tuple[str, Callable[[], Counts]]]:
    """Name of each real drive and what counts its poses."""
    folder = common.recordings(*common.slam_benchmark_files(), *WEAN_HALL)
    groups = [[sources.open_source(readable(folder / log)) for log in WEAN_HALL]]
    groups += [
        sources.split(sources.open_source(common.log_path(folder, log)), parts) for log, parts in common.SPLITS.items()
    ]
    for number, group in enumerate(groups):
        together = functools.cache(functools.partial(fcslam.map_recordings, group))
        for own in group if number == 0 else group[-1:]:
            yield own.name, functools.partial(in_joint_map, group, own, together, work)


def in_joint_map(
    group: Sequence[sources.Source], own: sources.Source, together: Callable[[], Run], work: Path
) -> Counts:
    """Poses of a real robot in the map of the others, by the map of all."""
    run, off = in_map_of_others(group, own, together(), work)
    poses = run.localized[own.name]
    return in_ranges(poses.quality, is_wrong(off), poses.is_localized)


def is_wrong(off: FloatArray) -> NDArray[np.bool_]:
    """Whether poses that are this far off, shape (N, 3), are wrong."""
    wrong: NDArray[np.bool_] = (np.hypot(off[:, 0], off[:, 1]) > WRONG_M) | (np.abs(off[:, 2]) > WRONG_RAD)
    return wrong


def in_ranges(quality: FloatArray, wrong: NDArray[np.bool_], counted: NDArray[np.bool_]) -> Counts:
    """Those that are counted, and the wrong ones of them, in each range of quality."""
    for low, high in itertools.pairwise(EDGES):
        within = counted & (quality > low) & (quality <= high)
        yield int(within.sum()), int((within & wrong).sum())


def reliability(drives: np.ndarray) -> Iterator[Sequence[float]]:
    """Rows of the table; ``drives``: numbers and wrong ones of each drive and range, shape (D, R, 2)."""
    for row, (low, high) in enumerate(itertools.pairwise(EDGES)):
        yield low, high, *_share(drives[:, row])
    first = EDGES.index(CONFIDENT)
    yield CONFIDENT, 1.0, *_share(drives[:, first:].sum(axis=1))


def _share(drives: np.ndarray) -> tuple[float, float, float, float]:
    """Number, wrong ones, the share of these, and the upper end of its interval."""
    total, wrong = drives.sum(axis=0)
    if not total:
        return 0.0, 0.0, np.nan, np.nan
    drawn = np.random.default_rng(0).integers(len(drives), size=(RESAMPLES, len(drives)))
    sums = drives[drawn].sum(axis=1)
    shares = sums[:, 1] / np.maximum(sums[:, 0], 1)
    return float(total), float(wrong), wrong / total, float(np.quantile(shares, 0.975))


def draw(tables: dict[str, list[Sequence[float]]]) -> Any:
    """The share of wrong ones in each range, with the upper end of its interval."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for title, rows in tables.items():
        ranges = np.array(rows[:-1], dtype=np.float64)
        (line,) = axes.plot(ranges[:, :2].mean(axis=1), ranges[:, 4], "o-", label=title)
        axes.plot(ranges[:, :2].mean(axis=1), ranges[:, 5], ":", color=line.get_color())
    axes.axhline(0.01, color="grey", linewidth=0.8)
    axes.set(xlabel="quality", ylabel="share wrong (dotted: at most)", xlim=(0.0, 1.0))
    axes.legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main()
