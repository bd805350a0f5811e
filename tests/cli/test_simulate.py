"""`fcslam tools simulate`: recordings that the other commands read, and one clear line for what cannot be."""

import numpy as np
import pytest

from fcslam.cli import main
from fcslam.records import LaserScan, Odometry
from fcslam.runs import read_tum
from fcslam.sources import open_source

pytestmark = pytest.mark.slow

TINY = ["tools", "simulate", "--building", "flat", "--path-length", "6", "--seed", "3"]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Two robots without cameras."""
    output = tmp_path_factory.mktemp("simulated") / "fleet"
    assert main([*TINY, "--robots", "2", "--no-camera", "--output", str(output)]) == 0
    return output


def test_recordings_can_be_read_and_the_truth_lies_beside_them(simulated):
    for name in ("robot_1", "robot_2"):
        scans = [record for record in open_source(simulated / name).records() if isinstance(record, LaserScan)]
        stamps, poses = read_tum(simulated / name / "ground_truth.tum")
        np.testing.assert_allclose([scan.stamp for scan in scans], stamps, atol=1e-9)
        path_m = np.sum(np.hypot(*np.diff(poses[:, :2], axis=0).T))
        assert path_m == pytest.approx(6.0, abs=0.1)
    assert sorted(path.name for path in (simulated / "ground_truth").iterdir()) == ["map.pgm", "map.yaml"]


def test_a_scanner_is_as_asked_and_a_file_overrides_it(tmp_path):
    file = tmp_path / "other.yaml"
    file.write_text("{lidar: {beams: 100, rate_hz: 5, max_range_m: 8}, turn_rate_rad_s: 1}")
    tiny = [*TINY, "--path-length", "2", "--robots", "1", "--no-camera", "--scanner", "ld19"]
    changes = ["--config", str(file), "--config", "turn_rate_rad_s=2", "--odometry", "none"]
    for name, options, expected in (("ld19", [], (450, 12.0, 0.1)), ("other", changes, (100, 8.0, 0.2))):
        assert main([*tiny, *options, "--output", str(tmp_path / name)]) == 0
        records = list(open_source(tmp_path / name / "robot_1").records())
        scan = next(record for record in records if isinstance(record, LaserScan))
        period_s = scan.sweep.duration_s * scan.laser.beam_count / (scan.laser.beam_count - 1)
        assert (scan.laser.beam_count, scan.laser.max_range_m, period_s) == pytest.approx(expected)
        assert any(isinstance(record, Odometry) for record in records) is not bool(options)
    assert "turn_rate_rad_s: 2.0" in (tmp_path / "other" / "simulation.yaml").read_text(encoding="utf-8")
