import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from fcslam.geometry import se2
from fcslam.lidar.occupancy import Casting, OccupancyConfig, cast, cast_periods, classify
from fcslam.maps.occupancy_map import Occupancy
from fcslam.records import LaserModel
from tests.lidar.worlds import box, ranges

pytestmark = pytest.mark.slow

CELL_M = 0.0625  # a power of two: moving by whole cells is exact
CONFIG = OccupancyConfig(resolution_m=CELL_M)
ONE_BEAM = LaserModel(1, 0.0, 0.01, 1000.0)
ALL_ROUND = LaserModel(720, -np.pi, np.pi / 360, 50.0, (0.1, -0.05, 0.3))
FRONT = LaserModel(91, -np.pi / 2, np.pi / 90, 20.0)
HALF_ROOM_M = 2.03

coordinate = st.floats(-20.0, 20.0)
beam = st.tuples(coordinate, coordinate, st.floats(-np.pi, np.pi), st.floats(0.01, 6.0))


def room_ranges(T_map_base, laser=ALL_ROUND, half=HALF_ROOM_M):
    """Ranges in a square room around the origin of map."""
    return ranges(T_map_base, box(-half, -half, half, half), laser)[0]


def room_scans(laser=ALL_ROUND, count=12, seed=3):
    poses = np.random.default_rng(seed).uniform((-1.5, -1.5, -3.0), (1.5, 1.5, 3.0), (count, 3))
    return [Casting(room_ranges(pose, laser), laser, pose) for pose in poses]


def one_beam(x, y, heading, length):
    return cast([Casting(np.array([length], np.float32), ONE_BEAM, np.array((x, y, heading)))], CONFIG)


def chords(grid, start, end, grow_m):
    """Share of the segment in each cell, grown by ``grow_m`` on every side: by clipping it at the four sides."""
    lower, upper = np.zeros(grid.passes.shape), np.ones(grid.passes.shape)
    for axis, way in ((1, 0), (0, 1)):
        edges = grid.origin_xy[way] + grid.resolution_m * np.arange(grid.passes.shape[axis] + 1) - start[way]
        delta = np.copysign(max(abs(end[way] - start[way]), 1e-12), end[way] - start[way])
        t = np.sort(((edges[:-1] - grow_m) / delta, (edges[1:] + grow_m) / delta), axis=0)
        shape = (1, -1) if axis == 1 else (-1, 1)
        lower, upper = np.maximum(lower, t[0].reshape(shape)), np.minimum(upper, t[1].reshape(shape))
    return upper - lower


@settings(max_examples=200)
@given(beam)
def test_a_beam_passes_exactly_the_cells_it_crosses(given_beam):
    x, y, heading, length = given_beam
    grid = one_beam(*given_beam)
    length = float(np.float32(length))
    start, end = np.array((x, y)), np.array((x + length * np.cos(heading), y + length * np.sin(heading)))
    # On an edge, rounding decides: so what lies deep in a cell must be passed, what stays off it must not.
    assert grid.passes.max() == 1
    assert (grid.passes[chords(grid, start, end, -1e-9) > 0.0] == 1).all()
    assert (chords(grid, start, end, 1e-9)[grid.passes == 1] > 0.0).all()


@settings(max_examples=100)
@given(beam)
def test_a_beam_hits_the_cell_of_its_end(given_beam):
    x, y, heading, length = given_beam
    grid = one_beam(*given_beam)
    end = np.array((x, y)) + np.float64(np.float32(length)) * np.array((np.cos(heading), np.sin(heading)))
    rows, columns = np.nonzero(grid.hits)
    assert grid.hits.sum() == 1
    low = np.array(grid.origin_xy) + grid.resolution_m * np.array((columns[0], rows[0]))
    assert (low - 1e-6 <= end).all()
    assert (end <= low + grid.resolution_m + 1e-6).all()
    assert (grid.hits <= grid.passes).all()


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, np.pi, -np.pi / 2, np.pi / 4, -3 * np.pi / 4])
@pytest.mark.parametrize("start", [(0.0, 0.0), (0.03125, 0.03125), (-0.0625, 0.125)])
def test_beams_along_edges_and_through_corners_end(heading, start):
    grid = one_beam(*start, heading, 1.0)
    assert grid.hits.sum() == 1
    rows, columns = np.nonzero(grid.passes)
    path_cells = len(rows)
    assert path_cells >= 12
    assert path_cells <= 1 + np.ptp(rows) + np.ptp(columns)
    assert ndimage.label(grid.passes)[1] == 1


