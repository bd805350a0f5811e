"""Writes scans and odometry to a CARMEN log."""

import bz2
import gzip
import lzma
import math
from collections.abc import Iterable, Iterator
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fcslam.errors import OutputError
from fcslam.geometry import se2
from fcslam.records import LaserModel, LaserScan, Odometry, SensorRecord
from fcslam.sources.gate import SCANS_THAT_VOTE
from fcslam.sources.logs.laser import assumed_laser

_HEADER = """\
# CARMEN Logfile
# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp
"""
_SIMULATED = 3
"""ROBOTLASER1's ``type`` of a laser that CARMEN does not know."""


def write_carmen(path: Path, records: Iterable[SensorRecord]) -> None:
    """Write ``records`` to ``path``, compressed if its suffix is .gz, .xz or .bz2; equal records give equal bytes.

    Ranges have millimetre precision, poses and stamps 1e-6; no return (inf) is written as a value just above the
    laser's maximum. A laser with the default geometry of its beam count is written as FLASER, any other as ROBOTLASER1,
    and so is one whose beams vary. Images, the scans of further lasers and the times of beams are dropped: there is no
    place for them. Unknown odometry is written as zeros, which readers take for none as it never changes.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        with path.open("wb") as file, closing(_compressed(file, path.suffix)) as stream:
            stream.write(_HEADER.encode())
            for line in _lines(records):
                stream.write((line + "\n").encode())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error}); choose another folder") from error


def _compressed(file: BinaryIO, suffix: str) -> BinaryIO | gzip.GzipFile | lzma.LZMAFile | bz2.BZ2File:
    match suffix:
        case ".gz":
            return gzip.GzipFile("", "wb", fileobj=file, mtime=0)
        case ".xz":
            return lzma.LZMAFile(file, "wb")
        case ".bz2":
            return bz2.BZ2File(file, "wb")
        case _:
            return file


def _lines(records: Iterable[SensorRecord]) -> Iterator[str]:
    remaining = iter(records)
    first, scans = list[SensorRecord](), list[LaserScan]()
    while len(scans) < SCANS_THAT_VOTE and (record := next(remaining, None)) is not None:
        first.append(record)
        if isinstance(record, LaserScan) and record.laser.T_base_laser == (scans or [record])[0].laser.T_base_laser:
            scans.append(record)
    laser = scans[0].laser if scans else None
    is_default = all(scan.laser == _default(scan.laser) == laser for scan in scans)
    for record in chain(first, remaining):
        match record:
            case Odometry():
                yield _line(record)
            case LaserScan() if laser is not None and record.laser.T_base_laser == laser.T_base_laser:
                yield _line(record, is_default and record.laser == laser)


def _default(laser: LaserModel) -> LaserModel:
    return LaserModel(laser.beam_count, *assumed_laser(laser.beam_count), laser.T_base_laser)


def _line(record: LaserScan | Odometry, is_default: bool = False) -> str:
    """``is_default``: the laser of a scan needs no mention."""
    match record:
        case Odometry(stamp, T_odom_base):
            return f"ODOM {_numbers(T_odom_base)} 0 0 0 {_tail(stamp)}"
        case LaserScan(stamp, ranges_m, laser, T_odom_base):
            poses = f"{_numbers(se2.compose(T_odom_base, laser.T_base_laser))} {_numbers(T_odom_base)}"
            ranges = _ranges(ranges_m, laser.max_range_m)
            if is_default:
                return f"FLASER {ranges} {poses} {_tail(stamp)}"
            return f"ROBOTLASER1 {_config(laser)} {ranges} 0 {poses} 0 0 0 0 0 {_tail(stamp)}"


def _config(laser: LaserModel) -> str:
    fov_rad = (laser.beam_count - 1) * laser.angle_increment_rad
    numbers = (laser.angle_min_rad, fov_rad, laser.angle_increment_rad, laser.max_range_m, 0.0)
    return f"{_SIMULATED} {' '.join(repr(float(number)) for number in numbers)} 0"


def _ranges(ranges_m: np.ndarray, max_range_m: float) -> str:
    no_return_m = math.ceil(max_range_m * 1000.0 + 1.0) / 1000.0
    written = np.where(np.isposinf(ranges_m), no_return_m, ranges_m).tolist()
    return f"{len(written)} {' '.join(f'{value:.3f}' for value in written)}"


def _numbers(pose: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in np.nan_to_num(pose).tolist())


def _tail(stamp: float) -> str:
    return f"{stamp:.6f} fcslam {stamp:.6f}"
