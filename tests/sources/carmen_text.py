"""CARMEN lines made by hand, so that the reader is not tested against the project's own writer."""

import math
import tracemalloc
from collections.abc import Iterable
from pathlib import Path

import pytest

from fcslam.errors import SourceError
from fcslam.records import LaserScan, SensorRecord
from fcslam.sources import BagOptions, Source, open_source

BEAMS = 8


def flaser(stamp, base, laser=None, ranges=(1.0,) * BEAMS):
    words = [len(ranges), *ranges, *(laser or base), *base, stamp, "robot", 0.0]
    return "FLASER " + " ".join(map(str, words))


def robotlaser(stamp, base, config, ranges, remissions=()):
    words = [*config, len(ranges), *ranges, len(remissions), *remissions, *base, *base]
    return "ROBOTLASER1 " + " ".join(map(str, [*words, 0, 0, 0.1, 0.1, 0, stamp, "robot", 0.0]))


def odom(stamp, base):
    return "ODOM " + " ".join(map(str, [*base, 0, 0, 0, stamp, "robot", 0.0]))


def pose_at(step):
    """A robot on its way along a curve."""
    return (round(0.1 * step, 6), round(math.sin(0.05 * step), 6), round(0.03 * step, 6))


def drive(scans, start_stamp=100.0, beams=BEAMS):
    """A healthy log of two lines a step: odometry, then the scan."""
    lines = []
    for step in range(scans):
        stamp = start_stamp + 0.2 * step
        ranges = tuple(round(1.0 + 0.01 * step + 0.1 * beam, 3) for beam in range(beams))
        lines += [odom(stamp - 0.05, pose_at(step)), flaser(stamp, pose_at(step), ranges=ranges)]
    return lines


def save(path: Path, lines: Iterable[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def peak_of(source: Source) -> int:
    """Bytes of memory that a pass over a recording takes at most."""
    source.survey()
    tracemalloc.start()
    for _ in source.records():
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def refusal(path: Path | str, options: BagOptions | None = None) -> str:
    """The line that refuses a recording before any record is read."""
    with pytest.raises(SourceError) as caught:
        open_source(path, options).survey()
    message = str(caught.value)
    assert "\n" not in message
    assert any(part in message for part in str(path).split(","))
    assert ";" in message, "says nothing on what to do"
    return message


def scans_of(source: Source) -> list[LaserScan]:
    return only_scans(source.records())


def only_scans(records: Iterable[SensorRecord]) -> list[LaserScan]:
    return [record for record in records if isinstance(record, LaserScan)]
