"""The study of federated training: it compares like with like, resumes, and its arithmetic is right."""

import fcntl
import shutil
from threading import Lock, Thread

import cv2
import numpy as np
import pytest

from tests.learning.textures import textured

torch = pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.errors import EvaluationError  # noqa: E402
from fcslam.features.detector import OnnxConfig, OnnxDetector  # noqa: E402
from fcslam.lab.evaluation.federated.pairs import (  # noqa: E402
    MEASURES,
    DetectedFeatures,
    detect_features,
    held_out_pairs,
    measure_pair,
)
from fcslam.lab.evaluation.federated.poison import PoisonedClient  # noqa: E402
from fcslam.lab.evaluation.federated.report import report  # noqa: E402
from fcslam.lab.evaluation.federated.study import Study, StudyResults, StudySettings, run_study  # noqa: E402
from fcslam.learning.export import detector_version, export_onnx  # noqa: E402
from fcslam.learning.federated.settings import FederatedSettings  # noqa: E402
from fcslam.learning.images import find_images  # noqa: E402
from fcslam.learning.network import KeypointNetwork  # noqa: E402
from fcslam.learning.trainer import ExecutionOptions  # noqa: E402
from tests.learning.federated.fakes import Fake  # noqa: E402

TINY = {
    "federated": {
        "rounds": 2,
        "local_steps": 2,
        "training": {"shape_steps": 2, "pairs": 1, "side_px": 64, "points": 32, "label_copies": 1},
    },
    "arms": {"averaged": {}, "bad": {"settings": {"strategy": "fedmedian"}, "poison": "nan"}},
    "seeds": 2,
    "pairs": 4,
}


@pytest.fixture(scope="module", autouse=True)
def brief(brief_validation):
    """Short validation, and one export of each network: several studies train the same ones."""
    files, lock = {}, Lock()

    def export_once(network, path):
        with lock:  # the exporter has globals, and two studies may run in threads
            if (version := detector_version(network)) not in files:
                export_onnx(network, path)
                files[version] = path.read_bytes()
        path.write_bytes(files[version])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fcslam.lab.evaluation.federated.study.export_onnx", export_once)
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
    return Study(robots, folder, StudySettings.model_validate(TINY | changes), ExecutionOptions(), watch)


@pytest.fixture(scope="module")
def finished(robots, tmp_path_factory):
    """The folder and the results of a whole study."""
    folder = tmp_path_factory.mktemp("finished")
    return folder, run_study(study(robots, folder))


def with_shapes(finished, folder):
    """A folder in which the weights that all arms start from are trained already."""
    shutil.copytree(finished[0] / "shapes", folder / "shapes")
    return folder


@pytest.mark.system
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
        "start": (1, 1, 4, 4), "central": (2, 1, 4, 4), "local": (2, 2, 4, 4), "alone": (2, 2, 4, 4),
        "averaged": (2, 1, 4, 4), "bad": (2, 1, 4, 4),
    }  # fmt: skip
    assert whole.owners == (0, 0, 1, 1)
    start = whole.measured["start"]
    assert np.array_equal(start[..., 1], start[..., 3])  # it is the former network itself
    assert not np.array_equal(start, whole.measured["central"][:1], equal_nan=True)
    for name, values in whole.measured.items():
        assert np.array_equal(values, torn.measured[name], equal_nan=True)
    assert run_study(study(robots, tmp_path / "torn", lambda *_: pytest.fail("all is done"))).robots == (
        "north",
        "south",
    )
    for changed in ({"pairs": 6}, {"arms": {"averaged": {"poison": "nan"}}}):
        with pytest.raises(EvaluationError, match="another study"):
            run_study(study(robots, tmp_path / "torn", **changed))


@pytest.mark.system
def test_arms_and_seeds_may_be_added_to_a_study(finished, robots, tmp_path):
    with_shapes(finished, tmp_path)
    run_study(study(robots, tmp_path, seeds=1, arms={"averaged": {"seeds": 1}}))
    told = []
    arms = {"averaged": {}, "frozen": {"settings": {"normalisation": "frozen"}, "seeds": 1}}
    found = run_study(study(robots, tmp_path, lambda name, *_: told.append(name), seeds=2, arms=arms))
    assert {name: len(values) for name, values in found.measured.items()} == {
        "start": 1, "central": 2, "local": 2, "alone": 2, "averaged": 2, "frozen": 1,
    }  # fmt: skip
    assert "frozen, seed 1" in told
    assert "central, seed 1" not in told
    with pytest.raises(EvaluationError, match="another study"):
        run_study(study(robots, tmp_path, seeds=2, arms={"averaged": {"poison": "nan", "seeds": 1}}))


