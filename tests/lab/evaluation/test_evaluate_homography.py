"""The homography command on scenes drawn here: detectors, extracted features, and what users get wrong."""

import csv

import cv2
import numpy as np
import pytest

from fcslam.cli import main
from fcslam.errors import EvaluationError
from fcslam.features.detector import ImageFeatures
from fcslam.features.detector_kinds import EvaluatedDetectorKind
from fcslam.features.files import read_features, write_features
from fcslam.lab.evaluation.detectors.evaluated_detectors import choose_detectors, frame
from fcslam.lab.evaluation.detectors.homography import LARGE, SMALL, evaluate_homography, match_pair, matched_points
from fcslam.lab.evaluation.detectors.measures import column, difference, mean
from fcslam.lab.evaluation.detectors.scenes import SceneKind, find_scenes
from fcslam.metrics.homography import HomographyGroundTruth, framed_homography, warp
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
    return evaluate_homography(find_scenes([scenes]), choose_detectors(kinds, [], []))


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


def test_corners_have_repeatability_alone(report):
    pairs = report.of("harris")
    assert mean(pairs, "repeatability") > 0.6
    assert not any(pair.matching for pair in pairs)
    assert np.isnan(mean(pairs, "accuracy_3px_nms8"))


def test_differences_are_those_of_the_pairs(report):
    first, other = report.of("orb"), report.of("harris")
    gain = difference(first, other, "repeatability", seed=1)
    assert gain.mean == pytest.approx(np.mean(column(first, "repeatability") - column(other, "repeatability")))
    assert gain.low <= gain.mean <= gain.high


def test_each_network_is_compared_by_its_bits_and_by_its_logits(scenes, tmp_path):
    paths = [tmp_path / f"{name}.onnx" for name in ("first", "second")]
    for seed, path in enumerate(paths):
        tiny_network(path, version=path.stem, seed=seed)
    kinds = [EvaluatedDetectorKind.ONNX, EvaluatedDetectorKind.LOGITS]
    report = evaluate_homography(find_scenes([scenes / "v_turn"]), choose_detectors(kinds, paths, []))
    assert report.detectors == ("first", "second", "first-logits", "second-logits")
    measured = {name: report.of(name)[0] for name in report.detectors}
    for name in ("first", "second"):
        bits, logits = measured[name], measured[f"{name}-logits"]
        assert bits.repeatability == logits.repeatability == measured["first"].repeatability
        assert logits.matching[0].matches > 0
        assert logits.matching[0].score != bits.matching[0].score
    assert measured["first"].matching[0].score != measured["second"].matching[0].score


def test_without_names_there_is_all_but_two_of_one_network(tmp_path):
    path = tmp_path / "tiny.onnx"
    tiny_network(path)
    names = [each.name for each in choose_detectors([], [path], [])]
    assert names == ["tiny-1", "tiny-1-logits", "orb", "sift", "fast", "harris", "shi"]
    with pytest.raises(EvaluationError, match="tiny-1: named twice"):
        choose_detectors([EvaluatedDetectorKind.ONNX], [path, path], [])


def test_the_legacy_truth_spares_the_light_and_ruins_the_turn(scenes):
    detectors = choose_detectors([EvaluatedDetectorKind.ORB], [], [])
    found = find_scenes([scenes])
    legacy = evaluate_homography(found, detectors, HomographyGroundTruth.LEGACY).of("orb")
    assert mean(legacy, "homography_3px_nms0", SceneKind.ILLUMINATION) == 1.0
    assert mean(legacy, "homography_3px_nms0", SceneKind.VIEWPOINT) == 0.0


def test_extracted_features_score_as_the_detector_that_runs_here(scenes, tmp_path):
    """On images that have the protocol's size already, so that both see the same pixels."""
    scene = tmp_path / "scenes" / "v_small"
    scene.mkdir(parents=True)
    pictures = [frame(scenes / "v_turn" / f"{number}.png", LARGE) for number in (1, 2)]
    for number, picture in enumerate(pictures, start=1):
        cv2.imwrite(str(scene / f"{number}.png"), picture.grey)
    H = framed_homography(TURN, pictures[0].framing, pictures[1].framing, HomographyGroundTruth.CORRECTED)
    np.savetxt(scene / "H_1_2", H / H[2, 2])
    assert (
        main(
            [
                "tools",
                "extract",
                str(scene.parent),
                "-o",
                str(tmp_path / "mine"),
                "--detector",
                "orb",
                "--keypoints",
                "1500",
            ]
        )
        == 0
    )
    for number in (1, 2):
        path = tmp_path / "mine" / "v_small" / f"{number}.npz"
        features, size = read_features(path)
        rows = np.random.default_rng(number).permutation(len(features.scores))  # any order will do
        write_features(path, features.take(rows), size)
    found = find_scenes([scene])
    theirs, ours = choose_detectors([EvaluatedDetectorKind.ORB], [], [tmp_path / "mine"])
    (extracted,) = evaluate_homography(found, [theirs]).of("mine")
    (run,) = evaluate_homography(found, [ours]).of("orb")
    for nms_px in (8, 0):
        # only the detector's threshold differs
        assert extracted.matching[nms_px].accuracy[2] == pytest.approx(run.matching[nms_px].accuracy[2], abs=0.1)
        assert extracted.matching[nms_px].corner_error_px < 3.0