def test_a_square_room_is_closed_and_free_inside():
    grid = cast(room_scans(), CONFIG)
    cells = classify(grid)
    rooms, _ = ndimage.label(cells != Occupancy.OCCUPIED)
    y, x = (grid.origin_xy[k] + (np.arange(cells.shape[1 - k]) + 0.5) * CELL_M for k in (1, 0))
    inside = (np.abs(x)[None, :] < HALF_ROOM_M - 0.1) & (np.abs(y)[:, None] < HALF_ROOM_M - 0.1)
    assert (cells[inside] == Occupancy.FREE).all()
    label = rooms[inside][0]
    border = np.concatenate((rooms[0], rooms[-1], rooms[:, 0], rooms[:, -1]))
    assert label not in border
    outside = (np.abs(x)[None, :] > HALF_ROOM_M + 0.1) | (np.abs(y)[:, None] > HALF_ROOM_M + 0.1)
    assert (cells[outside] == Occupancy.UNKNOWN).all()


def test_a_beam_beyond_the_usable_range_clears_inside_the_grid_and_hits_nothing():
    near = CONFIG.model_copy(update={"usable_range_m": 3.0})
    pose = np.array((0.03, 0.03, 0.0))
    long_beam = Casting(np.array([100.0], np.float32), ONE_BEAM, pose)
    alone = cast([long_beam], near)
    assert alone.hits.sum() == 0
    assert alone.passes.shape[1] <= 4
    frame = [Casting(np.array([2.5], np.float32), ONE_BEAM, np.array((x, 1.0, 0.0))) for x in (0.03, 3.0)]
    grid = cast([long_beam, *frame], near)
    row = round((0.0 - grid.origin_xy[1]) / CELL_M)
    cleared = np.flatnonzero(grid.passes[row]) * CELL_M + grid.origin_xy[0]
    assert grid.hits.sum() == 2
    assert cleared[0] == 0.0
    assert cleared[-1] == 3.0


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan, -np.inf, 50.0, 81.83])
def test_what_is_no_range_adds_nothing(nothing):
    scans = room_scans(count=2)
    silent = np.full(ALL_ROUND.beam_count, nothing, np.float32)
    grid = cast(scans, CONFIG)
    more = cast([*scans, Casting(silent, ALL_ROUND, np.zeros(3))], CONFIG)
    np.testing.assert_array_equal(more.hits, grid.hits)
    np.testing.assert_array_equal(more.passes, grid.passes)


SHORT = LaserModel(720, -np.pi, np.pi / 360, 4.0)


def short_scan(x, y, seen_from_m=4.0, lost=0.0, seed=0, person=False):
    """Ranges of ``SHORT`` beside a long wall at y = 3 that returns beams up to ``seen_from_m``, at (x, y), which faces
    +x. A ``person`` of 0.3 m stands in the origin. A share of ``lost`` of the beams has no return."""
    cos, sin = np.cos(SHORT.angles_rad()), np.sin(SHORT.angles_rad())
    with np.errstate(divide="ignore"):
        ranges = np.where(sin > 0.0, (3.0 - y) / sin, np.inf)
    ranges[ranges >= seen_from_m] = np.inf
    if person:
        along, across = -(x * cos + y * sin), x * sin - y * cos
        near = (np.abs(across) < 0.15) & (along > 0.0)
        ranges = np.where(near, along - np.sqrt(np.maximum(0.0, 0.0225 - across**2)), ranges)
        ranges[ranges >= 4.0] = np.inf
    ranges[np.random.default_rng(seed).random(len(ranges)) < lost] = np.inf
    return Casting(ranges.astype(np.float32), SHORT, np.array((x, y, 0.0)))


