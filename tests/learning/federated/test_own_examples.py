"""Examples of a robot that learns: keyframes on disk, split once and for all."""

import threading
import time

import numpy as np
import pytest
import torch

from fcslam.errors import InputError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.learning.federated.client import RevisitClient
from fcslam.learning.federated.held_out import judge
from fcslam.learning.federated.initial_weights import read_detector_weights
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.federated.robot_learning import SPLIT_FILE, LearningRobot, own_examples
from fcslam.records import Channel, Place
from fcslam.robot.backend import RobotBackend
from fcslam.robot.backend_runner import inline
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.keyframe_folder import KeyframeFolder, read_keyframes
from fcslam.wire.packets import decode, encode
from tests.robot.test_views import records_of

pytestmark = pytest.mark.slow

CODE_LAYER, POINT_BIAS = "body.code_head.0.0.weight", "body.refine.4.bias"
SIDE_M = 3.0


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """The folder of a robot that drove to and fro, and its camera places as the cloud reads them."""
    folder = tmp_path_factory.mktemp("keyframes")
    config = RobotConfig(channels=(Channel.CAMERA,))
    robot = RobotFrontend("r", config, inline(RobotBackend("r", config, folder)))
    records = records_of([(1.5, 1.5), (11.0, 1.5), (2.0, 1.5)], 1)[0]
    packets = [each for record in records for each in robot.process(record)] + robot.finish()
    bodies = [decode(encode(each)).body for each in packets]
    return folder, [body for body in bodies if isinstance(body, Place)]


def test_keyframes_come_back_with_the_poses_of_the_robots_own_map(driven):
    folder, places = driven
    frames = read_keyframes(folder, 1000)
    assert {place.id.number for place in places} <= {frame.image.keyscan for frame in frames}
    assert np.ptp([frame.T_own_base[0] for frame in frames]) > 7.0
    assert [frame.image.keyscan for frame in read_keyframes(folder, 3)] == [f.image.keyscan for f in frames[-3:]]


def test_a_version_is_judged_by_the_keypoints_and_codes_that_it_finds(driven):
    (driven[0] / SPLIT_FILE).unlink(missing_ok=True)
    _, held_out = own_examples(driven[0], SIDE_M)
    start = read_detector_weights(BUNDLED_NETWORK, "light")
    scale = np.random.default_rng(1).standard_normal(start[CODE_LAYER].shape) * start[CODE_LAYER].std()
    others = {"noisy": {CODE_LAYER: start[CODE_LAYER] + np.float32(2.0) * scale.astype(np.float32)},
              "blind": {POINT_BIAS: start[POINT_BIAS] - np.float32(100.0)}}  # fmt: skip
    rows = {
        name: judge(weights_to_network({**start, **changed}, "light"), held_out, torch.device("cpu"))
        for name, changed in {"bundled": {}, **others}.items()
    }
    assert len(rows["bundled"]) == len(held_out.revisits) > 0
    recall = {name: float(each[:, 0].mean()) for name, each in rows.items()}
    assert recall["bundled"] > 0.3
    assert recall["noisy"] < 0.7 * recall["bundled"]
    assert recall["blind"] == 0.0
    assert np.nansum(rows["blind"][:, 1]) == 0.0


def test_a_keyframe_that_is_held_out_is_never_trained_on(driven):
    folder, _ = driven
    (folder / SPLIT_FILE).unlink(missing_ok=True)
    revisits, held_out = own_examples(folder, SIDE_M)
    trained = {image.tobytes() for image in revisits.images}
    judged = {frame.image.tobytes() for frame in held_out.frames}
    assert trained
    assert judged
    assert not trained & judged
    _, again = own_examples(folder, 1.0)  # as if the map had moved to other squares
    assert {frame.image.tobytes() for frame in again.frames} == judged


def test_a_damaged_keyframe_is_left_out(driven, tmp_path):
    folder, _ = driven
    frames = read_keyframes(folder, 1000)
    for path in folder.glob("*.state"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / f"0-{frames[0].image.keyscan}.state").write_bytes(b"broken")
    assert len(read_keyframes(tmp_path, 1000)) == len(frames) - 1
    (tmp_path / "0-poses.state").unlink()
    assert read_keyframes(tmp_path, 1000) == []


def test_a_full_disk_ends_keyframes_and_not_the_map(driven, tmp_path, monkeypatch):
    frame = read_keyframes(driven[0], 1)[0]

    def full(*_):
        raise OSError("no space left")

    monkeypatch.setattr("fcslam.robot.keyframe_folder.write_state", full)
    folder = KeyframeFolder(tmp_path / "keyframes")
    folder.keep(frame.image, frame.features, "light-1")
    folder.place(np.zeros((3, 3)))
    assert read_keyframes(tmp_path / "keyframes", 10) == []


def test_a_robot_learns_only_while_it_is_idle_and_its_budget_lasts(driven, tmp_path):
    idle, told = threading.Event(), []
    client = RevisitClient("alice", tmp_path)
    robot = LearningRobot(driven[0], client, time.process_time() + 1e3, idle, told.append)
    working = threading.Thread(target=robot.prepare, daemon=True)
    working.start()
    working.join(0.3)
    assert working.is_alive()
    idle.set()
    working.join(60.0)
    assert client.revisits
    assert len(told) == 1
    spent = LearningRobot(driven[0], client, 1e-3, idle, told.append)
    with pytest.raises(InputError, match="CPU time"):
        spent.prepare()
