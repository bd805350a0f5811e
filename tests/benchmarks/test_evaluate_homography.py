"""Detectors on scenes drawn here."""

import cv2
import numpy as np
import pytest
from evaluation.detectors import EvaluatedDetectorKind, SceneKind, choose_detectors, find_scenes
from evaluation.homography import (
    ESTIMATORS,
    LARGE,
    ORDERS,
    SMALL,
    column,
    difference,
    evaluate_homography,
    interval,
    match_pair,
    mean,
)

from fcslam.features.detector import ImageFeatures
from fcslam.learning.homography import warp
from tests.features.networks import tiny_network

pytestmark = pytest.mark.slow

TURN = np.array([[0.96, -0.12, 40.0], [0.10, 0.98, -15.0], [4e-5, 2e-5, 1.0]])


def texture(seed, shape=(400, 700)):
    """Blots of several sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma) * sigma for sigma in (1.5, 3.0, 8.0)]
    return np.clip(128 + 60 * sum(layers), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """``i_dim``: the light goes down; ``v_turn``: the plane turns. Both are cropped."""
    folder = tmp_path_factory.mktemp("scenes")
    bright, plane = texture(1), texture(2)
    dimmed = [((share * bright).astype(np.uint8), np.eye(3)) for share in (0.7, 0.5)]
    images = {
        "i_dim": [(bright, None), *dimmed],
        "v_turn": [(plane, None), (cv2.warpPerspective(plane, TURN, (700, 400)), TURN)],
    }
    for name, sequence in images.items():
        (folder / name).mkdir()
        for number, (image, H) in enumerate(sequence, start=1):
            cv2.imwrite(str(folder / name / f"{number}.png"), image)
            if H is not None:
                np.savetxt(folder / name / f"H_1_{number}", H)
    return folder


@pytest.fixture(scope="module")
def report(scenes):
    kinds = [EvaluatedDetectorKind.ORB, EvaluatedDetectorKind.SIFT, EvaluatedDetectorKind.HARRIS]
    return evaluate_homography(find_scenes([scenes]), choose_detectors(kinds, []))


def test_what_can_be_matched_is(report):
    for name in ("orb", "sift"):
        pairs = report.of(name)
        assert [(pair.scene, pair.kind, pair.image) for pair in pairs] == [
            ("i_dim", SceneKind.ILLUMINATION, "2"),
            ("i_dim", SceneKind.ILLUMINATION, "3"),
            ("v_turn", SceneKind.VIEWPOINT, "2"),
        ]
        assert mean(pairs, "homography_3px_nms8") == 1.0
        assert mean(pairs, "accuracy_3px_nms0") > 0.9
        assert mean(pairs, "repeatability") > 0.5
        assert np.all(np.diff([mean(pairs, f"accuracy_{px}px_nms8") for px in range(1, 11)]) >= 0)
        assert {size for detector, size in report.milliseconds if detector == name} == {SMALL, LARGE}


def test_differences_are_those_of_the_pairs(report):
    first, other = report.of("orb"), report.of("harris")
    gain = difference(first, other, "repeatability", seed=1)
    assert gain.mean == pytest.approx(np.mean(column(first, "repeatability") - column(other, "repeatability")))
    assert gain.low <= gain.mean <= gain.high


def test_where_only_points_are_known_they_alone_judge(scenes, report, tmp_path):
    """The homography of the file is rough: five pixels off."""
    pair = tmp_path / "pair"
    pair.mkdir()
    for number in (1, 2):
        (pair / f"{number}.png").write_bytes((scenes / "v_turn" / f"{number}.png").read_bytes())
    np.savetxt(pair / "H_1_2", np.array([[1.0, 0, 5], [0, 1, 0], [0, 0, 1]]) @ TURN)
    here = np.random.default_rng(5).uniform((100, 100), (600, 300), (20, 2))
    np.savetxt(pair / "points_1_2.txt", np.column_stack((here, warp(TURN, here))))
    (judged,) = evaluate_homography(find_scenes([pair]), choose_detectors([EvaluatedDetectorKind.SIFT], [])).pairs
    assert mean([judged], "homography_1px_nms0") == mean([judged], "magsac_1px_nms0") == 1.0
    assert np.isnan([mean([judged], measure) for measure in ("repeatability", "accuracy_3px_nms0", "score_nms0")]).all()


def test_intervals_draw_scenes(report):
    """Two scenes have three pairs: whatever their errors, one scene alone gives the ends."""
    pairs = report.of("sift")
    values, ends = column(pairs, "accuracy_1px_nms0"), interval(pairs, "accuracy_1px_nms0", seed=1)
    assert ends.mean == pytest.approx(values.mean())
    assert sorted((values[:2].mean(), values[2])) == pytest.approx([ends.low, ends.high])


def test_each_network_is_compared_by_its_bits_and_by_its_logits(scenes, tmp_path, monkeypatch):
    monkeypatch.setattr("evaluation.homography.ORDERS", 1)  # the homographies of random networks take most of the time
    paths = [tmp_path / f"{name}.onnx" for name in ("first", "second")]
    for seed, path in enumerate(paths):
        tiny_network(path, version=path.stem, seed=seed)
    kinds = [EvaluatedDetectorKind.ONNX, EvaluatedDetectorKind.LOGITS]
    report = evaluate_homography(find_scenes([scenes / "v_turn"]), choose_detectors(kinds, paths))
    assert report.detectors == ("first", "second", "first-logits", "second-logits")
    measured = {name: report.of(name)[0] for name in report.detectors}
    for name in ("first", "second"):
        bits, logits = measured[name], measured[f"{name}-logits"]
        assert bits.repeatability == logits.repeatability == measured["first"].repeatability
        assert logits.matching[0].matches > 0
        assert logits.matching[0].score != bits.matching[0].score
    assert measured["first"].matching[0].score != measured["second"].matching[0].score


def test_the_homography_is_judged_in_common_view_the_matches_among_the_strongest():
    """A thousand strong keypoints that only one of the images shows: they crowd out the matches, not the homography."""
    rng = np.random.default_rng(4)
    shift = np.array([[1.0, 0, -300], [0, 1, 0], [0, 0, 1]])
    common = rng.uniform((300, 0), (640, 480), (100, 2))
    alone = rng.uniform((0, 0), (300, 480), (1000, 2)), rng.uniform((340, 0), (640, 480), (1000, 2))
    codes = rng.integers(0, 256, (1100, 32), np.uint8)
    scores = np.arange(1100, 0, -1, dtype=np.float32)
    views = [np.vstack((alone[0], common)), np.vstack((alone[1], warp(shift, common)))]
    first, second = (ImageFeatures(points.astype(np.float32), scores, codes) for points in views)
    result = match_pair(first, second, shift)
    assert result.errors_px.shape == (len(ESTIMATORS), ORDERS)
    assert result.errors_px.max() < 1e-2
    assert (result.matches, result.accuracy[9]) == (1000, pytest.approx(0.0, abs=0.01))