def states(castings, config=CONFIG):
    """The state of the cell at any (x, y)."""
    grid = cast(castings, config)
    cells = classify(grid)
    return lambda x, y: state_at(grid, cells, x, y)


@pytest.mark.parametrize("longest_m", [2.0, 30.0])
def test_a_hall_is_free_as_far_as_its_scan_has_a_return(longest_m):
    """Half of the turn has no return: the opposite wall of the hall is beyond the maximum range."""
    scans = [short_scan(0.0, 0.0), short_scan(0.01, 0.0)]
    at = states(scans, OccupancyConfig(resolution_m=CELL_M, usable_range_m=longest_m))
    farthest = max(r for r in scans[0].ranges_m.tolist() if r < SHORT.max_range_m)
    assert farthest > 0.97 * SHORT.max_range_m
    reach = min(longest_m, farthest)
    for heading in np.radians(np.arange(181, 359, 3)):
        for share, expected in ((0.92, Occupancy.FREE), (1.05, Occupancy.UNKNOWN)):
            assert at(share * reach * np.cos(heading), share * reach * np.sin(heading)) == expected


def test_beams_without_return_clear_nothing_if_no_other_beam_has_one():
    assert cast([short_scan(0.0, -4.0)], CONFIG).passes.sum() == 0


@settings(max_examples=100)
@given(
    st.floats(0.5, 6.0),
    st.floats(0.5, 6.0),
    st.integers(0, 719),
    st.integers(2, 359),
    st.lists(st.sampled_from([np.inf, 0.0, 50.0]), min_size=358, max_size=358),
)
def test_beams_without_return_clear_no_more_than_the_returns_beside_them_enclose(a, b, first, width, gap):
    """Whatever lies in a gap, in any part of a full turn: only the triangle of the laser and both returns is cleared,
    and nothing in it farther than the nearer return."""
    ranges = np.zeros(720, np.float32)
    ranges[(first + np.arange(1, width)) % 720] = gap[: width - 1]
    ranges[[first, (first + width) % 720]] = a, b
    angles, laser = ALL_ROUND.angles_rad(), np.array(ALL_ROUND.T_base_laser)
    grid = cast([Casting(ranges, ALL_ROUND, np.zeros(3))], CONFIG)
    rows, columns = np.nonzero(grid.passes)
    centres = np.array(grid.origin_xy) + CELL_M * (np.stack((columns, rows), axis=-1) + 0.5)
    seen = se2.transform(np.asarray(se2.inverse(laser)), centres)
    ends = [ranges[k] * np.array((np.cos(angles[k]), np.sin(angles[k]))) for k in (first, (first + width) % 720)]
    along = ends[1] - ends[0]
    beyond = (along[1] * (seen - ends[0])[:, 0] - along[0] * (seen - ends[0])[:, 1]) / np.linalg.norm(along)
    assert (beyond <= CELL_M).all()
    on_return = [np.abs(seen @ (-end[1], end[0])) / np.linalg.norm(end) <= CELL_M for end in ends]
    far = np.linalg.norm(seen, axis=1) > min(a, b) + CELL_M
    assert (on_return[0] | on_return[1])[far].all()


def test_the_first_and_the_last_beam_of_a_part_of_a_turn_are_not_neighbours():
    ranges = np.full(FRONT.beam_count, np.inf, np.float32)
    ranges[[30, 60]] = 2.0
    grid = cast([Casting(ranges, FRONT, np.zeros(3))], CONFIG)
    rows, columns = np.nonzero(grid.passes)
    x, y = np.array(grid.origin_xy)[:, None] + CELL_M * (np.stack((columns, rows)) + 0.5)
    headings = np.degrees(np.arctan2(y, x))[np.hypot(x, y) > 0.5]
    assert headings.min() >= -36.0
    assert headings.max() <= 36.0


