"""Peaks and codes from dense outputs: known tops, known planes of logits, the layout of the bits."""

import numpy as np
import pytest

from fcslam.features.dense import CELL_PX, MOST_OVERLAP, box_nms, find_peaks, sample_codes, sample_logits


def bumps(centres, heights, shape=(60, 90)):
    """A paraboloid around each centre, so the refinement is exact."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    image = np.zeros(shape)
    for (cx, cy), height in zip(centres, heights, strict=True):
        image = np.maximum(image, height - 0.02 * ((x - cx) ** 2 + (y - cy) ** 2))
    return image.astype(np.float32)


def test_tops_are_found_to_a_fraction_of_a_pixel_the_strongest_first():
    centres, heights = [(20.3, 10.0), (60.75, 30.4), (40.0, 50.9)], [0.5, 0.9, 0.7]
    positions, scores = find_peaks(bumps(centres, heights), 0.1, 4, 10)
    assert np.allclose(positions, np.array(centres)[[1, 2, 0]], atol=1e-3)
    assert np.all(np.diff(scores) < 0)
    assert np.allclose(scores, [0.9, 0.7, 0.5], atol=0.02)


def test_weak_near_and_surplus_peaks_go():
    image = bumps([(20, 20), (23, 20), (50, 20), (70, 40)], [0.9, 0.8, 0.5, 0.05])
    image[20, 21:23] = 0.0  # so both of the near ones are local maxima
    assert len(find_peaks(image, 0.1, 0, 10)[1]) == 3
    assert np.allclose(find_peaks(image, 0.1, 4, 10)[1], [0.9, 0.5])
    assert np.allclose(find_peaks(image, 0.1, 4, 1)[1], [0.9])
    assert find_peaks(image, 0.95, 4, 10)[0].shape == (0, 2)


def test_peaks_at_the_edge_stay_in_the_image():
    image = np.zeros((20, 30), np.float32)
    image[0, 0], image[19, 29], image[0, 15] = 0.9, 0.8, 0.7
    positions, _ = find_peaks(image, 0.1, 4, 10)
    assert np.array_equal(positions, [(0, 0), (29, 19), (15, 0)])


def test_a_plane_of_logits_is_interpolated_exactly():
    rows, columns = 6, 9
    r, c = np.mgrid[:rows, :columns]
    x, y = CELL_PX * c + 3.5, CELL_PX * r + 3.5
    slopes = np.random.default_rng(1).normal(size=(256, 3))
    logits = (slopes[:, :1, None] * x + slopes[:, 1:2, None] * y + slopes[:, 2:, None]).astype(np.float32)
    points = np.random.default_rng(2).uniform((3.5, 3.5), (67.5, 43.5), (40, 2)).astype(np.float32)
    expected = points @ slopes[:, :2].T + slopes[:, 2]
    assert np.allclose(sample_logits(logits, points), expected, atol=1e-3)
    assert np.array_equal(np.unpackbits(sample_codes(logits, points), axis=1), expected >= 0)


def test_beyond_the_outer_centres_the_nearest_holds():
    logits = np.arange(4, dtype=np.float32).reshape(1, 2, 2)
    corners = np.array([(-0.4, 0), (15, 0), (0, 15), (15.4, 15.4)], np.float32)
    assert sample_logits(logits, corners)[:, 0].tolist() == [0, 1, 2, 3]


def test_the_first_bit_is_the_highest_and_zero_counts_as_one():
    logits = np.full((256, 1, 1), -1.0, np.float32)
    logits[[0, 9]] = 0.0
    code = sample_codes(logits, np.array([(3.5, 3.5)], np.float32))
    assert code.shape == (1, 32)
    assert code[0, :3].tolist() == [0x80, 0x40, 0]
    assert sample_codes(logits, np.empty((0, 2), np.float32)).shape == (0, 32)


def overlap(a, b, side):
    """Intersection over union of two squares around points."""
    width, height = side - abs(a[0] - b[0]), side - abs(a[1] - b[1])
    if width <= 0 or height <= 0:
        return 0.0
    return width * height / (2 * side * side - width * height)


def greedy(points, side):
    kept = []
    for i, point in enumerate(points):
        if all(overlap(point, points[j], side) <= MOST_OVERLAP for j in kept):
            kept.append(i)
    return kept


@pytest.mark.parametrize("side", [1.0, 4, 8, 13.7])
@pytest.mark.parametrize("whole", [True, False])
def test_the_grid_finds_what_comparing_all_pairs_finds(side, whole):
    rng = np.random.default_rng(3)
    points = rng.uniform(-20, 60, (500, 2))
    if whole:
        points = np.rint(points)
    kept = box_nms(points, side)
    assert kept.tolist() == greedy(points, side)
    assert np.array_equal(box_nms(points[kept], side), np.arange(len(kept)))


def test_side_zero_keeps_everything_and_nothing_stays_nothing():
    assert box_nms([(1, 1), (1, 1)], 0).tolist() == [0, 1]
    assert box_nms(np.empty((0, 2)), 4).tolist() == []
