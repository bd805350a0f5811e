"""A scan moved by T matches with T."""

import numpy as np
import pytest

from fcslam.geometry import se2
from fcslam.lidar.field import field_of
from fcslam.lidar.matching import NARROW_SCALE_M, NEW_MOTION, POINT_SIGMA_M, match_scan, seen_information
from fcslam.lidar.tracker import POINT_LIMIT, POINT_SPACING_M
from tests.lidar.worlds import bare_scan, corridor, path, ring, ring_drive, room, scan_at

NO_PRIOR = np.zeros((3, 3))
OFFSET = np.array([0.04, 0.03, 0.02])
OFFSETS = [np.array([x, y, np.deg2rad(t)]) for x in (-0.2, 0.0, 0.2) for y in (-0.2, 0.0, 0.2) for t in (-5, 0, 5)]


def error(estimate, truth):
    rest = se2.between(truth, estimate)
    return np.hypot(rest[0], rest[1]), np.rad2deg(abs(rest[2]))


@pytest.fixture(scope="module")
def field():
    rng = np.random.default_rng(0)
    poses = [
        np.array([x, y, t]) for x, y, t in ((0, 0, 0), (0.5, 0.3, 1), (-0.5, 0.2, 2), (0.2, -0.5, 3), (0.0, 0.4, -2))
    ]
    return field_of([(scan_at(pose, room(), noise_m=0.01, rng=rng), pose) for pose in poses])


@pytest.mark.parametrize("noise_m", [0.01, 0.02])
def test_a_moved_scan_matches_where_it_was_taken(field, noise_m):
    rng = np.random.default_rng(7)
    truth = np.array([0.3, -0.1, 0.4])
    worst = np.zeros(2)
    for offset in OFFSETS:
        scan = scan_at(truth, room(), noise_m=noise_m, rng=rng)
        found = match_scan(scan, field, truth + offset, NO_PRIOR)
        assert found.explained > 0.9
        worst = np.maximum(worst, error(found.T_field_base, truth))
    assert worst[0] < 0.01
    assert worst[1] < 0.15


def test_headings_across_the_cut_are_near(field):
    truth = np.array([0.1, 0.0, np.pi - 0.01])
    scan = scan_at(truth, room())
    prior = np.diag((1e2, 1e2, 1e4))
    found = match_scan(scan, field, np.array([0.1, 0.0, -np.pi + 0.02]), prior)
    assert error(found.T_field_base, truth)[1] < 0.3
    assert -np.pi <= found.T_field_base[2] < np.pi


def test_a_prior_with_a_tail_gives_way_where_the_points_contradict_it(field):
    """A slip of ten standard deviations hardly holds the match; a small deviation is held as by a normal prior."""
    truth, prior = np.array([0.3, -0.1, 0.4]), np.diag((1e4, 1e4, 1e4))
    scan = scan_at(truth, room())
    slipped, near = truth + np.array((0.1, -0.1, 0.1)), truth + np.array((0.003, 0.0, 0.0))
    held, loose = (match_scan(scan, field, slipped, prior, prior_tail=tail).T_field_base for tail in (np.inf, 3.0))
    assert error(loose, truth)[0] < 0.3 * error(held, truth)[0]
    stiff, soft = (match_scan(scan, field, near, prior, prior_tail=tail).T_field_base for tail in (np.inf, 3.0))
    assert error(soft, stiff)[0] < 1e-3


