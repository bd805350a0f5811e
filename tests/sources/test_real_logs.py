"""The logs that the results are measured on."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from fcslam.sources import Fault, open_source, split
from tests.sources.carmen_text import scans_of

DATA = Path(os.environ.get("FCSLAM_DATA", "")) / "lidar"
pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif("FCSLAM_DATA" not in os.environ, reason="needs the real logs: set FCSLAM_DATA"),
]


@pytest.mark.parametrize(
    ("log", "shape", "path_m", "duration_s", "laser_x_m"),
    [
        ("slam-benchmark/intel.clf.xz", (13631, 180), 508, 2691, 0.0),
        ("slam-benchmark/fr079.clf.xz", (4934, 360), 392, 1061, -0.04),
        ("slam-benchmark/mit-csail.clf.xz", (1988, 361), 374, 424, 0.0),
        ("ual-campus/ual_2014_05_23.clf.xz", (3318, 361), 524, 181, 2.0),
        ("wean-hall/robotdata1.log.gz", (713, 180), 41.2, 135, 0.25),
        ("wean-hall/robotdata2.log.gz", (2251, 180), 87.2, 240, 0.25),
    ],
)
def test_logs_hold_what_their_description_says(log, shape, path_m, duration_s, laser_x_m):
    source = open_source(DATA / log)
    survey = source.survey()
    assert (survey.scan_count, survey.lasers[0].beam_count) == shape
    assert survey.path_length_m == pytest.approx(path_m, rel=0.01)
    assert survey.duration_s == pytest.approx(duration_s, abs=1.0)
    assert survey.lasers[0].T_base_laser == pytest.approx((laser_x_m, 0.0, 0.0), abs=1e-4)
    assert len(scans_of(source)) == shape[0]


def test_intel_goes_back_in_time():
    source = open_source(DATA / "slam-benchmark/intel.clf.xz")
    for _ in source.records():
        pass
    assert source.faults[Fault.TIME_REVERSAL].count == 631
    assert source.faults[Fault.TIME_REVERSAL].largest_s == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize("name", ["intel", "fr079", "mit-csail"])
@pytest.mark.parametrize("parts", [1, 3])
def test_every_relation_names_a_scan(name, parts):
    source = open_source(DATA / f"slam-benchmark/{name}.clf.xz")
    robots = [source] if parts == 1 else split(source, parts)
    stamps = np.sort([scan.stamp for robot in robots for scan in scans_of(robot)])
    with gzip.open(DATA / f"slam-benchmark/{name}.relations.gz", "rt") as lines:
        named = np.array([line.split()[:2] for line in lines], dtype=np.float64).ravel()
    after = np.searchsorted(stamps, named).clip(1, len(stamps) - 1)
    distance = np.minimum(abs(stamps[after] - named), abs(stamps[after - 1] - named))
    assert distance.max() < 6e-6, "relations may be printed with five digits"


@pytest.mark.parametrize("log", sorted(DATA.glob("rbpf-corrected/*.log.gz")), ids=lambda path: path.name)
def test_logs_without_a_usable_clock_are_read(log):
    source = open_source(log)
    assert len(scans_of(source)) == source.survey().scan_count > 200
