"""Writes scans to CARMEN logs, for tests that map them."""

import bz2
import gzip
import lzma
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from fcslam.geometry import se2
from fcslam.records import LaserScan, Odometry, SensorRecord
from fcslam.sources.logs.laser import assumed_laser

COMPRESS = {".gz": gzip.compress, ".xz": lzma.compress, ".bz2": bz2.compress}


def write_carmen(path: Path, records: Iterable[SensorRecord]) -> None:
    """Write odometry and scans of one laser; scans are FLASER lines if all have the usual angles, else ROBOTLASER1."""
    kept = [record for record in records if isinstance(record, LaserScan | Odometry)]
    scans = [record for record in kept if isinstance(record, LaserScan)]
    usual = len({scan.laser for scan in scans}) == 1
    if usual:
        laser = scans[0].laser
        usual = replace(laser, T_base_laser=(0.0, 0.0, 0.0)) == assumed_laser(laser.beam_count)
    text = "".join(f"{_line(record, usual)}\n" for record in kept)
    path.write_bytes(COMPRESS.get(path.suffix, bytes)(text.encode()))


def _line(record: LaserScan | Odometry, usual: bool) -> str:
    time = f"{record.stamp:.6f} test {record.stamp:.6f}"
    if isinstance(record, Odometry):
        return f"ODOM {_numbers(record.T_odom_base)} 0 0 0 {time}"
    laser = record.laser
    no_return_m = math.ceil(laser.max_range_m * 1000.0 + 1.0) / 1000.0
    ranges = [f"{value:.3f}" for value in np.where(np.isposinf(record.ranges_m), no_return_m, record.ranges_m).tolist()]
    poses = f"{_numbers(se2.compose(record.T_odom_base, laser.T_base_laser))} {_numbers(record.T_odom_base)}"
    if usual:
        return f"FLASER {len(ranges)} {' '.join(ranges)} {poses} {time}"
    geometry = (laser.angle_min_rad, laser.beams.span_rad, laser.angle_increment_rad, laser.max_range_m, 0.0)
    stated = " ".join(repr(float(number)) for number in geometry)
    return f"ROBOTLASER1 3 {stated} 0 {len(ranges)} {' '.join(ranges)} 0 {poses} 0 0 0 0 0 {time}"


def _numbers(pose: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in np.nan_to_num(pose).tolist())
