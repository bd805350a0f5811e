"""Labels: where peaks are, how two detectors become one, what an average over warped copies keeps."""

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.learning.labels import adapt, fuse_keypoints, harris, peaks, read_labels, read_teacher, write_labels
from tests.learning.textures import textured


def points(*pairs):
    return np.array(pairs, np.float32).reshape(-1, 2)


def test_peaks_are_found_between_pixels_strongest_first():
    columns, rows = np.meshgrid(np.arange(60), np.arange(50))
    bumps = [(20.3, 15.8, 1.0), (40.6, 30.2, 2.0)]
    response = sum(h * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8) for x, y, h in bumps).astype(np.float32)
    found = peaks(response, 4, 10)
    assert found == pytest.approx(np.array([[40.6, 30.2], [20.3, 15.8]]), abs=0.15)
    assert len(peaks(response, 4, 1)) == 1


def test_what_one_copy_alone_saw_fades():
    calls = []

    def sees_a_ghost_once(image):
        calls.append(1)
        response = harris(image)
        if len(calls) == 1:
            response[80, 100] = 10 * response.max()
        return response

    once = sees_a_ghost_once(textured(1))
    calls.clear()
    mean = adapt(sees_a_ghost_once, textured(1), 15, np.random.default_rng(0))
    assert mean[80, 100] / mean.max() < 0.5 * once[80, 100] / once.max() or mean[80, 100] < 0.2 * once[80, 100]


def test_points_of_both_come_first_and_lie_midway():
    labels = fuse_keypoints(points((10, 10), (50, 50)), points((80, 80), (52, 50)))
    assert labels.keypoints[0] == pytest.approx([51, 50])
    assert len(labels.keypoints) == 3
    assert (np.diff(labels.quality) < 0).all()
    assert labels.quality[0] == 1.0


def test_no_two_labels_are_one_point():
    rng = np.random.default_rng(0)
    kept = fuse_keypoints(*(rng.uniform(0, 60, (200, 2)).astype(np.float32) for _ in range(2))).keypoints
    distances = np.linalg.norm(kept[:, None] - kept[None], axis=2) + 1e3 * np.eye(len(kept))
    assert distances.min() > 3.0


def test_labels_are_kept_for_the_image_they_belong_to(tmp_path):
    labels = fuse_keypoints(points((10, 10)), points((30, 30)))
    path = tmp_path / "a" / "b.state"
    assert read_labels(path, 7) is None
    write_labels(path, labels, 7)
    assert np.array_equal(read_labels(path, 7).keypoints, labels.keypoints)
    assert read_labels(path, 8) is None
    path.write_bytes(b"PK\x03\x04 no archive")
    assert read_labels(path, 7) is None


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04 no archive"])
def test_a_broken_teacher_is_said(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"x\.npz"):
        read_teacher(tmp_path / "x.npz")


@pytest.mark.parametrize(
    "odd",
    [
        {"descriptors": np.full((3, 8), np.nan)},
        {"scores": np.zeros((3, 1))},
        {"scores": np.zeros(())},
        {"scores": np.array(["a", "b", "c"])},
        {"scores": np.array([0.1, np.nan, 0.2])},
    ],
)
def test_a_teacher_whose_parts_do_not_fit_is_said(tmp_path, odd):
    whole = {"keypoints": np.zeros((3, 2)), "scores": np.zeros(3), "descriptors": np.zeros((3, 8))}
    np.savez(tmp_path / "x.npz", **whole | odd)
    with pytest.raises(InputError, match=r"x\.npz.*do not fit"):
        read_teacher(tmp_path / "x.npz")