@pytest.mark.parametrize("later", [False, True])
def test_a_person_who_left_is_cleared_by_beams_without_return(later):
    """The wall is in range, so that the scans have returns; the beams past the person have none."""
    there = [short_scan(-2.0 + 0.05 * k, -0.8, person=True) for k in range(10)]
    gone = [short_scan(-1.5 + 0.05 * k, -0.8, seen_from_m=3.9) for k in range(70)]
    assert states(there)(0.0, -0.15) == Occupancy.OCCUPIED
    periods = [there, gone] if later else [there + gone]
    *_, grid = cast_periods(periods, CONFIG)
    cells = classify(grid)
    column, row = (int(np.floor((v - o) / CELL_M)) for v, o in zip((0.0, 0.0), grid.origin_xy, strict=True))
    assert (cells[row - 3 : row + 4, column - 3 : column + 4] == Occupancy.FREE).all()


def assert_wall_stays(near, far, half_m):
    """In one period and in two, the wall at y = 3 is occupied, and nothing behind it is free."""
    for periods in ([near + far], [near, far]):
        *_, grid = cast_periods(periods, CONFIG)
        cells = classify(grid)
        (left, row), (right, _) = (
            np.floor(np.subtract((x, 3.0), grid.origin_xy) / CELL_M).astype(int) for x in (-half_m, half_m)
        )
        assert (cells[row, left:right] == Occupancy.OCCUPIED).all()
        assert not (cells[row + 1 :, left:right] == Occupancy.FREE).any()


@pytest.mark.parametrize(("seen_from_m", "lost"), [(1.2, 0.0), (4.0, 0.05)], ids=["black", "lossy"])
def test_a_wall_stays_whose_returns_are_missing_at_times(seen_from_m, lost):
    """A black wall returns no beam from afar, where the robot is most of the time; or any beam may fail."""
    near = [short_scan(-2.0 + 0.16 * k, 2.0, seen_from_m, lost, k) for k in range(25)]
    far = [short_scan(-2.0 + 0.04 * k, 0.5, seen_from_m, lost, k) for k in range(100)]
    assert_wall_stays(near, far, 2.0)


def test_a_black_panel_in_a_wall_stays_although_later_scans_see_only_the_wall_beside_it():
    near = [short_scan(-2.0 + 0.16 * k, 2.0) for k in range(25)]
    far = []
    for k in range(100):
        scan = short_scan(-2.0 + 0.04 * k, 0.5)
        x = scan.T_map_base[0] + 2.5 / np.tan(np.clip(SHORT.angles_rad(), 0.1, np.pi - 0.1))
        far.append(scan._replace(ranges_m=np.where(np.abs(x) < 0.5, np.inf, scan.ranges_m).astype(np.float32)))
    assert_wall_stays(near, far, 1.5)


def test_the_grid_ends_where_beams_without_return_do():
    room = room_scans(count=40)
    lossy = [
        scan._replace(ranges_m=np.where(np.arange(720) % 50 == k % 50, np.inf, scan.ranges_m).astype(np.float32))
        for k, scan in enumerate(room)
    ]
    assert max(cast(lossy, CONFIG).hits.shape) <= max(cast(room, CONFIG).hits.shape) + 2


def test_a_grid_too_large_gets_coarser_instead():
    small = CONFIG.model_copy(update={"maximum_cells": 10_000})
    scans = room_scans(count=2)
    far = [Casting(ranges, laser, pose + np.array((9000.0, 5000.0, 0.0))) for ranges, laser, pose, _ in scans]
    grid = cast(scans + far, small)
    assert grid.hits.size <= 10_000
    assert np.log2(grid.resolution_m / CELL_M) % 1 == 0
    assert grid.resolution_m > CELL_M
    assert grid.hits.sum() == 4 * ALL_ROUND.beam_count
    assert cast(scans, small).resolution_m == CELL_M


@pytest.mark.parametrize("pose", [(np.nan, 0, 0), (0, np.inf, 0), (0, 0, np.nan), (0, 0, np.inf), (1e12, 0, 0)])
def test_a_pose_out_of_all_bounds_is_refused(pose):
    with pytest.raises(ValueError, match="poses must be finite"):
        cast([Casting(np.ones(1, np.float32), ONE_BEAM, np.array(pose, np.float64))], CONFIG)


