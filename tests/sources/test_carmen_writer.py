import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.errors import OutputError
from fcslam.records import LaserModel, LaserScan, Odometry, frozen
from fcslam.sources import open_source, write_carmen
from tests.sources.carmen_text import pose_at

SICK = LaserModel(181, -90 * math.radians(1.0), math.radians(1.0), 50.0, (0.25, 0.0, 0.0))
ROUND = LaserModel(12, -math.pi, math.tau / 12, 12.5, (-0.1, 0.05, 0.4))

coordinates = st.floats(-1000, 1000)
poses = st.tuples(coordinates, coordinates, st.floats(-3.1, 3.1))
ranges = st.one_of(st.floats(0, 60, width=32), st.just(math.nan), st.just(math.inf))


@st.composite
def recordings(draw):
    laser = draw(st.sampled_from([SICK, ROUND]))
    records = []
    for step in range(draw(st.integers(2, 8))):
        pose, stamp = frozen(draw(poses)), 1e9 + step + draw(st.floats(0, 0.9))
        if draw(st.booleans()):
            records.append(Odometry(stamp, pose))
        values = draw(st.lists(ranges, min_size=4, max_size=4))
        filled = np.resize(np.array(values, dtype=np.float32), laser.beam_count)
        records.append(LaserScan(stamp, frozen(filled, np.float32), laser, pose))
    return records


@pytest.mark.slow
@settings(max_examples=60)
@given(recordings(), st.sampled_from(["", ".gz", ".xz", ".bz2"]))
def test_what_is_written_reads_back_equal(tmp_path_factory, records, suffix):
    path = tmp_path_factory.mktemp("log") / f"fleet.log{suffix}"
    write_carmen(path, records)
    source = open_source(path)
    read = list(source.records())
    assert [type(record) for record in read] == [type(record) for record in records]
    for before, after in zip(records, read, strict=True):
        assert after.stamp == pytest.approx(before.stamp, abs=6e-7)
        np.testing.assert_allclose(after.T_odom_base, before.T_odom_base, atol=6e-7)
        if isinstance(before, LaserScan):
            assert_same_laser(after.laser, before.laser)
            assert_same_ranges(after.ranges_m, before.ranges_m, before.laser.max_range_m)


def assert_same_laser(read, written):
    assert (read.beam_count, read.max_range_m) == (written.beam_count, written.max_range_m)
    np.testing.assert_array_equal(read.angles_rad(), written.angles_rad())
    np.testing.assert_allclose(read.T_base_laser, written.T_base_laser, atol=1e-9)


def assert_same_ranges(read, written, max_range_m):
    no_return = np.isinf(written)
    assert (read[no_return] > max_range_m).all()
    np.testing.assert_allclose(read[~no_return], written[~no_return], atol=6e-4)


@pytest.mark.parametrize("suffix", ["", ".gz", ".xz", ".bz2"])
def test_equal_records_give_equal_bytes(tmp_path, suffix):
    scans = [LaserScan(k, frozen(np.full(12, 2.0), np.float32), ROUND, frozen(pose_at(k))) for k in range(3)]
    paths = [tmp_path / f"{name}.log{suffix}" for name in "ab"]
    for path in paths:
        write_carmen(path, scans)
    assert paths[0].read_bytes() == paths[1].read_bytes()


@pytest.mark.parametrize(("laser", "message"), [(SICK, "FLASER"), (ROUND, "ROBOTLASER1")])
def test_the_older_message_is_used_where_it_says_enough(tmp_path, laser, message):
    scan = LaserScan(0.0, frozen(np.ones(laser.beam_count), np.float32), laser, frozen(pose_at(0)))
    write_carmen(tmp_path / "run.log", [scan])
    assert (tmp_path / "run.log").read_text().splitlines()[-1].startswith(message)


def test_a_file_that_cannot_be_written_is_reported(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        write_carmen(tmp_path / "missing" / "run.log.gz", [])