def test_nobody_reads_what_a_study_is_while_another_begins_it(robots, tmp_path, monkeypatch):
    begun = study(robots, tmp_path)
    monkeypatch.setattr("fcslam.lab.evaluation.federated.study._files_of_arms", lambda _: {})
    run_study(begun)
    content = (tmp_path / "study.yaml").read_bytes()
    with (tmp_path / "study.lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        (tmp_path / "study.yaml").write_bytes(b"")
        waiting = Thread(target=run_study, args=(begun,), daemon=True)
        waiting.start()
        waiting.join(0.5)
        assert waiting.is_alive()
        assert not (tmp_path / "study.yaml").read_bytes()
        (tmp_path / "study.yaml").write_bytes(content)
    waiting.join(60.0)
    assert not waiting.is_alive()
    assert (tmp_path / "study.yaml").read_bytes() == content


@pytest.mark.system
def test_robots_own_networks_may_have_fewer_seeds_and_images(finished, robots, tmp_path):
    with_shapes(finished, tmp_path)
    settings = {"local_seeds": 1, "trained": 3, "arms": {}}
    found = run_study(study(robots, tmp_path, **settings))
    assert {name: len(values) for name, values in found.measured.items()} == {
        "start": 1, "central": 2, "local": 1, "alone": 1,
    }  # fmt: skip
    assert len(list((tmp_path / "labels").rglob("*.npz"))) == 2 * 3
    assert all(np.isfinite(row.gap.mean) for row in report(found))
    more = run_study(study(robots, tmp_path, **settings | {"local_seeds": 2}))
    assert len(more.measured["local"]) == 2
    without = run_study(study(robots, tmp_path, **settings | {"local_seeds": 0}))
    assert set(without.measured) == {"start", "central"}
    rows = report(without)
    assert all(np.isfinite(row.gap.mean) for row in rows)
    assert all(np.isnan([row.closed, row.closed_alone]).all() for row in rows)


@pytest.mark.slow
def test_two_at_one_study_share_the_work_out(finished, robots, tmp_path):
    with_shapes(finished, tmp_path)
    told, found = [], []

    def work(watch):
        found.append(run_study(study(robots, tmp_path, watch, seeds=1, arms={"averaged": {}})))

    helper = Thread(target=work, args=(lambda name, *_: told.append((2, name)),))

    def begin(name, *_):
        told.append((1, name))
        if name == "central, seed 1" and not helper.ident:
            helper.start()

    work(begin)
    helper.join()
    trained = {name: {who for who, each in told if each == name} for _, name in told if ", seed" in name}
    assert all(len(by) == 1 for by in trained.values())
    assert {who for by in trained.values() for who in by} == {1, 2}
    for name, values in found[0].measured.items():
        assert np.array_equal(values, found[1].measured[name], equal_nan=True)


@pytest.mark.slow
def test_robots_own_networks_share_the_pairs_out(finished):
    local = finished[1].measured["local"]
    shown = np.isfinite(local[..., 0])
    assert (shown.sum(axis=1) == 1).all()
    assert (shown.sum(axis=0) == 1).all()  # over two seeds each of both networks sees each pair once


@pytest.mark.slow
def test_all_begin_from_the_start_that_is_named(finished, robots, tmp_path):
    folder, first = finished
    seen = set()
    changes = {"seeds": 1, "arms": {"averaged": {}}, "start": folder / "shapes" / "checkpoint.npz"}
    again = run_study(study(robots, tmp_path, lambda name, *_: seen.add(name), **changes))
    assert "shapes" not in seen
    assert all(
        np.array_equal(first.measured[name][:1], again.measured[name], equal_nan=True) for name in again.measured
    )


@pytest.mark.slow
def test_every_network_sees_as_many_samples(finished, robots, tmp_path):
    with_shapes(finished, tmp_path)
    steps = {}

    def watch(name, done, of):
        steps[name] = of

    wide = {"together": False, "settings": {"training": TINY["federated"]["training"] | {"pairs": 2}}}
    run_study(study(robots, tmp_path, watch, seeds=1, arms={"averaged": {}, "wide": wide}))
    assert steps["central, seed 1"] == steps["local-north, seed 1"] == steps["local-south, seed 1"] == 2 * 2 * 2
    assert steps["alone-north, seed 1"] == 2 * 2
    assert steps["averaged, seed 1"] == 2
    assert steps["wide, seed 1"] == 2 * 2


@pytest.mark.parametrize("name", ["start", "central", "local-north", "alone", "a/b"])
def test_an_arm_may_not_take_the_name_of_another(name, robots, tmp_path):
    with pytest.raises(EvaluationError, match=name):
        run_study(study(robots, tmp_path, arms={name: {}}))


@pytest.mark.slow
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
    correct, accuracy, again, former = measure_pair(detector, same, own)
    assert (correct, again) == (1.0, 1.0)
    assert accuracy > 0.95
    assert former == accuracy
    assert measure_pair(detector, same, DetectedFeatures(own.points, np.bitwise_not(own.codes)))[3] < 0.2
    nothing = DetectedFeatures(np.zeros((0, 2)), np.zeros((0, 32), np.uint8))
    assert measure_pair(detector, same, nothing)[3] == 0.0


def findings(central, federated, local):
    """One seed, one measure's worth of pairs repeated for all measures; two robots own half of the pairs each."""
    count = len(central)
    owners = tuple(int(index >= count // 2) for index in range(count))

    def stacked(*networks):
        return np.stack([np.repeat(np.asarray(each, float)[:, None], len(MEASURES), axis=1) for each in networks])[None]

    measured = {"central": stacked(central), "local": stacked(*local), "federated": stacked(federated)}
    measured["alone"] = measured["local"] - 0.2
    return StudyResults(("north", "south"), owners, measured)


def test_an_arm_of_fewer_seeds_is_compared_with_those():
    rng = np.random.default_rng(3)
    central = rng.random(60)
    whole = findings(central, central - 0.1, [central - 0.2, central - 0.2])
    later = findings(central + 0.5, central, [central - 0.2, central - 0.2]).measured
    measured = {name: np.concatenate((whole.measured[name], later[name])) for name in ("central", "local", "alone")}
    measured |= {"federated": whole.measured["federated"], "poor": whole.measured["federated"] - 0.03}
    found = StudyResults(whole.robots, whole.owners, measured)
    rows = {row.arm: row for row in report(found) if row.measure == MEASURES[0]}
    assert rows["federated"].gap.mean == pytest.approx(0.1)
    assert rows["federated"].closed == pytest.approx(0.5)
    assert rows["local"].gap.mean == pytest.approx(0.45)
    against = {row.arm: row for row in report(found, against="federated") if row.measure == MEASURES[0]}
    assert against["poor"].gap == pytest.approx((0.03, 0.03, 0.03))


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


def test_nothing_is_closed_where_central_is_no_better():
    rng = np.random.default_rng(2)
    central = rng.random(50)
    rows = report(findings(central, central, [central + 0.01 * rng.normal(size=50)]))
    assert all(np.isnan(row.closed) for row in rows)


@pytest.mark.parametrize("poison", ["flipped", "scaled", "reversed", "random", "nan"])
def test_poison_is_what_it_says(poison):
    before = {"weight": np.zeros(6, np.float32)}
    bad = PoisonedClient(Fake("x", answer=lambda *_: {"weight": np.arange(6, dtype=np.float32)}), poison)
    sent = bad.train(before, 0, "run", FederatedSettings()).weights["weight"]
    expected = {
        "flipped": -np.arange(6.0),
        "scaled": 10 * np.arange(6.0),
        "reversed": -10 * np.arange(6.0),
        "nan": np.full(6, np.nan),
    }
    if poison == "random":
        assert sorted(sent) == list(range(6))
        assert list(sent) != list(range(6))
    else:
        assert np.array_equal(sent, expected[poison], equal_nan=True)
