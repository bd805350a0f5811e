"""Recordings that measure nothing, or not in metres, and values that are no ranges; honest scans pass."""

import math

import numpy as np
import pytest

from fcslam.sources import open_source
from tests.lidar.worlds import box, cast
from tests.sources.bag_messages import mounted, odom, save, scan
from tests.sources.carmen_text import flaser, refusal, scans_of
from tests.sources.carmen_text import save as save_log

BEAMS = 120


def pose(step):
    return (round(-1.5 + 0.08 * step, 3), round(0.5 * math.sin(0.2 * step), 3), round(0.1 * step, 3))


def ranges(step, quantum=0.001):
    """Ranges in a room of 4.4 m x 7.4 m."""
    x, y, heading = pose(step)
    walls = cast((x, y), heading + np.linspace(-np.pi / 2, np.pi / 2, BEAMS), box(-2.2, -3.7, 2.2, 3.7))
    return np.round(walls / quantum) * quantum


def bag(path, change=lambda _, values: values, pose=pose, scans=40, **limits):
    said = [mounted(99.0)]
    for step in range(scans):
        values = tuple(change(step, ranges(step)))
        fields = {"angle_min": -math.pi / 2, "angle_increment": math.pi / (BEAMS - 1), "range_max": 12.0, **limits}
        said += [odom(100.0 + step, pose(step)), scan(100.0 + step, values, **fields)]
    return save(path, said)


@pytest.mark.parametrize(("measuring", "percent"), [(0, "0.0"), (1, "0.8")])
@pytest.mark.parametrize("value", [0.0, math.inf, math.nan, 12.0, 65.535, 0.05, -1.0])
def test_a_covered_laser_is_refused(tmp_path, value, measuring, percent):
    message = refusal(
        bag(tmp_path / "run.bag", lambda _, values: np.append(values[:measuring], [value] * (BEAMS - measuring)))
    )
    assert f"only {percent}% of the beams of /scan measure a range (0.1 m to 12 m) in" in message


@pytest.mark.parametrize("factor", [1000.0, 100.0])
@pytest.mark.parametrize("recorded", ["scaled limits", "limits in metres", "log"])
def test_other_units_are_refused(tmp_path, factor, recorded):
    limits = {"range_max": 12.0 * factor, "range_min": 0.1 * factor} if recorded == "scaled limits" else {}
    if recorded == "log":
        lines = [flaser(k, pose(k), ranges=tuple(np.round(ranges(k) * factor))) for k in range(40)]
        message = refusal(save_log(tmp_path / "run.log", lines))
    else:
        message = refusal(bag(tmp_path / "run.mcap", lambda _, values: values * factor, **limits))
    assert "they seem to be in another unit" in message


@pytest.mark.parametrize("strength", [9.0, 60.0, 900.0])
def test_intensities_in_place_of_ranges_are_refused(tmp_path, strength):
    """A return is weaker from afar, and its intensity is a whole number."""
    message = refusal(bag(tmp_path / "run.bag", lambda _, values: np.ceil(strength / np.maximum(values, 0.5))))
    assert "intensities" in message


def missing(step, values, value, share=0.4):
    """``value`` in a part of the beams that differs from scan to scan."""
    return np.where(np.random.default_rng(step).random(len(values)) < share, value, values)


@pytest.mark.parametrize("value", [10.0, 0.15, 1.0, 5.6])
def test_a_placeholder_is_no_range(tmp_path, value):
    source = open_source(bag(tmp_path / "run.bag", lambda step, values: missing(step, values, value)))
    assert f"{value:g} m repeats exactly in many beams of /scan everywhere, so it is not a range" in " ".join(
        source.survey().notes
    )
    for step, one in enumerate(scans_of(source)):
        real = ~(missing(step, ranges(step), value) == value)
        np.testing.assert_array_equal(np.isnan(one.ranges_m), ~real)
        np.testing.assert_allclose(one.ranges_m[real], ranges(step)[real], atol=1e-5)


def test_a_placeholder_in_a_log_is_no_range(tmp_path):
    lines = [flaser(k, pose(k), ranges=tuple(missing(k, ranges(k), 10.0))) for k in range(40)]
    source = open_source(save_log(tmp_path / "run.log", lines))
    assert "10 m repeats exactly in many beams everywhere" in " ".join(source.survey().notes)
    assert np.isnan(scans_of(source)[0].ranges_m).sum() == (missing(0, ranges(0), 10.0) == 10.0).sum()


def posts(step, values):
    """Posts near the laser, and no return or codes for it beside them."""
    at = np.arange(BEAMS) + step
    near = np.where(at % 9 == 0, 0.11 + 0.001 * (at % 40), values)
    return np.where(at % 9 == 1, 11.9, near)


def along_a_wall(*_):
    """A corridor of 1.6 m: from its middle all scans are the same, to 5 cm."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, BEAMS)
    with np.errstate(divide="ignore"):
        return np.minimum(np.round(0.8 / np.abs(np.sin(angles)) / 0.05) * 0.05, 9.0 + 0.02 * np.arange(BEAMS))


HONEST = {
    "steps of 1 mm": (lambda step, _: ranges(step, 0.001), pose),
    "steps of 10 cm": (lambda step, _: ranges(step, 0.1), pose),
    "a robot at rest": (lambda *_: ranges(0, 0.01), lambda _: pose(0)),
    "along a wall": (along_a_wall, lambda step: (0.4 * step, 0.0, 0.0)),
    "a hall wider than the laser sees": (lambda step, values: missing(step, values, math.inf, 0.9), pose),
    "near things before far ones": (posts, pose),
}


@pytest.mark.parametrize(("change", "pose"), HONEST.values(), ids=HONEST)
def test_honest_scans_pass_as_they_are(tmp_path, change, pose):
    source = open_source(bag(tmp_path / "run.bag", change, pose))
    assert source.survey().scan_count == 40
    if change is not posts:  # their codes may be taken for placeholders
        assert not source.survey().notes
        assert not any(np.isnan(one.ranges_m).any() for one in scans_of(source))