@pytest.mark.parametrize("heading", [0.0, 0.6, np.pi / 2])
def test_a_corridor_is_fixed_across_and_held_by_the_prior_along(heading):
    rng = np.random.default_rng(1)
    walls = corridor(heading)
    along, across = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    poses = [np.array([*(k * along), heading]) for k in np.linspace(-2, 2, 9)]
    field = field_of([(scan_at(pose, walls, noise_m=0.01, rng=rng), pose) for pose in poses])
    truth = np.array([0.0, 0.0, heading])
    guess = truth + np.array([*(0.1 * along + 0.1 * across), 0.03])
    prior = np.diag((0.05**-2, 0.05**-2, 0.05**-2))  # a tracker's, after a step of 0.1 m
    found = match_scan(scan_at(truth, walls, noise_m=0.01, rng=rng), field, guess, prior)
    assert abs((found.T_field_base[:2] - truth[:2]) @ across) < 0.005
    assert abs((found.T_field_base[:2] - guess[:2]) @ along) < 0.05
    values, vectors = np.linalg.eigh(found.information[:2, :2])
    assert abs(vectors[:, 0] @ along) > 0.99
    assert values[0] < 0.05 * values[1]


@pytest.mark.parametrize("heading", [0.0, 0.6])
@pytest.mark.parametrize(("noise_m", "end_m"), [(0.005, np.inf), (0.03, np.inf), (0.01, 6.0)])
def test_noise_of_normals_does_not_show_the_axis_of_a_bare_corridor(heading, noise_m, end_m):
    rng = np.random.default_rng(2)
    walls = corridor()
    if np.isfinite(end_m):
        walls = np.vstack((walls, path((end_m, -1), (end_m, 1))))
    walls = se2.transform((0.0, 0.0, heading), walls.reshape(-1, 2)).reshape(-1, 4)
    axis = np.array([np.cos(heading), np.sin(heading)])
    poses = [np.array([*(k * axis), heading]) for k in np.linspace(-2, 2, 9)]
    field = field_of([(scan_at(pose, walls, noise_m=noise_m, rng=rng), pose) for pose in poses])
    truth = np.array([0.0, 0.0, heading])
    scan = scan_at(truth, walls, noise_m=noise_m, rng=rng).thinned(POINT_SPACING_M, POINT_LIMIT)
    found = match_scan(scan, field, truth, np.diag((100.0, 100.0, 100.0)))
    seen = seen_information(scan, field, found)
    assert found.information[:2, :2] @ axis @ axis > 0.0
    if np.isfinite(end_m):
        assert np.array_equal(seen, found.information)
    else:
        assert seen[:2, :2] @ axis @ axis < 0.1 * (found.information[:2, :2] @ axis @ axis)


def test_the_information_predicts_the_cost():
    """Its quadratic form is the rise of half the squared distances around the optimum: signs and coordinates."""
    walls = room()
    truth = np.array([0.2, 0.1, 0.7])
    scan = scan_at(truth, walls)
    field = field_of([(scan, truth)])
    found = match_scan(scan, field, truth, NO_PRIOR)
    labels = field.nearest(se2.transform(truth, scan.points))
    anchors, normals = field.points[labels], field.normals[labels]
    flat = np.hypot(*normals.T) > 0

    def cost(pose):
        rest = np.einsum("nk,nk->n", se2.transform(pose, scan.points) - anchors, normals)[flat]
        return np.sum(rest**2) / POINT_SIGMA_M**2

    rng = np.random.default_rng(0)
    for _ in range(10):
        step = 1e-3 * rng.normal(size=3)
        rise = 0.5 * (cost(found.T_field_base + step) + cost(found.T_field_base - step)) - cost(found.T_field_base)
        assert step @ found.information @ step == pytest.approx(rise, rel=0.15)


@pytest.mark.parametrize("offset_m", [-0.04, 0.0, 0.04])
def test_the_two_sides_of_a_thin_wall_do_not_attract_each_other(offset_m):
    """Only the near side is known, the robot stands on the far side: nothing to match, so nothing moves."""
    near, far = path((0, -3), (0, 3)), path((0.1, -3), (0.1, 3))
    field = field_of([(scan_at((-2, 0, 0), near), np.array([-2.0, 0.0, 0.0]))])
    pose = np.array([2.0 + offset_m, 0.0, 3.0])
    found = match_scan(scan_at(pose, far), field, pose, NO_PRIOR)
    np.testing.assert_allclose(found.T_field_base, pose, atol=1e-9)
    assert found.explained == 0.0
    np.testing.assert_array_equal(found.information, NO_PRIOR)