def test_features_of_the_file_are_brought_into_the_framed_picture(scenes, tmp_path):
    """Perfect features at arbitrary places: what is scored is the framing alone."""
    rng = np.random.default_rng(3)
    first = rng.uniform((0, 0), (700, 400), (800, 2))
    codes = rng.integers(0, 256, (800, 32), np.uint8)
    (tmp_path / "perfect" / "v_turn").mkdir(parents=True)
    for number, positions in ((1, first), (2, warp(TURN, first))):
        features = ImageFeatures(positions.astype(np.float32), np.arange(800, dtype=np.float32), codes)
        write_features(tmp_path / "perfect" / "v_turn" / f"{number}.npz", features, (700, 400))
    perfect = choose_detectors([], [], [tmp_path / "perfect"])
    (pair,) = evaluate_homography(find_scenes([scenes / "v_turn"]), perfect).pairs
    assert pair.repeatability.repeatability > 0.95  # NMS may take another of two neighbours
    assert pair.repeatability.localization_error_px < 1e-3
    assert pair.matching[0].corner_error_px < 1e-2
    assert pair.matching[0].accuracy[0] > 0.8  # some of the nearest are not in the cropped picture
    assert pair.matching[0].score == pytest.approx(1.0, abs=0.02)


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
    assert result.corner_error_px < 1e-2
    assert (result.matches, result.accuracy[9]) == (1000, pytest.approx(0.0, abs=0.01))


def test_nothing_found_scores_nothing(scenes, tmp_path):
    none = ImageFeatures(np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 32), np.uint8))
    (tmp_path / "blind" / "v_turn").mkdir(parents=True)
    for number in (1, 2):
        write_features(tmp_path / "blind" / "v_turn" / f"{number}.npz", none, (700, 400))
    blind = choose_detectors([], [], [tmp_path / "blind"])
    (pair,) = evaluate_homography(find_scenes([scenes / "v_turn"]), blind).pairs
    assert np.isnan(pair.repeatability.repeatability)
    assert pair.matching[8].corner_error_px == np.inf
    assert pair.matching[8].matches == 0
    assert [len(points) for points in matched_points(none, none)] == [0, 0]


def test_the_command_shows_tables_and_writes_files(scenes, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    arguments = ["evaluate", "homography", str(scenes), "--detector", "orb", "--detector", "fast"]
    assert main([*arguments, "--csv", str(tmp_path / "t.csv")]) == 0
    out = capsys.readouterr().out
    for title in ("I. Repeatability", "II. Homography estimation", "orb less the others", "3 pairs. In brackets"):
        assert title in out
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["detector"], row["scene"]) for row in rows].count(("orb", "i_dim")) == 2
    assert all(0.0 <= float(row["repeatability"]) <= 1.0 for row in rows)
    assert {row["accuracy_3px_nms8"] == "" for row in rows if row["detector"] == "fast"} == {True}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{empty}"], "no scene in it"),
        (["{scenes}", "{scenes}"], "there is another scene i_dim"),
        (["{scenes}", "--detector", "orb", "--detector", "orb"], "orb: named twice"),
        (["{scenes}", "--detector", "{empty}/none"], "no such folder"),
        (["{scenes}", "--detector", "{empty}"], "cannot read the features"),
        (["{scenes}", "--detector", "onnx", "--detector", "{empty}/n.onnx"], "cannot read the network weights"),
        (["{scenes}", "--detector", "orb", "--csv", "{empty}/none/t.csv"], "cannot be written"),
    ],
)
def test_mistakes_are_told_in_one_line(scenes, tmp_path, capsys, arguments, message):
    words = [word.format(scenes=scenes, empty=tmp_path) for word in arguments]
    assert main(["evaluate", "homography", *words]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("H_1_2", "1 0 0 0 1 0 0 0", "give 3 x 3"),
        ("H_1_2", "1 0 0 0 1 0 0 0 x", "cannot read the homography"),
        ("H_1_2", "0 0 0 0 0 0 0 0 1", "can be inverted"),
        ("H_1_7", "1 0 0 0 1 0 0 0 1", "image 7 is missing"),
        ("H_1_x", "1 0 0 0 1 0 0 0 1", "what is H_1_x?"),
        ("1.png", "no image", "cannot be read as an image"),
    ],
)
def test_broken_scenes_are_told(tmp_path, capsys, name, content, message):
    for number in (1, 2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), texture(1, (60, 80)))
    (tmp_path / "H_1_2").write_text("1 0 0 0 1 0 0 0 1")
    (tmp_path / name).write_text(content)
    assert main(["evaluate", "homography", str(tmp_path), "--detector", "fast"]) == 2
    assert message in capsys.readouterr().err


def test_features_of_an_image_of_another_size_are_refused(scenes, tmp_path, capsys):
    (tmp_path / "i_dim").mkdir()
    none = ImageFeatures(np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, 32), np.uint8))
    write_features(tmp_path / "i_dim" / "1.npz", none, (640, 480))
    assert main(["evaluate", "homography", str(scenes), "--detector", str(tmp_path)]) == 2
    assert "of an image of 640 x 480 pixels" in capsys.readouterr().err
