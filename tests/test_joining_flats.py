"""Two robots in one flat end in one map; robots in equal flats, or behind equal doors, do not."""

import numpy as np
import pytest

from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import LaserModel, ReasonCode
from fcslam.runs import separations
from tests.flats import BACK, ROUND, Drive, doors, flat, lookalike

pytestmark = pytest.mark.slow


def maps_of(run):
    return {trajectory.map_index for trajectory in run.trajectories.values()}


def with_starts(starts):
    return MissionConfig(fleet=FleetConfig(starts={name: tuple(pose) for name, pose in starts.items()}))


def test_robots_that_met_in_one_flat_share_a_map():
    one, other = Drive("a", ROUND, flat(), 0), Drive("b", BACK, flat(), 1)
    run = run_mission([one, other], MissionConfig())
    assert maps_of(run) == {0}
    starts = (run.trajectories[drive.name].T_map_base[0] for drive in (one, other))
    assert np.allclose(se2.between(*starts), se2.between(one.poses[0], other.poses[0]), atol=0.05)


def test_one_unmistakable_spot_is_enough():
    turn = [(4.4, 3.0), (2.6, 3.6), (1.4, 3.0), (2.5, 2.2), (4.3, 2.9)]
    run = run_mission([Drive("a", turn, flat(), 0), Drive("b", turn[::-1], flat(), 1)], MissionConfig())
    assert maps_of(run) == {0}


WAYS = [(1.2, 1.3), (3.0, 1.2), (3.0, 2.0)], [(3.0, 2.6), (1.3, 1.5), (3.0, 1.7)]
"""Too short for a laser of 2.7 m: no closure has enough points."""
NEAR = LaserModel(180, -np.pi, np.pi / 90, 2.7)


@pytest.mark.parametrize(
    ("off", "maps"),
    [(None, {0, 1}), ((0.3, -0.2, 0.1), {0}), ((2.5, 0.0, 0.0), {0, 1}), ((0.0, 0.0, 1.5), {0, 1})],
    ids=["none", "right", "wrong place", "wrong heading"],
)
def test_known_starts_join_robots_that_saw_little_together_and_wrong_ones_nothing(off, maps):
    one, other = (Drive(name, way, flat(), laser=NEAR) for name, way in zip("ab", WAYS, strict=True))
    starts = {} if off is None else {"a": one.poses[0], "b": other.poses[0] + off}
    run = run_mission([one, other], with_starts(starts))
    assert maps_of(run) == maps
    if maps == {0}:
        first = (run.trajectories[drive.name].T_map_base[0] for drive in (one, other))
        assert np.allclose(se2.between(*first), se2.between(one.poses[0], other.poses[0]), atol=0.05)


@pytest.mark.parametrize(("way", "starts"), [(BACK, {}), (ROUND, dict.fromkeys("ab", (0.0, 0.0, 0.0)))])
def test_flats_with_equal_walls_and_other_furniture_stay_apart_whatever_the_starts(way, starts):
    drives = [Drive("a", ROUND, flat(), 0), Drive("b", way, lookalike(), 1)]
    assert maps_of(run_mission(drives, with_starts(starts))) == {0, 1}


@pytest.fixture(scope="module")
def far_apart():
    """Two robots in one corridor that never met."""
    ways = {"a": [(4.0, 0.0), (10.0, 0.1), (5.0, 0.0)], "b": [(26.0, 0.0), (32.0, 0.1), (27.0, 0.0)]}
    return [Drive(name, way, doors()) for name, way in ways.items()]


@pytest.mark.parametrize("starts", [{}, dict.fromkeys("ab", (0.0, 0.0, 0.0))], ids=["unknown", "wrong"])
def test_robots_at_different_doors_of_a_corridor_stay_apart(far_apart, starts):
    """Every door fits every other, also that of a wrong start, and the last line names this."""
    run = run_mission(far_apart, with_starts(starts))
    assert maps_of(run) == {0, 1}
    (apart,) = separations(run)
    assert apart.reason is not None
    assert apart.reason.code in (ReasonCode.LOOK_ALIKE, ReasonCode.NOT_INFORMATIVE)
