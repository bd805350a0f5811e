"""A robot's part: real training from given weights on its own images, and nothing of these in what it sends."""

import shutil

import cv2
import numpy as np
import pytest
import torch

from fcslam.errors import InputError
from fcslam.learning.code_batches import RevisitExamples, RevisitPair
from fcslam.learning.federated.client import STATE_FILE, ImageClient, RevisitClient
from fcslam.learning.federated.messages import TrainingRequest
from fcslam.learning.federated.networks import network_to_weights
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.network import KeypointNetwork, layer_names, network_from_state
from fcslam.storage.state_file import read_state, write_state
from tests.learning.textures import textured

pytestmark = pytest.mark.slow

TINY = {"rounds": 2, "local_steps": 2, "training": {"pairs": 1, "side_px": 64, "label_copies": 1}}


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


def learn(client, weights, number=0, run="run", chosen=None):
    return client(TrainingRequest(True, weights, "v", number, run, chosen or settings()))[0]


def robot(folder, cache, name="rover", **given):
    return ImageClient(name, cache, folder=folder, **given)


def labels_in(cache):
    return [file for file in cache.rglob("*.state") if file.name != STATE_FILE]


def same(first, second):
    return all(np.array_equal(first[name], second[name]) for name in first)


def test_a_round_depends_on_its_arguments_alone(folder, start, tmp_path):
    whole = learn(robot(folder, tmp_path / "labels"), start)
    kept = {name: array.copy() for name, array in start.items()}
    again = learn(robot(folder, tmp_path / "labels"), start)
    assert same(whole, again)
    assert same(kept, start)
    other = learn(robot(folder, tmp_path / "labels", "other"), start)
    later = learn(robot(folder, tmp_path / "labels"), start, 1)
    assert not same(whole, other)
    assert not same(whole, later)
    assert whole.keys() == start.keys()
    assert {array.dtype for array in whole.values()} == {np.dtype(np.float32)}


def test_labels_stay_those_of_the_first_weights(folder, start, tmp_path):
    first = robot(folder, tmp_path)
    learn(first, start)
    labels = {file: file.read_bytes() for file in labels_in(tmp_path)}
    assert len(labels) == 3
    moved = {name: array * np.float32(1.1) for name, array in start.items()}
    assert same(learn(first, moved, 1), learn(robot(folder, tmp_path), moved, 1))
    assert {file: file.read_bytes() for file in labels_in(tmp_path)} == labels


def test_the_optimizer_goes_on_from_the_robots_last_round(folder, start, tmp_path):
    def train(cache, round_number, run="run"):
        return learn(robot(folder, tmp_path / cache), start, round_number, run, settings(rounds=9))

    def kept(cache):
        return set(read_state(tmp_path / cache / STATE_FILE, "run")["moments"])

    train("a", 0)
    fresh, second = train("b", 3), train("a", 3)
    assert not same(second, fresh), "it has learnt of gradients in round 0"
    assert same(train("a", 3), second), "asked again, it begins where it began before"
    shutil.copytree(tmp_path / "a", tmp_path / "c")
    shutil.copytree(tmp_path / "a", tmp_path / "d")
    assert same(train("d", 3, "another run"), fresh)
    train("a", 4)
    assert not same(train("a", 5), train("c", 5))
    assert kept("a") == {"4", "5"}
    train("a", 0)
    assert same(train("a", 3), second), "a run that begins anew does not know what came later"


def test_what_cannot_be_kept_or_gone_on_with_is_told(folder, start, tmp_path):
    fresh = learn(robot(folder, tmp_path), start, 1)
    (tmp_path / STATE_FILE).unlink()
    learn(robot(folder, tmp_path), start, 0)
    state = read_state(tmp_path / STATE_FILE, "run")
    whole = state["moments"]["0"]
    halved = {name: array for name, array in whole.items() if name != "0/exp_avg_sq"}
    for odd in (whole | {"0/exp_avg_sq": np.zeros(3, np.float32)}, halved, {"nonsense": np.zeros(1)}):
        write_state(tmp_path / STATE_FILE, "run", {"moments": {"0": odd}})
        with pytest.raises(InputError, match="cannot continue"):
            learn(robot(folder, tmp_path), start, 1)
    (tmp_path / STATE_FILE).write_bytes(b"broken")
    assert same(learn(robot(folder, tmp_path), start, 1), fresh), "it begins anew"
    (tmp_path / STATE_FILE).unlink()
    (tmp_path / STATE_FILE).mkdir()
    with pytest.raises(InputError, match=STATE_FILE):
        learn(robot(folder, tmp_path), start, 0)


@pytest.mark.parametrize("content", ["none", "one", "broken"])
def test_too_few_images_are_said(content, start, tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    if content == "one":
        cv2.imwrite(str(images / "1.png"), textured(1))
    if content == "broken":
        for index in range(5):
            (images / f"{index}.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"images: holds no image|only . of . image files can be trained on"):
        learn(robot(images, tmp_path / "labels"), start, 0)


def test_weights_of_another_network_are_refused(folder, start, tmp_path):
    chosen = settings(training={"encoder": "vgg"} | TINY["training"])
    with pytest.raises(InputError, match="no weights of a vgg network"):
        learn(robot(folder, tmp_path), start, chosen=chosen)
    with pytest.raises(InputError, match="not those of a light network"):
        network_from_state("light", {})


@pytest.fixture
def seen_again():
    images = [textured(seed, 96, 96) for seed in range(2)]
    points = np.random.default_rng(1).uniform(8, 88, (30, 2)).astype(np.float32)
    return RevisitExamples(images, [RevisitPair((0, 1), (points, points), np.full((30, 3), np.nan))])


def test_codes_are_trained_on_revisits_and_need_no_image_files(start, tmp_path, seen_again):
    def update(name, revisits):
        return learn(RevisitClient(name, tmp_path / name, revisits=revisits), start)

    found = update("a", seen_again)
    changed = {name for name, array in found.items() if not np.array_equal(array, start[name])}
    assert changed
    network = KeypointNetwork("light")
    assert changed <= layer_names(network, network.body.code_layers)
    assert not any(name.endswith(("running_mean", "running_var")) for name in changed)
    assert not same(found, update("b", RevisitExamples(seen_again.images[::-1], seen_again.pairs)))
    with pytest.raises(InputError, match="no place was"):
        update("c", RevisitExamples(seen_again.images))


def test_codes_are_kept_to_those_of_the_run_s_first_weights(start, tmp_path, seen_again):
    def trained(cache, weights, number, run="run"):
        client = RevisitClient("rover", tmp_path / cache, revisits=seen_again)
        return learn(client, weights, number, run, settings(rounds=9))

    torch.manual_seed(4)
    moved = network_to_weights(KeypointNetwork("light"))
    trained("a", start, 0)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    later = trained("a", moved, 1)
    assert same(trained("a", moved, 1), later), "started again, it goes on as it was"
    assert not same(trained("b", moved, 1, "another run"), later), "began before it was asked"
