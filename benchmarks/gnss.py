"""Simulated yards with a satellite receiver: where is the map on the earth, and do reflections bend it?

    python benchmarks/gnss.py
    python benchmarks/gnss.py --seeds 1 2

One robot drives 300 to 750 m in a yard (benchmarks/worlds/yard.py) with one fix a second, 1.5 m standard deviation east
and north, from an antenna beside its base. In "reflections", a third of the fixes in the middle of the drive are off by
a further 5 to 15 m that change slowly, as indoors, with the same stated covariance. The true coordinate frame is turned
against east. Errors are of the positions at all scans in the earth's frame, without alignment; "without fixes" is the
same map aligned with the truth (SE(2), least squares).

Passed: a mean error of at most 0.5 m in each yard; the script fails otherwise.
"""

import json
import sys

import common
import numpy as np
from pyproj import Transformer
from robustness import Recording, position_errors
from yards import SCANNERS, largest_map, simulated_robot

from fcslam.geometry import se2
from fcslam.lab.simulation.options import OdometryKind
from fcslam.lab.simulation.simulated_fleet import SimulatedRobot
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import FloatArray, GnssFix

SEEDS = tuple(range(1, 11))
MOST_M = 0.5
SIGMA_M = 1.5
ANTENNA = (-0.3, 0.2)
ORIGIN = (47.3769, 8.5417, 400.0)
T_EARTH_BUILDING = np.array((35.0, -20.0, 0.7))
COLUMNS = {"fixes": "", "seed": "", "mean, m": ".3f", "max, m": ".3f", "without fixes: mean, m": ".3f",
           "max, m ": ".3f", "fixes ": "", "ignored": "", "passed": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the yards")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    for seed in chosen.seeds:
        robot = simulated_robot(OdometryKind.GOOD, seed, SCANNERS[seed % len(SCANNERS)])
        scans = list(robot.scans())
        plain = run_mission([Recording(robot.name, scans)], MissionConfig())
        kept, found = largest_map(plain, robot)
        without = position_errors(found, robot.T_building_base[kept])
        for reflections in (False, True):
            records = sorted([*scans, *fixes(robot, seed, reflections)], key=lambda record: record.stamp)
            run = run_mission([Recording(robot.name, records)], MissionConfig())
            kept, found = largest_map(run, robot)
            georeference = json.loads(run.map_files["map_georeference.json"])
            off = on_earth(found, georeference) - se2.compose(T_EARTH_BUILDING, robot.T_building_base[kept])[:, :2]
            errors = np.hypot(*off.T)
            passed = "yes" if errors.mean() <= MOST_M else "NO"
            kind = "reflections" if reflections else "open sky"
            counts = georeference["fixes"], georeference["ignored"]
            rows.append((kind, seed, errors.mean(), errors.max(), *without, *counts, passed))
            print(*rows[-1], flush=True)
    report.table("Yards", COLUMNS, rows)
    report.write()
    if any(row[-1] == "NO" for row in rows):
        sys.exit("a map is not where it should be on the earth")


def fixes(robot: SimulatedRobot, seed: int, reflections: bool) -> list[GnssFix]:
    rng = np.random.default_rng((seed, 77))
    rows = np.flatnonzero(np.diff(np.floor(robot.stamps), prepend=np.nan))
    poses = se2.compose(T_EARTH_BUILDING, robot.T_building_base[rows])
    at = np.array([se2.transform(pose, np.array([ANTENNA]))[0] for pose in poses])
    at += rng.normal(0.0, SIGMA_M, at.shape)
    if reflections:
        middle = slice(len(rows) // 3, 2 * len(rows) // 3)
        angle = np.cumsum(rng.normal(0.0, 0.1, len(rows)))[middle]
        at[middle] += rng.uniform(5.0, 15.0) * np.column_stack((np.cos(angle), np.sin(angle)))
    to_earth = _local_frame()
    longitude, latitude, altitude = to_earth.transform(*at.T, np.zeros(len(at)), direction="INVERSE")
    return [
        GnssFix(float(robot.stamps[row]), *position, SIGMA_M, ANTENNA)
        for row, *position in zip(rows, latitude.tolist(), longitude.tolist(), altitude.tolist(), strict=True)
    ]


def on_earth(poses: FloatArray, georeference: dict) -> FloatArray:
    """Positions (N, 2) east and north of the true origin, of poses in the map."""
    latitude, longitude = georeference["latitude_deg"], georeference["longitude_deg"]
    east, north, _ = _local_frame().transform(longitude, latitude, georeference["altitude_m"])
    T_earth_map = np.array((east, north, np.radians(georeference["x_axis_from_east_deg"])))
    return se2.compose(T_earth_map, poses)[:, :2]


def _local_frame() -> Transformer:
    """Longitude, latitude, altitude to east, north, up: the topocentric frame, not the library's projection."""
    latitude, longitude, altitude = ORIGIN
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +lat_0={latitude} +lon_0={longitude} +h_0={altitude} +ellps=WGS84"
    )


if __name__ == "__main__":
    main()
