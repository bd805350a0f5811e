"""A robot's part: real training from given weights on its own images, and nothing of these in what it sends."""

import shutil
from functools import partial

import cv2
import numpy as np
import pytest

from tests.learning.textures import textured

torch = pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.errors import TrainingError  # noqa: E402
from fcslam.learning.arrays import write_arrays  # noqa: E402
from fcslam.learning.code_batches import RevisitExamples, RevisitPair  # noqa: E402
from fcslam.learning.federated.client import RobotClient, robot_seed  # noqa: E402
from fcslam.learning.federated.networks import network_to_weights, weights_to_network, weights_version  # noqa: E402
from fcslam.learning.federated.settings import FederatedSettings  # noqa: E402
from fcslam.learning.federated.weights import trained_names  # noqa: E402
from fcslam.learning.local_training import layer_names, network_from_state  # noqa: E402
from fcslam.learning.network import KeypointNetwork  # noqa: E402
from fcslam.untrusted import read_arrays  # noqa: E402

pytestmark = pytest.mark.slow

TINY = {"rounds": 2, "local_steps": 2, "training": {"pairs": 1, "side_px": 64, "points": 32, "label_copies": 1}}


def settings(**given):
    return FederatedSettings.model_validate(TINY | given)


@pytest.fixture(scope="module")
def start():
    torch.manual_seed(3)
    return network_to_weights(KeypointNetwork("light"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("images")
    for seed in range(3):
        cv2.imwrite(str(made / f"{seed}.png"), textured(seed))
    return made


def robot(folder, cache, name="rover"):
    return RobotClient(name, folder, cache)


def labels_in(cache):
    return [file for file in cache.rglob("*.npz") if not file.stem.startswith("moments")]


def same(first, second):
    return all(np.array_equal(first[name], second[name]) for name in first)


def test_a_round_depends_on_its_arguments_alone(folder, start, tmp_path):
    whole = robot(folder, tmp_path / "labels").train(start, 0, "run", settings())
    kept = {name: array.copy() for name, array in start.items()}
    again = robot(folder, tmp_path / "labels").train(start, 0, "run", settings())
    assert same(whole.weights, again.weights)
    assert same(kept, start)
    other = robot(folder, tmp_path / "labels", "other").train(start, 0, "run", settings())
    later = robot(folder, tmp_path / "labels").train(start, 1, "run", settings())
    assert not same(whole.weights, other.weights)
    assert not same(whole.weights, later.weights)
    assert whole.weights.keys() == start.keys()
    assert {array.dtype for array in whole.weights.values()} == {np.dtype(np.float32)}


def test_labels_stay_those_of_the_first_weights(folder, start, tmp_path):
    first = robot(folder, tmp_path)
    first.train(start, 0, "run", settings())
    labels = {file: file.read_bytes() for file in labels_in(tmp_path)}
    assert len(labels) == 3
    moved = {name: array * np.float32(1.1) for name, array in start.items()}
    fresh = robot(folder, tmp_path)
    assert same(first.train(moved, 1, "run", settings()).weights, fresh.train(moved, 1, "run", settings()).weights)
    assert {file: file.read_bytes() for file in labels_in(tmp_path)} == labels


def test_a_robot_labels_no_more_images_than_asked(folder, start, tmp_path):
    RobotClient("rover", folder, tmp_path, most_images=2).train(start, 0, "run", settings())
    assert len(labels_in(tmp_path)) == 2


def test_the_optimizer_goes_on_from_the_robots_last_round(folder, start, tmp_path):
    def train(cache, round_number, run="run"):
        return robot(folder, tmp_path / cache).train(start, round_number, run, settings(rounds=9)).weights

    def kept(cache):
        return {int(file.stem.split("-")[-1]) for file in (tmp_path / cache).glob("moments-*.npz")}

    train("a", 0)
    fresh, second = train("b", 3), train("a", 3)
    assert not same(second, fresh), "it has learnt of gradients in round 0"
    assert same(train("a", 3), second), "asked again, it begins where it began before"
    assert same(train("a", 3, "another run"), fresh)
    shutil.copytree(tmp_path / "a", tmp_path / "c")
    train("a", 4)
    assert not same(train("a", 5), train("c", 5))
    assert kept("a") == {3, 4, 5}  # 3 is the other run's
    train("a", 0)
    assert same(train("a", 3), second), "a run that begins anew does not know what came later"


def test_what_cannot_be_kept_or_gone_on_with_is_told(folder, start, tmp_path):
    robot(folder, tmp_path).train(start, 0, "run", settings())
    (moments,) = tmp_path.glob("moments-*.npz")
    whole = read_arrays(moments)
    of_another = {"0/exp_avg_sq": np.zeros(3, np.float32)}
    halved = {name: array for name, array in whole.items() if name != "0/exp_avg_sq"}
    for odd in (whole | of_another, halved, {"0/exp_avg": whole["0/exp_avg"]}, {"nonsense": np.zeros(1)}):
        write_arrays(moments, odd)
        with pytest.raises(TrainingError, match="cannot continue"):
            robot(folder, tmp_path).train(start, 1, "run", settings())
    write_arrays(moments, {"0/step": np.array("text")})
    with pytest.raises(TrainingError, match="cannot be read"):
        robot(folder, tmp_path).train(start, 1, "run", settings())
    moments.write_bytes(b"broken")
    with pytest.raises(TrainingError, match=rf"{moments.name}: the optimizer's state cannot be read"):
        robot(folder, tmp_path).train(start, 1, "run", settings())
    moments.unlink()
    moments.mkdir()
    with pytest.raises(TrainingError, match=rf"{moments.name}: the optimizer's state cannot be kept"):
        robot(folder, tmp_path).train(start, 0, "run", settings())


def test_codes_are_kept_to_those_of_the_run_s_first_weights(folder, start, tmp_path):
    chosen = settings(compatible=100.0)
    torch.manual_seed(4)
    moved = network_to_weights(KeypointNetwork("light"))
    first = robot(folder, tmp_path / "a")
    assert "former" in first.train(start, 0, "run", chosen).losses
    assert "former" not in robot(folder, tmp_path / "b").train(start, 0, "run", settings()).losses
    later = first.train(moved, 1, "run", chosen).weights
    restarted = robot(folder, tmp_path / "a")
    assert same(restarted.train(moved, 1, "run", chosen).weights, later)
    assert not same(restarted.train(moved, 1, "another run", chosen).weights, later), "began before it was asked"
    assert same(restarted.train(moved, 1, "run", chosen).weights, later), "goes on as it was"
    (former,) = {file for file in (tmp_path / "a").glob("former-*.npz") if same(read_arrays(file), start)}
    former.unlink()
    assert not same(restarted.train(moved, 1, "run", chosen).weights, later)
    restarted.train(start, 0, "run", chosen)
    assert same(restarted.train(moved, 1, "run", chosen).weights, later)


def test_a_robot_that_cannot_keep_the_first_weights_says_so(folder, start, tmp_path):
    robot(folder, tmp_path).train(start, 0, "run", settings(compatible=1.0))
    (former,) = tmp_path.glob("former-*.npz")
    former.unlink()
    former.mkdir()
    with pytest.raises(TrainingError, match=rf"{former.name}: the weights of the legacy detector cannot be kept"):
        robot(folder, tmp_path).train(start, 0, "run", settings(compatible=1.0))


def test_frozen_statistics_stay_and_averaged_ones_move(folder, start, tmp_path):
    statistics = [name for name in start if name not in trained_names(start, frozen_statistics=True)]
    assert statistics
    for normalisation, stay in (("frozen", True), ("averaged", False)):
        learned = robot(folder, tmp_path).train(start, 0, "run", settings(normalisation=normalisation))
        assert all(np.array_equal(learned.weights[name], start[name]) for name in statistics) is stay


def test_private_layers_continue_from_the_robots_own_last_round(folder, start, tmp_path):
    private = settings(private=["body.point_head"])
    names = [name for name in start if name.startswith("body.point_head.")]
    client = robot(folder, tmp_path)
    first = client.train(start, 0, "run", private)
    again = client.train(start, 1, "run", private)
    assert names
    assert not same({name: first.weights[name] for name in names}, start)
    own = start | {name: first.weights[name] for name in names}
    assert same(client.train(own, 1, "run", settings()).weights, again.weights)
    assert not same(client.train(start, 1, "run", settings()).weights, again.weights)


def test_a_robot_evaluates_with_its_own_private_layers(folder, start, tmp_path):
    private = settings(private=["body.point_head"])
    client = robot(folder, tmp_path)
    trained = client.train(start, 0, "run", private).weights
    names = [name for name in start if name.startswith("body.point_head.")]
    own = start | {name: trained[name] for name in names}
    blind = start | {name: np.zeros_like(start[name]) for name in names}
    assert same(own, client.own_weights(blind, 0, "run", private))
    found = client.evaluate(own, 0, "run", settings())
    assert client.evaluate(blind, 0, "run", private) == found
    assert client.evaluate(blind, 0, "another run", private) != found


def test_robots_and_seeds_draw_differently():
    assert len({robot_seed(name, seed) for name in "abc" for seed in (1, 2)}) == 6


@pytest.mark.parametrize("content", ["none", "one", "broken"])
def test_too_few_images_are_said(content, start, tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    if content == "one":
        cv2.imwrite(str(images / "1.png"), textured(1))
    if content == "broken":
        for index in range(5):
            (images / f"{index}.png").write_bytes(b"no image")
    with pytest.raises(TrainingError, match=r"images: holds no image|only . of . image files can be trained on"):
        robot(images, tmp_path / "labels").train(start, 0, "run", settings())


def test_weights_of_another_network_are_refused(folder, start, tmp_path):
    chosen = settings(training={"encoder": "vgg"} | TINY["training"])
    with pytest.raises(TrainingError, match="no weights of a vgg network"):
        robot(folder, tmp_path).train(start, 0, "run", chosen)
    with pytest.raises(TrainingError, match="not those of a light network"):
        network_from_state("light", {})


def test_weights_become_the_same_network_again(start):
    torch.manual_seed(5)
    image = torch.rand(1, 1, 64, 64)
    network = KeypointNetwork("light").eval()
    again = weights_to_network(network_to_weights(network), "light")
    assert torch.equal(network(image).code_logits, again(image).code_logits)
    version = partial(weights_version, encoder="light")
    assert version(network_to_weights(network)) == version(network_to_weights(again)) != version(start)


def test_codes_are_trained_on_revisits_and_need_no_image_files(start, tmp_path):
    images = [textured(seed, 96, 96) for seed in range(2)]
    points = np.random.default_rng(1).uniform(8, 88, (30, 2)).astype(np.float32)
    pair = RevisitPair((0, 1), (points, points), np.full((30, 3), np.nan))
    codes = settings(trained="codes", normalisation="frozen")

    def update(name, revisits, round_number=0):
        client = RobotClient(name, tmp_path, tmp_path / name, revisits=revisits)
        return client.train(start, round_number, "run", codes).weights

    found = update("a", RevisitExamples(images, [pair]))
    changed = {name for name, array in found.items() if not np.array_equal(array, start[name])}
    assert changed
    network = KeypointNetwork("light")
    assert changed <= layer_names(network, network.body.code_layers)
    assert not same(found, update("b", RevisitExamples(images[::-1], [pair])))
    with pytest.raises(TrainingError, match="no place was"):
        update("c", RevisitExamples(images))
