"""Is a confident pose right? Quality of poses in a finished map against how often they are wrong.

    python benchmarks/localization_quality.py [--keep rows.jsonl]

The simulated robots of `localization.py` that are carried away, in the map of three other robots. A pose is wrong if it
is more than 0.5 m or 0.1 rad from the truth. Per range of quality: poses, wrong ones, and the upper end of the 95 %
confidence interval of their share, with each drive as one sample of its share (bootstrap over drives); no wrong
pose among n drives bounds the share of drives with one by 3 / n.

Seeds below 100 may choose settings; those here were not looked at. A robot that nobody carries away has no wrong pose
in `localization.py`, so the share here is that of robots in the worst case.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import common
import numpy as np
from localization import BUILDINGS, SEEDS, WRONG_M, Carried, carry_away

from fcslam.geometry import se2

WRONG_RAD = 0.1
EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
CONFIDENT = 0.9
RESAMPLES = 10_000
COLUMNS = {"quality over": ".2f", "up to": ".2f", "poses": ",.0f", "wrong": ",.0f", "share wrong": ".4f",
           "at most": ".4f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--keep", type=Path, help="file that keeps finished rows; the same one resumes")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the fleets")
    chosen = parser.parse_args()
    kept, report = common.Kept(chosen.keep), common.Report(__file__, __doc__, chosen)
    drives = [
        np.array(kept.rows(("quality", *case), lambda case=case: counts(carry_away(*case))))
        for case in itertools.product(BUILDINGS, chosen.seeds)
    ]
    some = np.array([drive for drive in drives if len(drive)])
    report.table("Drives", {"": "", "value": ",.0f"}, [("drives", len(some)), ("poses", some[..., 0].sum())])
    report.table("Reliability", COLUMNS, reliability(some))
    report.write()


def counts(carried: Carried | None) -> Iterable[tuple[int, int]]:
    """Poses and wrong ones in each range of quality; nothing if the building is too small."""
    if carried is None:
        return
    poses = carried.poses
    off = se2.between(carried.drive.truth(poses.stamps), se2.compose(carried.T_building_map, poses.T_map_base))
    is_wrong = (np.hypot(off[:, 0], off[:, 1]) > WRONG_M) | (np.abs(off[:, 2]) > WRONG_RAD)
    for low, high in itertools.pairwise(EDGES):
        within = poses.is_localized & (poses.quality > low) & (poses.quality <= high)
        yield int(within.sum()), int((within & is_wrong).sum())


def reliability(drives: np.ndarray) -> Iterator[Sequence[float]]:
    """Rows of the table; ``drives``: poses and wrong ones of each drive and range, shape (D, R, 2)."""
    for row, (low, high) in enumerate(itertools.pairwise(EDGES)):
        yield low, high, *_share(drives[:, row])
    first = EDGES.index(CONFIDENT)
    yield CONFIDENT, 1.0, *_share(drives[:, first:].sum(axis=1))


def _share(drives: np.ndarray) -> tuple[float, float, float, float]:
    """Poses, wrong ones, the share of these, and the upper end of its interval."""
    total, wrong = drives.sum(axis=0)
    if not total:
        return 0.0, 0.0, np.nan, np.nan
    drawn = np.random.default_rng(0).integers(len(drives), size=(RESAMPLES, len(drives)))
    sums = drives[drawn].sum(axis=1)
    shares = sums[:, 1] / np.maximum(sums[:, 0], 1)
    return float(total), float(wrong), wrong / total, float(np.quantile(shares, 0.975))


if __name__ == "__main__":
    main()