def test_moving_field_and_guess_moves_the_result():
    rng = np.random.default_rng(4)
    poses = ring_drive()[:60:12]
    scans = [scan_at(pose, ring(), noise_m=0.01, rng=rng) for pose in poses]
    truth = ring_drive()[30]
    scan, guess = scan_at(truth, ring(), noise_m=0.01, rng=rng), truth + np.array([0.08, -0.05, 0.03])
    here = match_scan(scan, field_of(list(zip(scans, poses, strict=True))), guess, NO_PRIOR)
    for move in (np.array([3.0, -7.0, 0.9]), np.array([-11.3, 4.02, -2.5])):
        moved = field_of([(s, se2.compose(move, pose)) for s, pose in zip(scans, poses, strict=True)])
        there = match_scan(scan, moved, se2.compose(move, guess), NO_PRIOR)
        shift, turn = error(there.T_field_base, se2.compose(move, here.T_field_base))
        assert shift < 0.003  # the cells fall differently
        assert turn < 0.06
        assert there.explained == pytest.approx(here.explained, abs=0.02)
        rotation = np.eye(3)
        rotation[:2, :2] = se2.transform((0, 0, move[2]), np.eye(2)).T
        expected = rotation @ here.information @ rotation.T
        np.testing.assert_allclose(there.information, expected, atol=0.05 * np.abs(expected).max())


def test_points_on_new_surfaces_do_not_outweigh_those_on_older_ones():
    """Most points lie on walls that the last poses have turned by 0.2 deg against an older, small wall."""
    small, large = path((-6, -2), (-6, 2), (-4.5, 2)), path((-5, 5), (5, 5), (5, -5), (-5, -5))
    here, turned, off = np.zeros(3), np.array([0.0, 0.0, np.deg2rad(0.2)]), []
    away = np.array([0.001 * NEW_MOTION, 0.0, 0.0])
    for later in ([], [away]):  # the robot moves on, and the large walls are no longer new
        field = field_of(
            [(scan_at(pose, small), pose) for pose in (here, away)]
            + [(scan_at(here, large), turned)]
            + [(scan_at(pose, small), pose) for pose in later]
        )
        off.append(match_scan(scan_at(here, np.vstack((small, large))), field, here, NO_PRIOR).T_field_base[2])
    assert off[1] > 0.85 * turned[2]
    assert off[0] < 0.9 * off[1]


def test_a_wide_loss_in_clutter_averages_over_leaves():
    """Leaves that each scan hits elsewhere: over many scans a wide loss ends nearer to the truth."""
    rng, off = np.random.default_rng(2), {NARROW_SCALE_M: [], 0.15: []}
    for _ in range(30):
        hedge = rng.uniform(-6.0, 6.0, (150, 2))
        field = field_of([(bare_scan(hedge), np.zeros(3))])
        scan = bare_scan(hedge + rng.normal(0.0, 0.1, hedge.shape))
        for scale_m, errors in off.items():
            found = match_scan(scan, field, OFFSET, NO_PRIOR, clutter_scale_m=scale_m)
            errors.append(error(found.T_field_base, np.zeros(3)))
    (narrow_m, narrow_deg), (wide_m, wide_deg) = (np.mean(errors, axis=0) for errors in off.values())
    assert wide_m < 0.8 * narrow_m
    assert wide_deg < 0.8 * narrow_deg


def test_nothing_known_leaves_the_guess(field):
    nothing = bare_scan([])
    guess = np.array([1.0, 2.0, 0.5])
    for scan, other in ((nothing, field), (scan_at((0, 0, 0), room()), field_of([]))):
        found = match_scan(scan, other, guess, NO_PRIOR)
        np.testing.assert_allclose(found.T_field_base, guess, atol=1e-12)
        assert found.explained == 0.0
