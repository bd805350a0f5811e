"""The study of federated training: it compares like with like, resumes, and its arithmetic is right."""

import cv2
import numpy as np
import pytest

from tests.learning.textures import textured

torch = pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from evaluation.federated.pairs import (  # noqa: E402
    MEASURES,
    DetectedFeatures,
    detect_features,
    held_out_pairs,
    measure_pair,
)
from evaluation.federated.report import report  # noqa: E402
from evaluation.federated.study import Arm, Study, StudyResults, run_study  # noqa: E402

from fcslam.features.detector import OnnxConfig, OnnxDetector  # noqa: E402
from fcslam.learning.export import detector_version, export_onnx  # noqa: E402
from fcslam.learning.federated.settings import FederatedSettings  # noqa: E402
from fcslam.learning.images import find_images  # noqa: E402
from fcslam.learning.network import KeypointNetwork  # noqa: E402

TINY = {
    "rounds": 2,
    "local_steps": 2,
    "training": {"pairs": 1, "side_px": 64, "label_copies": 1},
}
ARMS = {"averaged": Arm(), "bad": Arm(settings={"strategy": "fedmedian"}, poison="nan")}


@pytest.fixture(scope="module", autouse=True)
def brief(brief_validation):
    """Short validation, and one export of each network: several studies train the same ones."""
    files = {}

    def export_once(network, path):
        if (version := detector_version(network)) not in files:
            export_onnx(network, path)
            files[version] = path.read_bytes()
        path.write_bytes(files[version])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("evaluation.federated.study.export_onnx", export_once)
        yield


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    made = tmp_path_factory.mktemp("robots")
    for number, robot in enumerate(("north", "south")):
        (made / robot).mkdir()
        for seed in range(6):
            cv2.imwrite(str(made / robot / f"{seed}.png"), textured(100 * number + seed, 160, 128))
    return {robot: made / robot for robot in ("north", "south")}


def study(robots, folder, watch=lambda *_: None, **changes):
    given = {"arms": ARMS, "seeds": 2, "local_seeds": 2, "pairs": 4} | changes
    return Study(robots, folder, FederatedSettings.model_validate(TINY), on_progress=watch, **given)


@pytest.fixture(scope="module")
def finished(robots, tmp_path_factory):
    """The folder and the results of a whole study."""
    folder = tmp_path_factory.mktemp("finished")
    return folder, run_study(study(robots, folder))


@pytest.mark.training
def test_an_interrupted_study_ends_as_if_it_had_not_been(finished, robots, tmp_path):
    whole = finished[1]

    def stop(name, done, _of):
        if name == "averaged, seed 2" and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study(robots, tmp_path / "torn", stop))
    told = []
    torn = run_study(study(robots, tmp_path / "torn", lambda name, done, _of: told.append((name, done))))
    assert ("averaged, seed 2", 2) in told
    assert not [name for name, _ in told if name.startswith("central") or name == "averaged, seed 1"]
    assert {name: values.shape for name, values in whole.measured.items()} == {
        "start": (1, 1, 4, 5), "central": (2, 1, 4, 5), "local": (2, 2, 4, 5), "alone": (2, 2, 4, 5),
        "averaged": (2, 1, 4, 5), "bad": (2, 1, 4, 5),
    }  # fmt: skip
    assert whole.owners == (0, 0, 1, 1)
    start = whole.measured["start"]
    assert np.array_equal(start[..., 1], start[..., 3])  # it is the former network itself
    assert not np.array_equal(start, whole.measured["central"][:1], equal_nan=True)
    for name, values in whole.measured.items():
        assert np.array_equal(values, torn.measured[name], equal_nan=True)
    again = run_study(study(robots, tmp_path / "torn", lambda *_: pytest.fail("all is done")))
    assert again.robots == ("north", "south")


@pytest.mark.training
def test_a_network_matches_a_view_with_itself(robots, tmp_path):
    torch.manual_seed(1)
    network = KeypointNetwork("light").eval()
    network.body.code_head[-1].bias.data.zero_()  # or all its codes are equal
    export_onnx(network, tmp_path / "detector.onnx")
    detector = OnnxDetector(OnnxConfig(weights=tmp_path / "detector.onnx"))
    (pair,) = held_out_pairs("north", find_images([robots["north"]])[:1], 1)
    same = type(pair)(
        (pair.views[0], pair.views[0]), pair.valid, pair.teacher_valid, pair.teacher_descriptors, np.eye(3)
    )
    own = detect_features(detector, pair.views[0])
    correct, accuracy, again, former, between = measure_pair(detector, detector, same, own)
    assert (correct, again) == (1.0, 1.0)
    assert accuracy > 0.95
    assert former == between == accuracy
    assert measure_pair(detector, detector, same, DetectedFeatures(own.points, np.bitwise_not(own.codes)))[3] < 0.2
    nothing = DetectedFeatures(np.zeros((0, 2)), np.zeros((0, 32), np.uint8))
    assert measure_pair(detector, detector, same, nothing)[3] == 0.0


def findings(central, federated, local):
    """One seed, one measure's worth of pairs repeated for all measures; two robots own half of the pairs each."""
    count = len(central)
    owners = tuple(int(index >= count // 2) for index in range(count))

    def stacked(*networks):
        return np.stack([np.repeat(np.asarray(each, float)[:, None], len(MEASURES), axis=1) for each in networks])[None]

    measured = {"central": stacked(central), "local": stacked(*local), "federated": stacked(federated)}
    measured["alone"] = measured["local"] - 0.2
    return StudyResults(("north", "south"), owners, measured)


def test_gaps_are_paired_and_the_worst_robot_is_named():
    rng = np.random.default_rng(1)
    hard = rng.random(400)
    lost = np.where(np.arange(400) < 200, 0.0, 0.04)
    found = findings(hard, hard - lost, [hard - 0.1, hard - 0.3])
    rows = {row.arm: row for row in report(found) if row.measure == MEASURES[0]}
    assert rows["central"].gap == (0.0, 0.0, 0.0)
    assert rows["federated"].gap.mean == pytest.approx(0.02)
    assert 0.017 < rows["federated"].gap.low < 0.02 < rows["federated"].gap.high < 0.023
    assert (rows["federated"].worst_robot, rows["federated"].worst_gap) == ("south", pytest.approx(0.04))
    assert rows["federated"].closed == pytest.approx((0.2 - 0.02) / 0.2)
    assert rows["federated"].closed_alone == pytest.approx((0.4 - 0.02) / 0.4)
    assert rows["local"].mean == pytest.approx(hard.mean() - 0.2)
    assert rows["local"].closed == pytest.approx(0.0)
