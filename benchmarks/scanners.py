"""Three logs of the SLAM benchmark as other scanners would have measured them: are maps as accurate as of the full log?

    FCSLAM_DATA=/path/to/data python benchmarks/scanners.py
    FCSLAM_DATA=/path/to/data python benchmarks/scanners.py --logs mit-csail --seeds 0

- interleaved: cycles of four scans, each a quarter of an increment further; the first has n beams, the others n - 1.
  A direction between two beams gets the line between their returns if both lie on one surface, else the nearer beam.
- every second beam: the even and the odd beams of the log in turn, so each scan has half of them and nothing is
  interpolated.
- dropped: each beam returns nothing with a probability of 10 %.
- jittering: the number of beams of each scan is up to 3 % off, over the same field of view, interpolated as above.

Errors follow Kuemmerle et al. 2009 over all relations; one robot. The ratio is to the mean error of the full log.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import common
import numpy as np
from robustness import Recording

from fcslam.lab.evaluation.relations import pose_table
from fcslam.metrics.relations import read_relations, relation_errors
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import Beams, LaserScan, frozen
from fcslam.sources import open_source

DROPPED, JITTER = 0.1, 0.03
SAME_SURFACE = 3.0
"""Returns of neighbouring beams lie on one surface if they are closer than this many spacings or ``NEAR_M``."""
NEAR_M = 0.1
COLUMNS = {"log": "", "scanner": "", "seed": "", "relations": "", "mean, m": ".4f", "max, m": ".3f",
           "mean, deg": ".3f", "ratio": ".3f"}  # fmt: skip

Scanner = Callable[[LaserScan, int, np.random.Generator], LaserScan]
"""A scan of the log, its number and a generator in; a scan of another scanner out."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--logs", nargs="+", default=tuple(common.SPLITS), choices=common.SPLITS, metavar="LOG")
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1, 2), help="of dropped beams and of the jitter")
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    rows = [row for name in chosen.logs for row in measure(folder, name, chosen.seeds)]
    report.table("Scanners", COLUMNS, rows)
    report.write()


def measure(folder, name: str, seeds) -> Iterator[tuple]:
    scans = [record for record in open_source(common.log_path(folder, name)).records() if isinstance(record, LaserScan)]
    reference = read_relations(common.relations_path(folder, name))
    full = None
    for scanner, runs in SCANNERS.items():
        for seed in seeds if scanner in RANDOM else ("-",):
            rng = np.random.default_rng(None if seed == "-" else seed)
            seen = [runs(scan, k, rng) for k, scan in enumerate(scans)]
            run = run_mission([Recording(name, seen)], MissionConfig())
            errors = relation_errors(reference, pose_table(run))
            full = errors.translation.mean if full is None else full
            six = errors.translation.mean, errors.translation.maximum, errors.rotation.mean
            yield name, scanner, seed, errors.used, *six, errors.translation.mean / full


def interleaved(scan: LaserScan, number: int, _: np.random.Generator) -> LaserScan:
    count, first_rad, increment_rad = scan.laser.beams
    step = number % 4
    return resampled(scan, Beams(count - (step > 0), first_rad + 0.25 * step * increment_rad, increment_rad))


def jittering(scan: LaserScan, _: int, rng: np.random.Generator) -> LaserScan:
    count = scan.laser.beam_count + round(scan.laser.beam_count * rng.uniform(-JITTER, JITTER))
    return resampled(scan, Beams(count, scan.laser.angle_min_rad, scan.laser.beams.span_rad / (count - 1)))


def every_second(scan: LaserScan, number: int, _: np.random.Generator) -> LaserScan:
    odd = number % 2
    _, first_rad, increment_rad = scan.laser.beams
    ranges_m = frozen(scan.ranges_m[odd::2], np.float32)
    beams = Beams(len(ranges_m), first_rad + odd * increment_rad, 2.0 * increment_rad)
    return replace(scan, ranges_m=ranges_m, laser=scan.laser.with_beams(beams))


def dropped(scan: LaserScan, _: int, rng: np.random.Generator) -> LaserScan:
    lost = rng.random(len(scan.ranges_m)) < DROPPED
    return replace(scan, ranges_m=frozen(np.where(lost, np.nan, scan.ranges_m), np.float32))


def resampled(scan: LaserScan, beams: Beams) -> LaserScan:
    """The scan in the directions of ``beams``, which lie between its own."""
    laser, ranges_m = scan.laser, np.asarray(scan.ranges_m, np.float64)
    at = (laser.with_beams(beams).angles_rad() - laser.angle_min_rad) / laser.angle_increment_rad
    before = np.clip(np.floor(at).astype(int), 0, laser.beam_count - 2)
    share = at - before
    a, b = ranges_m[before], ranges_m[before + 1]
    nearest = np.where(share < 0.5, a, b)
    spacing_m = np.minimum(a, b) * abs(laser.angle_increment_rad)
    with np.errstate(invalid="ignore"):  # NaN is no surface
        returned = (a < laser.max_range_m) & (b < laser.max_range_m) & (a > 0.0) & (b > 0.0)
        surface = returned & (np.abs(a - b) < np.maximum(NEAR_M, SAME_SURFACE * spacing_m))
        # where the ray at ``share`` meets the line between both returns
        low, high = np.sin(share * laser.angle_increment_rad), np.sin((1.0 - share) * laser.angle_increment_rad)
        line = a * b * np.sin(laser.angle_increment_rad) / (a * low + b * high)
    measured = frozen(np.where(surface, line, nearest), np.float32)
    return replace(scan, ranges_m=measured, laser=laser.with_beams(beams))


SCANNERS: dict[str, Scanner] = {
    "full log": lambda scan, _, __: scan,
    "interleaved": interleaved,
    "every second beam": every_second,
    "dropped": dropped,
    "jittering": jittering,
}
RANDOM = ("dropped", "jittering")


if __name__ == "__main__":
    main()
