"""Two robots in one flat or on one floor end in one map; robots in equal flats, or at equal doors, do not."""

import numpy as np
import pytest

from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import LaserModel, ReasonCode
from fcslam.runs import separations
from tests.flats import BACK, ROUND, Drive, doors, flat, lookalike
from tests.lidar.worlds import box, path

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


LEFT = [(1.0, 1.0), (6.8, 1.2), (6.6, 4.8), (1.2, 5.0), (1.2, 2.6), (6.9, 3.0)]
"""Through the left room, and to the door of the right one."""


def storey(off_m):
    """Two rooms with furniture; the right one lies ``off_m`` farther up."""
    left = path((8, 2.6), (8, 0), (0, 0), (0, 6), (8, 6), (8, 3.4))
    right = path((8, 2.6), (8, 0 + off_m), (16, 0 + off_m), (16, 6 + off_m), (8, 6 + off_m), (8, 3.4))
    boxes = [
        (2.4, 2.0, 1.1, 0.6),
        (4.6, 0.1, 0.9, 0.5),
        (3.0, 5.3, 1.4, 0.6),
        (0.1, 3.4, 0.5, 0.9),
        (5.0, 3.2, 0.6, 0.6),
    ]
    beyond = [(11.0, 2.2, 0.8, 1.4), (14.8, 0.3, 1.1, 0.7), (12.6, 5.2, 1.6, 0.7), (9.0, 0.2, 0.7, 0.7)]
    moved = [(x, y + off_m, width, depth) for x, y, width, depth in beyond]
    return np.vstack((left, right, *(box(x, y, x + width, y + depth) for x, y, width, depth in (*boxes, *moved))))


def way(off_m):
    """A drive through both rooms and back."""
    right = [(9.0, 3.0), (10.2, 3.0 + off_m), (10.2, 1.2 + off_m), (13.6, 1.0 + off_m), (15.0, 3.6 + off_m)]
    return [*LEFT, *right, (10.4, 5.0 + off_m), (9.4, 3.0), (7.2, 3.0), (6.8, 1.2)]


def mapped(*offsets_m):
    drives = [
        Drive(name, way(off_m), storey(off_m), seed)
        for seed, (name, off_m) in enumerate(zip("ab", offsets_m, strict=True))
    ]
    return run_mission(drives, MissionConfig())


def test_floors_that_are_equal_in_part_stay_apart():
    """The left rooms are equal, and all closures there are right; the walls of the right ones contradict."""
    run = mapped(0.0, 1.5)
    assert maps_of(run) == {0, 1}
    (apart,) = separations(run)
    assert apart.reason.code is ReasonCode.MAPS_CONTRADICT
    assert run.joins == ()


def test_one_floor_is_one_map_and_its_evidence_is_said():
    run = mapped(0.0, 0.0)
    assert maps_of(run) == {0}
    (join,) = run.joins
    assert (join.robot_i, join.robot_j) == ("a", "b")
    assert join.places >= 3
    assert join.seen_m > 30.0
    assert join.contradicting_m < 0.005 * join.seen_m
    assert join.likeness > 0.7
    assert "m of wall seen by both, 0.0 m (0.0 %) contradict" in str(join)
