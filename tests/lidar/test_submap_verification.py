"""Two submaps of one room are the same place, two rooms are not; an undecidable case gets no decision."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.submap import (
    FREE_CELL_M,
    SPACING_M,
    Agreement,
    agreement,
    build_submap,
    self_violation,
)
from fcslam.lidar.verification import (
    CLOSURE_SIGMA_M,
    CLOSURE_SIGMA_RAD,
    Aligned,
    _information_of_inverse,
    judge,
    verify,
)
from fcslam.records import ReasonCode
from tests.lidar.worlds import bare_scan, box, corridor, other_room, ring, room, scan_at


def submap_along(waypoints, walls, seed, person=lambda _: np.zeros((0, 4))):
    """Submap of a drive, in the base of its middle pose, and that pose; with a ``person`` at each number of a scan."""
    rng = np.random.default_rng(seed)
    poses = [np.array(pose) for pose in waypoints]
    anchor = poses[len(poses) // 2]
    scans = []
    for k, pose in enumerate(poses):
        scan = scan_at(pose, np.vstack((walls, person(k))), noise_m=0.01, rng=rng)
        scans.append((scan, se2.between(anchor, pose)))
    return build_submap(scans), anchor


WEST = [(-2.0 + 0.3 * k, -1.0 + 0.1 * k, 0.2 * k) for k in range(9)]
EAST = [(1.5 - 0.3 * k, 1.2 - 0.2 * k, 2.5 - 0.1 * k) for k in range(9)]


@pytest.fixture(scope="module")
def same_room():
    return submap_along(WEST, room(), 0), submap_along(EAST, room(), 1)


def test_the_same_room_from_two_drives_is_verified(same_room):
    (a, anchor_a), (b, anchor_b) = same_room
    truth = se2.between(anchor_a, anchor_b)
    for offset in ((0.0, 0.0, 0.0), (0.25, -0.2, 0.08), (-0.2, 0.2, -0.08)):
        found = verify(a, b, se2.compose(truth, offset))
        assert found.strict
        assert found.loose
        assert found.informative
        assert found.reason.code is ReasonCode.VERIFIED
        rest = se2.between(truth, found.T_a_b)
        assert np.hypot(rest[0], rest[1]) < 0.03
        assert abs(rest[2]) < np.deg2rad(0.3)


def test_both_orders_give_inverse_poses(same_room):
    (a, anchor_a), (b, anchor_b) = same_room
    guess = se2.compose(se2.between(anchor_a, anchor_b), (0.15, -0.1, 0.05))
    there, back = verify(a, b, guess), verify(b, a, se2.inverse(guess))
    rest = se2.compose(there.T_a_b, back.T_a_b)
    assert np.hypot(rest[0], rest[1]) < 0.01
    assert abs(rest[2]) < np.deg2rad(0.1)
    assert (there.strict, there.loose, there.informative) == (back.strict, back.loose, back.informative)


def test_the_information_is_symmetric_positive_and_no_better_than_the_floor(same_room):
    (a, anchor_a), (b, anchor_b) = same_room
    information = verify(a, b, se2.between(anchor_a, anchor_b)).information
    np.testing.assert_array_equal(information, information.T)
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.all(sigma >= np.array([CLOSURE_SIGMA_M, CLOSURE_SIGMA_M, CLOSURE_SIGMA_RAD]) - 1e-12)
    assert sigma[0] < 0.1


@pytest.mark.parametrize("guess", [(0.0, 0.0, 0.0), (0.5, 0.3, 0.4), (-1.0, 0.2, -1.2), (0.2, 0.8, 3.0)])
def test_two_different_rooms_are_not_the_same_place(guess):
    a, _ = submap_along(WEST, room(), 0)
    b, _ = submap_along(EAST, other_room(), 1)
    found = verify(a, b, np.array(guess))
    assert not found.loose
    assert not found.strict
    assert found.reason.code is not ReasonCode.VERIFIED


def test_what_has_little_or_nothing_in_common_is_not_the_same_place(same_room):
    empty = build_submap([(bare_scan([]), np.zeros(3))])
    a, anchor_a = submap_along([(1.5 + 0.2 * k, 1.5, 0.0) for k in range(5)], ring(), 0)
    b, anchor_b = submap_along([(14.5, 10.5 - 0.2 * k, 3.0) for k in range(5)], ring(), 1)
    for one, other, guess in ((same_room[0][0], empty, np.zeros(3)), (a, b, se2.between(anchor_a, anchor_b))):
        found = verify(one, other, guess)
        assert not found.loose
        assert np.isfinite(found.information).all()


def test_a_room_against_itself_turned_around_is_not_the_same_place(same_room):
    (a, anchor_a), (b, anchor_b) = same_room
    turned = se2.compose(se2.compose(se2.inverse(anchor_a), (0, 0, np.pi)), anchor_b)
    assert not verify(a, b, turned).loose


@pytest.mark.parametrize("heading", [0.0, 1.0])
def test_a_bare_corridor_is_not_informative(heading):
    """Wherever along it one lays the other, it fits: that must be said, and its information must say it too."""
    turned = np.array([0.0, 0.0, heading])

    def along(offset_m, facing, seed):
        line = [np.array([x, 0.1 * np.sin(x), facing + 0.1 * np.cos(x)]) for x in np.arange(-3, 3.1, 0.3) + offset_m]
        return submap_along([se2.compose(turned, pose) for pose in line], corridor(heading), seed)

    (a, anchor_a), (b, anchor_b) = along(0.0, 0.0, 0), along(2.0, 1.9, 1)
    found = verify(a, b, se2.between(anchor_a, anchor_b))
    assert not found.informative
    assert found.reason.code is not ReasonCode.VERIFIED
    values, vectors = np.linalg.eigh(found.information[:2, :2])
    axis = se2.transform((0, 0, heading - anchor_b[2]), np.array([[1.0, 0.0]]))[0]
    assert abs(vectors[:, 0] @ axis) > 0.98
    assert values[0] < 0.5 * values[1]


def test_free_space_is_what_beams_crossed():
    """Every cell said to be free lies inside the room, off its walls; most of the room is."""
    walls = box(-4, -3, 4, 3)
    submap, anchor = submap_along([(-1.0, 0.0, 0.0), (0.0, 0.0, 0.5), (1.0, 0.5, 1.0)], walls, 0)
    rows, columns = np.nonzero(submap.free)
    centres = submap.free_corner + (np.column_stack((columns, rows)) + 0.5) * FREE_CELL_M
    inside = np.abs(se2.transform(anchor, centres))
    assert inside[:, 0].max() < 4 - 0.05
    assert inside[:, 1].max() < 3 - 0.05
    assert len(rows) * FREE_CELL_M**2 > 0.8 * 7.6 * 5.6


def test_a_box_moved_into_free_space_violates():
    walls = box(-4, -3, 4, 3)
    a, _ = submap_along([(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0)], walls, 0)
    b, _ = submap_along([(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0)], np.vstack((walls, box(1.5, 1, 2.5, 2))), 1)
    found = agreement(b, a, np.zeros(3))
    share = 1.4 / SPACING_M / len(b.surface)  # the faces seen, about
    assert found.violation > 0.5 * share
    assert agreement(a, a, np.zeros(3)).violation == 0.0
    assert agreement(a, a, np.zeros(3)).explained == 1.0


def test_a_submap_of_a_noisy_scanner_contradicts_itself():
    """Ranges that are long in every second scan put its walls behind those of the others, and theirs into its space."""

    def scans(stretch):
        rng = np.random.default_rng(4)
        found = [(scan_at(np.array(pose), room(), noise_m=0.01, rng=rng), np.array(pose)) for pose in WEST]
        return [
            (replace(scan, points=scan.points * (1.0 + stretch * (k % 2))), pose)
            for k, (scan, pose) in enumerate(found)
        ]

    assert self_violation(scans(0.0)) < 0.01
    assert self_violation(scans(0.15)) > 0.05
    assert self_violation(scans(0.15)[:1]) == 0.0


@pytest.mark.parametrize(("violation", "predicted"), [(0.08, False), (0.15, True)])
def test_noise_is_measured_for_the_gate_that_decides(violation, predicted):
    """0.08 is too much for the strict gate without noise, 0.15 for the loose one."""
    free = Agreement(0.9, violation, 600, 0.9, 100.0 * np.eye(3))
    aligned = Aligned(np.zeros(3), np.eye(3), free, np.zeros(3))
    asked = []
    noise = lambda: asked.append(1) or 0.2  # noqa: E731
    decided, other = (judge(aligned, noise, each) for each in (predicted, not predicted))
    assert len(asked) == 1
    assert (decided.strict, decided.loose) == (not predicted, True)
    assert (other.strict, other.loose) == (False, not predicted)
    much = aligned._replace(worse=replace(free, violation=0.11))
    assert not judge(much, lambda: 1.0, False).strict, "no scanner is allowed much"


def walker(stride_m):
    """Somebody who walks beside a robot that drives ``WEST``."""
    return lambda k: box(-1.6 + stride_m * k, 1.4, -1.3 + stride_m * k, 1.8)


def test_somebody_who_walks_by_leaves_no_trace(same_room):
    """Where one scan had a return and many others looked through, nothing stands; the walls lose next to nothing."""
    quiet, _ = submap_along(WEST, room(), 3)
    walked, anchor = submap_along(WEST, room(), 3, walker(0.35))
    where = se2.transform(anchor, walked.surface.points)
    trail = (where[:, 0] > -1.8) & (where[:, 0] < 1.8) & (where[:, 1] > 1.3) & (where[:, 1] < 1.9)
    assert trail.mean() < 0.02
    assert len(walked.surface) > 0.9 * len(quiet.surface)
    other, anchor_other = same_room[1]
    assert verify(walked, other, se2.between(anchor, anchor_other)).strict


def test_somebody_who_stands_is_part_of_the_place():
    stood, anchor = submap_along(WEST, room(), 3, walker(0.0))
    where = se2.transform(anchor, stood.surface.points)
    assert (np.hypot(where[:, 0] + 1.45, where[:, 1] - 1.6) < 0.4).sum() >= 5


def test_along_a_bare_corridor_only_a_prior_holds():
    """Matched keypoints say where along the corridor two places lie; the walls neither confirm nor move it."""
    along = [(0.3 * k, 0.1, 0.0) for k in range(8)]
    back = [(1.5 - 0.3 * k, -0.1, 3.1) for k in range(8)]
    (a, at_a), (b, at_b) = submap_along(along, corridor(), 4), submap_along(back, corridor(), 5)
    truth = se2.between(at_a, at_b)
    prior = np.diag((400.0, 400.0, 2000.0))
    blind, seeing = verify(a, b, truth), verify(a, b, truth, prior)
    assert not blind.informative
    assert not seeing.informative, "what repeats along a corridor repeats in images, too"
    off = se2.between(truth, seeing.T_a_b)
    assert np.hypot(off[0], off[1]) < 0.05


def test_where_walls_hold_a_false_prior_hardly_moves(same_room):
    (a, at_a), (b, at_b) = same_room
    truth = se2.between(at_a, at_b)
    shifted = truth + np.array([0.15, -0.1, 0.0])
    found = verify(a, b, shifted, np.diag((400.0, 400.0, 2000.0)))
    off = se2.between(truth, found.T_a_b)
    assert np.hypot(off[0], off[1]) < 0.05


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (2.0, -1.0, 0.7), (-3.0, 4.0, -2.5)])
def test_information_of_the_inverse_pose(pose):
    """Against samples: poses drawn with an information, inverted, spread as the information of the inverse says."""
    information = np.array([[900.0, 100.0, 50.0], [100.0, 400.0, -30.0], [50.0, -30.0, 2500.0]])
    rng = np.random.default_rng(0)
    drawn = np.array(pose) + rng.multivariate_normal(np.zeros(3), np.linalg.inv(information), 200_000)
    spread = np.cov((se2.inverse(drawn) - se2.inverse(pose)).T)
    expected = np.linalg.inv(_information_of_inverse(information, np.array(pose)))
    assert np.allclose(spread, expected, rtol=0.1, atol=0.05 * np.abs(expected).max())
