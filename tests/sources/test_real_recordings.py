"""Real recordings: the logs that the results are measured on, the published bags, and logs written as bags."""

import gzip
import os
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from fcslam.cli import main
from fcslam.sources import Fault, open_source, split, write_bag
from tests.sources.carmen_text import only_scans, scans_of

DATA = Path(os.environ.get("FCSLAM_DATA", "")) / "lidar"
pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif("FCSLAM_DATA" not in os.environ, reason="needs the real logs: set FCSLAM_DATA"),
]


@pytest.mark.parametrize(
    ("recording", "shape", "path_m", "duration_s", "laser_x_m"),
    [
        ("slam-benchmark/intel.clf.xz", (13631, 180), 508, 2691, 0.0),
        ("slam-benchmark/fr079.clf.xz", (4934, 360), 392, 1061, -0.04),
        ("slam-benchmark/mit-csail.clf.xz", (1988, 361), 374, 424, 0.0),
        ("ual-campus/ual_2014_05_23.clf.xz", (3318, 361), 524, 181, 2.0),
    ],
)
def test_recordings_hold_what_their_description_says(recording, shape, path_m, duration_s, laser_x_m):
    source = open_source(DATA / recording)
    survey = source.survey()
    assert (survey.scan_count, survey.lasers[0].beam_count) == shape
    assert survey.path_length_m == pytest.approx(path_m, rel=0.01)
    assert survey.duration_s == pytest.approx(duration_s, abs=1.0)
    assert survey.lasers[0].T_base_laser == pytest.approx((laser_x_m, 0.0, 0.0), abs=1e-4)
    assert len(scans_of(source)) == shape[0]


@pytest.mark.parametrize(("bag", "laser_x_m"), [("fr079", 0.04), ("mit-csail", 0.0)])
def test_published_bags_are_their_logs(bag, laser_x_m):
    source = open_source(DATA / f"rosbag1/{bag}.sort.bag")
    assert source.survey().lasers[0].T_base_laser == pytest.approx((laser_x_m, 0.0, 0.0), abs=1e-4)
    assert source.survey().notes == ()
    log = scans_of(open_source(DATA / f"slam-benchmark/{bag}.clf.xz"))
    apart = np.array([a.T_odom_base - b.T_odom_base for a, b in zip(scans_of(source), log, strict=True)])
    assert np.median(np.abs(apart)) < 0.01


@pytest.mark.parametrize(("log", "name"), [("intel", "run.bag"), ("fr079", "run.mcap"), ("mit-csail", "run.db3")])
def test_a_log_and_its_bag_are_the_same_to_the_last_bit(tmp_path, log, name):
    """Also where the clock runs backwards (intel), and with odometry between the scans (fr079)."""
    source = open_source(DATA / f"slam-benchmark/{log}.clf.xz")
    records = list(islice(source.records(), 3000))
    write_bag(tmp_path / name, records)
    bag = open_source(tmp_path / name)
    assert bag.survey().lasers[0] == source.survey().lasers[0]
    for before, after in zip(only_scans(records), scans_of(bag), strict=True):
        assert after.stamp == before.stamp
        assert after.T_odom_base.tolist() == before.T_odom_base.tolist()
        beyond = before.ranges_m >= before.laser.max_range_m
        np.testing.assert_array_equal(after.ranges_m, np.where(beyond, np.nan, before.ranges_m))
    assert bag.faults[Fault.TIME_REVERSAL].count == source.faults[Fault.TIME_REVERSAL].count


def test_a_published_bag_maps_well(tmp_path):
    assert main(["map", str(DATA / "rosbag1/mit-csail.sort.bag"), "--output", str(tmp_path / "run")]) == 0
    relations = DATA / "slam-benchmark/mit-csail.relations.gz"
    assert main(["evaluate", "relations", str(tmp_path / "run"), str(relations), "--csv", str(tmp_path / "e.csv")]) == 0
    rows = dict(line.split(",")[:2] for line in (tmp_path / "e.csv").read_text().splitlines())
    assert float(rows["translation_error_mean"]) < 0.03


def test_intel_goes_back_in_time():
    source = open_source(DATA / "slam-benchmark/intel.clf.xz")
    for _ in source.records():
        pass
    assert source.faults[Fault.TIME_REVERSAL].count == 631
    assert source.faults[Fault.TIME_REVERSAL].largest_s == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize("name", ["intel", "fr079", "mit-csail"])
def test_every_relation_names_a_scan(name):
    robots = split(open_source(DATA / f"slam-benchmark/{name}.clf.xz"), 3)
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
