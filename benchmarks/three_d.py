"""Fleets with 3D LiDARs: do two robots with unknown starts get one map, how exact is it, do others stay apart?

    python benchmarks/three_d.py /path/to/bags --kept rows.jsonl
    python benchmarks/three_d.py /path/to/bags --ramp 41 --flat --strangers --alike 41

Bags are of a simulator outside of this repository: a corridor with rooms on both sides, furniture, lintels, a ceiling,
and a ramp of 1.4 m half-way. Robots have 16 rings at 10 Hz, turn at up to 1.2 rad/s, and have wheels whose scale is off
by 1.5 % and whose turns are off by 3 %. `s<seed>a` and `s<seed>b` are the first and the last 60 % of a drive through
the building of a seed. Of `f<seed>a` and `f<seed>l`, in a building without the ramp, the second has a 2D LiDAR 0.3 m
over the floor. `l<seed>b` is as `s<seed>b`, on a floor with the same walls and other furniture. Beside each bag,
`<bag>.truth.tum` has the true pose at each scan.

Errors are those of the positions of both robots after one rigid alignment, which rotations fix, too. Strangers are the
first robot of one seed and the second one of the next seed. Floors that look alike are `s<seed>a` and `l<seed>b`.
"""

import heapq
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.report import Track
from fcslam.cloud.result import FleetResult
from fcslam.cloud.sessions import robot_of
from fcslam.geometry import se3
from fcslam.mission.driving import legs
from fcslam.mission.mission import MissionConfig
from fcslam.records import ClosureStatus
from fcslam.robot.calibrating import calibrated
from fcslam.runs.tables import read_tum_6d
from fcslam.sources import BagOptions, open_fleet
from fcslam.wire.packets import SizedPacket

SPACE = MissionConfig.model_validate({"fleet": {"dimensions": 3}})
RAMP, FLAT = (41, 42, 43, 44, 45, 61, 62, 63, 64, 65), (31, 51, 52, 71, 72, 73, 74, 75, 76, 77)
COLUMNS = {"seed": "", "maps": "", "closures": "", "ATE (RMSE), m": ".4f", "in the plane, m": ".4f",
           "max, m": ".3f", "rotation, deg": ".3f", "uplink, kB/s": ".1f"}  # fmt: skip
APART_COLUMNS = {"robots": "", "maps": "", "closures": ""}


class Drive(NamedTuple):
    """What a robot sent of its recording, and its scans."""

    packets: list[SizedPacket]
    tracks: dict[str, Track]


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("bags", type=Path, help="folder of the bags")
    parser.add_argument("--ramp", nargs="*", type=int, default=RAMP, help="seeds of two robots with 3D LiDARs")
    parser.add_argument("--flat", nargs="*", type=int, default=FLAT, help="seeds of a 3D LiDAR and a 2D LiDAR")
    parser.add_argument("--strangers", nargs="*", type=int, default=RAMP, help="seeds of robots in other buildings")
    parser.add_argument("--alike", nargs="*", type=int, default=RAMP, help="seeds of robots on floors that look alike")
    parser.add_argument("--kept", type=Path, help="file that keeps finished fleets, so that an interrupted run goes on")
    chosen = parser.parse_args()
    kept, report = common.Kept(chosen.kept), common.Report(__file__, __doc__, chosen)
    after = dict(zip(chosen.strangers, (*chosen.strangers[1:], *chosen.strangers[:1]), strict=True))
    fleets = {
        "Two robots with 3D LiDARs, with a ramp": [(seed, f"s{seed}a", f"s{seed}b") for seed in chosen.ramp],
        "Floors that look alike": [(seed, f"s{seed}a", f"l{seed}b") for seed in chosen.alike],
        "Strangers": [(seed, f"s{seed}a", f"s{after[seed]}b") for seed in chosen.strangers],
        "A robot with a 3D LiDAR and one with a 2D LiDAR, flat": [(k, f"f{k}a", f"f{k}l") for k in chosen.flat],
    }
    for title, pairs in fleets.items():
        is_one = title.startswith(("Two", "A robot"))
        rows = []
        for seed, *pair in pairs:
            rows += kept.rows((title, seed), partial(rows_of, chosen.bags, seed, pair, is_one))
            print(*rows[-1], flush=True)
        report.table(title, COLUMNS if is_one else APART_COLUMNS, rows)
    report.write()


@cache
def drive(name: str, bag: Path) -> Drive:
    [source] = open_fleet([(bag, name)], BagOptions(in_3d=True))
    driven = list(legs(calibrated(source, SPACE.robot.lidar), SPACE.robot))
    return Drive([packet for leg in driven for packet in leg.packets], dict(driven[-1].tracks))


def result_of(*drives: Drive) -> FleetResult:
    cloud = Cloud(SPACE.fleet, SPACE.seed)
    for sent in heapq.merge(*(drive.packets for drive in drives), key=lambda sent: sent.packet.order):
        cloud.apply(sent.packet)
    return cloud.finalize()


def maps_and_closures(result: FleetResult) -> tuple[int, int]:
    """The number of maps, and of accepted closures between robots."""
    accepted = (c for c in result.closures if c.status is ClosureStatus.ACCEPTED)
    between = sum(robot_of(closure.i.robot) != robot_of(closure.j.robot) for closure in accepted)
    return len({robot.map_index for robot in result.robots}), between


def rows_of(bags: Path, seed: int, pair: list[str], is_one: bool) -> list[tuple[object, ...]]:
    drives = [drive(name, bags / bag) for name, bag in zip(("anna", "ben"), pair, strict=True)]
    result = result_of(*drives)
    maps, closures = maps_and_closures(result)
    if not is_one:
        return [(", ".join(pair), maps, closures)]
    found, true, uplink = [], [], []
    for name, bag, driven in zip(("anna", "ben"), pair, drives, strict=True):
        stamps, poses = read_tum_6d(bags / f"{bag}.truth.tum")
        for robot in (robot for robot in result.robots if robot_of(robot.robot) == name):
            track = driven.tracks[robot.robot]
            assert robot.space is not None
            found.append(track.on_keyscans(robot.space.T_map_base))
            true.append(poses[np.abs(stamps[:, None] - track.stamps).argmin(axis=0)])
        uplink.append(sum(len(sent.data) for sent in driven.packets) / 1e3 / float(np.ptp(stamps)))
    errors = errors_of(np.concatenate(found), np.concatenate(true)) if maps == 1 else 4 * (float("nan"),)
    return [(seed, maps, closures, *errors, max(uplink))]


def errors_of(found: np.ndarray, true: np.ndarray) -> tuple[float, ...]:
    """Root mean square of the position errors, of those in the plane, the largest one, and the mean angle."""
    R_found, R_true = se3.rotation(found), se3.rotation(true)
    centred = found[:, :3] - found[:, :3].mean(axis=0), true[:, :3] - true[:, :3].mean(axis=0)
    u, _, v = np.linalg.svd(centred[1].T @ centred[0] + np.einsum("nij,nkj->ik", R_true, R_found))
    R = u @ np.diag((1.0, 1.0, np.linalg.det(u @ v))) @ v
    off = centred[0] @ R.T - centred[1]
    error, in_plane = np.linalg.norm(off, axis=1), np.hypot(*off[:, :2].T)
    cosine = (np.einsum("ij,njk,nik->n", R, R_found, R_true) - 1.0) / 2.0
    degrees = np.degrees(np.arccos(cosine.clip(-1.0, 1.0)))
    rms = [float(np.sqrt((values**2).mean())) for values in (error, in_plane)]
    return *rms, float(error.max()), float(degrees.mean())


if __name__ == "__main__":
    main()