def test_a_cell_is_known_after_two_passes_and_occupied_by_the_share_of_hits():
    for others, expected in ((5, Occupancy.OCCUPIED), (6, Occupancy.FREE)):
        lengths = [0.5] * others + [0.3]  # the last ends in a cell that the others pass
        scans = [Casting(np.array([r], np.float32), ONE_BEAM, np.array((0.01, 0.01, 0.0))) for r in lengths]
        grid = cast(scans, CONFIG)
        row, first = (round(-grid.origin_xy[k] / CELL_M) for k in (1, 0))
        near, far = first + int(0.31 / CELL_M), first + int(0.51 / CELL_M)
        assert (grid.hits[row, near], grid.passes[row, near]) == (1, others + 1)
        assert (grid.hits[row, far], grid.passes[row, far]) == (others, others)
        cells = classify(grid)
        assert cells[row, near] == expected
        assert cells[row, far] == Occupancy.OCCUPIED
        assert cells[row, near + 1] == Occupancy.FREE
    assert (classify(cast(scans[:1], CONFIG)) == Occupancy.UNKNOWN).all()
    assert (classify(cast(scans[:2], CONFIG)) != Occupancy.UNKNOWN).sum() == far - first + 1


def room_cells(*halves, scans=12, config=CONFIG):
    """The state after periods in which the room had these half sizes."""
    periods = [
        [Casting(room_ranges(pose, ALL_ROUND, half), ALL_ROUND, pose) for pose in POSES_INSIDE[:scans]]
        for half in halves
    ]
    *_, grid = cast_periods(periods, config)
    return grid, classify(grid)


POSES_INSIDE = np.random.default_rng(4).uniform((-0.7, -0.7, -3.0), (0.7, 0.7, 3.0), (12, 3))


def state_at(grid, cells, x, y):
    column, row = np.floor((np.array((x, y)) - grid.origin_xy) / grid.resolution_m).astype(int)
    inside = 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]
    return Occupancy(cells[row, column]) if inside else Occupancy.UNKNOWN


@pytest.mark.parametrize("earlier", [1, 5])
def test_walls_that_a_later_period_looks_through_are_gone_however_long_they_lasted(earlier):
    grid, cells = room_cells(*[1.03] * earlier, HALF_ROOM_M)
    assert state_at(grid, cells, 1.03, 0.3) is Occupancy.FREE
    assert state_at(grid, cells, HALF_ROOM_M, 0.3) is Occupancy.OCCUPIED


@pytest.mark.parametrize("earlier", [1, 5])
def test_walls_that_appear_are_there_and_what_they_hide_stays(earlier):
    grid, cells = room_cells(*[HALF_ROOM_M] * earlier, 1.03)
    assert state_at(grid, cells, 1.03, 0.3) is Occupancy.OCCUPIED
    assert state_at(grid, cells, HALF_ROOM_M, 0.3) is Occupancy.OCCUPIED
    assert state_at(grid, cells, 1.5, 0.3) is Occupancy.FREE


def test_two_scans_alone_drop_nothing():
    before, _ = room_cells(1.03)
    earlier = [Casting(room_ranges(pose, ALL_ROUND, 1.03), ALL_ROUND, pose) for pose in POSES_INSIDE]
    later = [Casting(room_ranges(pose), ALL_ROUND, pose) for pose in POSES_INSIDE[:2]]
    *_, grid = cast_periods([earlier, later], CONFIG)
    assert grid.hits.sum() == before.hits.sum() + 2 * ALL_ROUND.beam_count


def test_periods_that_agree_are_added_up():
    scans = room_scans()
    *_, grid = cast_periods([scans[:5], scans[5:]], CONFIG)
    at_once = cast(scans, CONFIG)
    assert grid.origin_xy == at_once.origin_xy
    assert grid.hits.sum() == at_once.hits.sum()
    walls = at_once.hits > 0
    assert np.array_equal(classify(grid)[walls], classify(at_once)[walls])
