"""The relations of the pairs in each kind of folder, against its definition pair by pair."""

import re

import numpy as np
import pytest
from evaluation.place_sets import read_place_set
from evaluation.view_overlap import DepthCamera, view_overlap

from tests.benchmarks import place_folders


@pytest.mark.parametrize(("every_image", "shape"), [(False, (12, 108)), (True, (120, 120))])
def test_floors_of_a_tower(tmp_path, every_image, shape):
    found = read_place_set(place_folders.tower(tmp_path / "tower"), every_image=every_image)
    assert (len(found.queries), len(found.gallery)) == shape
    assert not found.is_online
    within, near = found.questions["within a floor"], found.questions["near"]
    for q, query in enumerate(found.queries):
        for g, place in enumerate(found.gallery):
            floor, area, frame = re.match(r"(floor\d)_(\w+)_frame_(\d+)", query.stem).groups()
            other_floor, other_area, other_frame = re.match(r"(floor\d)_(\w+)_frame_(\d+)", place.stem).groups()
            same_clip, apart = (floor, area) == (other_floor, other_area), abs(int(frame) - int(other_frame))
            assert found.admitted[q, g] == (query != place)
            assert within.matches[q, g] == near.matches[q, g] == (same_clip and apart <= 4 and query != place)
            one_lobby = every_image and "elevator" in (area, other_area) and "hall" not in (area, other_area)
            assert within.different[q, g] == (
                floor == other_floor and not one_lobby and (area != other_area or apart > 12)
            )
            assert near.different[q, g] == (floor != other_floor)


def test_a_tour(tmp_path):
    found = read_place_set(place_folders.tour(tmp_path / "tour"))
    (truth,) = found.questions.values()
    pairs = [(j, j - 30) for j in range(30, 50)]
    assert found.is_online
    for q in range(50):
        for g in range(50):
            near = any(abs(q - j) <= 8 and abs(g - i) <= 8 for j, i in pairs)
            assert found.admitted[q, g] == (g <= q - 20)
            assert truth.matches[q, g] == ((q, g) in pairs)
            assert truth.different[q, g] == (g <= q - 20 and not near)


def test_a_list_of_matches(tmp_path):
    found = read_place_set(place_folders.generic(tmp_path / "generic", 4))
    (truth,) = found.questions.values()
    np.testing.assert_array_equal(truth.matches, np.eye(3, 4, dtype=bool))
    unknown = np.zeros((3, 4), bool)
    unknown[0, 3] = True
    np.testing.assert_array_equal(truth.different, ~np.eye(3, 4, dtype=bool) & ~unknown)


def camera_over_a_wall(shift_m):
    """4 x 4 poses of two cameras that look at a wall one metre ahead, one of them moved sideways."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = shift_m
    return poses


PLAIN = DepthCamera(np.array([80.0, 80.0, 79.5, 59.5]), np.zeros(5))


@pytest.mark.slow
@pytest.mark.parametrize(("shift_m", "share"), [(0.0, 1.0), (0.5, 0.75), (1.0, 0.5), (3.0, 0.0)])
def test_overlap_of_a_wall_is_what_stays_in_view(shift_m, share):
    overlap = view_overlap(np.ones((2, 120, 160)), camera_over_a_wall(shift_m), PLAIN)
    np.testing.assert_allclose(np.diag(overlap), 1.0)
    assert overlap[0, 1] == overlap[1, 0] == pytest.approx(share, abs=0.06)


def test_what_stands_before_the_wall_is_not_the_wall():
    depths = np.ones((2, 120, 160))
    depths[1] = 0.8
    assert view_overlap(depths, camera_over_a_wall(0.0), PLAIN)[0, 1] == 0.0
    depths[1] = 0.95
    assert view_overlap(depths, camera_over_a_wall(0.0), PLAIN)[0, 1] > 0.8


def sequence(folder, shifts_m, seconds=1.0):
    """A camera that moves sideways along a wall one metre ahead, as TUM RGB-D has it."""
    lines, poses = [], ["# stamp x y z qx qy qz qw"]
    for k, shift in enumerate(shifts_m):
        stamp = f"{100.0 + k * seconds:.3f}"
        place_folders.write(folder / "rgb" / f"{stamp}.png", place_folders.texture(k, (240, 320)))
        place_folders.write(folder / "depth" / f"{stamp}.png", np.full((120, 160), 5000, np.uint16))
        lines.append(f"{stamp} rgb/{stamp}.png {stamp} depth/{stamp}.png")
        poses += [f"{float(stamp) + step:.3f} {shift} 0 0 0 0 0 1" for step in (-0.05, 0.05)]
    (folder / "associations.txt").write_text("\n".join(lines), encoding="utf-8")
    (folder / "groundtruth.txt").write_text("\n".join(poses), encoding="utf-8")
    (folder / "calibration.txt").write_text("robot 160 160 159.5 119.5 0 0 0 0 0\n", encoding="utf-8")
    return folder


def test_a_sequence_with_depth(tmp_path):
    found = read_place_set(sequence(tmp_path / "robot_1", [0.0, 0.2, 1.4, 3.0, 0.0]))
    (truth,) = found.questions.values()
    assert [tuple(pair) for pair in np.argwhere(found.admitted)] == [(3, 0), (4, 0), (4, 1)]
    assert [tuple(pair) for pair in np.argwhere(truth.matches)] == [(4, 0), (4, 1)]
    assert [tuple(pair) for pair in np.argwhere(truth.different)] == [(3, 0)]
