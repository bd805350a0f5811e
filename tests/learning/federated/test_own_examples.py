"""Examples of a robot that learns: keyframes on disk, split once and for all, and taught codes at the right pixels."""

import asyncio
import hashlib
import json
import time

import httpx
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.features.detector import BUNDLED_NETWORK  # noqa: E402
from fcslam.learning.federated.fleet_grid import FleetGrid  # noqa: E402
from fcslam.learning.federated.fleet_server import FleetApp  # noqa: E402
from fcslam.learning.federated.held_out import judge  # noqa: E402
from fcslam.learning.federated.initial_weights import read_detector_weights  # noqa: E402
from fcslam.learning.federated.live_settings import HeldOutSettings, RobotLearningSettings  # noqa: E402
from fcslam.learning.federated.networks import weights_to_network  # noqa: E402
from fcslam.learning.federated.own_examples import SPLIT_FILE, own_examples  # noqa: E402
from fcslam.learning.federated.robot_learning import (  # noqa: E402
    BusyRobotError,
    Idleness,
    LearningEndError,
    LearningRobot,
    checked_lessons,
)
from fcslam.records import Channel, Place, frozen  # noqa: E402
from fcslam.robot.backend import RobotBackend  # noqa: E402
from fcslam.robot.beside import Inline  # noqa: E402
from fcslam.robot.frontend import RobotConfig, RobotFrontend  # noqa: E402
from fcslam.robot.keyframe_folder import KeyframeFolder, read_keyframes  # noqa: E402
from fcslam.service.http.authentication import Authenticator, Role, TokenEntry  # noqa: E402
from fcslam.wire.batches import write_batch  # noqa: E402
from fcslam.wire.messages import Packet, TaughtPlace  # noqa: E402
from fcslam.wire.packets import decode, encode  # noqa: E402
from tests.robot.test_views import records_of  # noqa: E402
from tests.wire.examples import ACKNOWLEDGEMENT, TAUGHT_PLACE, packet  # noqa: E402

CODE_LAYER, POINT_BIAS = "body.code_head.0.0.weight", "body.refine.4.bias"
SETTINGS = RobotLearningSettings(held_out=HeldOutSettings(side_m=3.0))


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """The folder of a robot that drove to and fro, and its camera places as the cloud reads them."""
    folder = tmp_path_factory.mktemp("keyframes")
    config = RobotConfig(channels=(Channel.CAMERA,))
    robot = RobotFrontend("r", config, Inline(RobotBackend("r", config, folder)))
    records = records_of([(1.5, 1.5), (11.0, 1.5), (2.0, 1.5)], 1)[0]
    packets = [each for record in records for each in robot.process(record)] + robot.finish()
    bodies = [decode(encode(each)).body for each in packets]
    return folder, [body for body in bodies if isinstance(body, Place)]


@pytest.mark.slow
def test_keyframes_come_back_with_the_poses_of_the_robots_own_map(driven):
    folder, places = driven
    frames = read_keyframes(folder, 1000)
    assert {place.id.number for place in places} <= {frame.image.keyscan for frame in frames}
    assert np.ptp([frame.T_own_base[0] for frame in frames]) > 7.0
    assert [frame.image.keyscan for frame in read_keyframes(folder, 3)] == [f.image.keyscan for f in frames[-3:]]


@pytest.mark.slow
def test_taught_codes_are_at_the_pixels_of_their_keypoints(driven):
    """A robot that is taught its own codes gets each at the keypoint that has it."""
    folder, places = driven
    taught = [
        Packet("r", 4, k, 0.0, TaughtPlace("r", place.id.number, place.detector_version, len(place.keypoints),
                                           frozen(np.arange(1, len(place.keypoints), 2), np.uint16),
                                           place.descriptors[1::2]))
        for k, place in enumerate(places)
    ]  # fmt: skip
    frames = read_keyframes(folder, 1000)
    (folder / SPLIT_FILE).write_text(json.dumps({f"0-{frame.image.keyscan}": False for frame in frames}))
    revisits = own_examples(folder, SETTINGS, taught, 4).revisits
    assert len(revisits.taught) > 3
    right = []
    for image in revisits.taught:
        features = frames[image.image].features
        own = {tuple(pixel): code.tobytes() for pixel, code in zip(features.keypoints_px.tolist(), features.descriptors,
                                                                   strict=True)}  # fmt: skip
        given = zip(image.points.tolist(), image.codes, strict=True)
        right += [own[tuple(pixel)] == code.tobytes() for pixel, code in given]
    assert np.mean(right) > 0.99
    assert not own_examples(folder, SETTINGS, taught, 5).revisits.taught, "those of another start"


@pytest.mark.slow
def test_a_version_is_judged_by_the_keypoints_and_codes_that_it_finds(driven):
    (driven[0] / SPLIT_FILE).unlink(missing_ok=True)
    held_out = own_examples(driven[0], SETTINGS, (), 0).held_out
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


@pytest.mark.slow
def test_a_keyframe_that_is_held_out_is_never_trained_on(driven):
    folder, _ = driven
    (folder / SPLIT_FILE).unlink(missing_ok=True)
    examples = own_examples(folder, SETTINGS, (), 0)
    trained = {image.tobytes() for image in examples.revisits.images}
    judged = {frame.image.tobytes() for frame in examples.held_out.frames}
    assert trained
    assert judged
    assert not trained & judged
    moved = RobotLearningSettings(held_out=HeldOutSettings(side_m=1.0))  # as if the map had moved to other squares
    again = own_examples(folder, moved, (), 0)
    assert {frame.image.tobytes() for frame in again.held_out.frames} == judged


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


def test_what_the_server_teaches_is_checked():
    good = encode(packet(TAUGHT_PLACE))
    assert [each.body.number for each in checked_lessons("alice", write_batch([good]))] == [TAUGHT_PLACE.number]
    assert checked_lessons("alice", b"") == []
    for robot, batch in (
        ("bob", write_batch([good])),
        ("alice", write_batch([encode(packet(ACKNOWLEDGEMENT))])),
        ("alice", write_batch([good[:-1]])),
        ("alice", b"nonsense"),
    ):
        with pytest.raises(ConnectionError, match="the server teaches"):
            checked_lessons(robot, batch)


def asked_for_codes(entries, robot, **headers):
    """The answer of a server that teaches each robot its name."""
    path = f"/api/v1/robots/{robot}/learning/taught"

    async def ask():
        app = FleetApp(FleetGrid(), Authenticator(entries), lambda _line: None, str.encode)
        transport = httpx.ASGITransport(app.asgi())
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return await client.post(path, headers=headers)

    return asyncio.run(ask())


def test_a_robot_is_taught_its_own_places_only():
    """The server gives what a robot asks in its own name, which its token proves."""
    alice = {"Authorization": "Bearer secret"}
    known = [TokenEntry(name="alice", role=Role.ROBOT, sha256=hashlib.sha256(b"secret").hexdigest())]
    assert asked_for_codes(None, "alice").content == b"alice"
    assert asked_for_codes(known, "alice", **alice).content == b"alice"
    assert asked_for_codes(known, "bob", **alice).status_code == 401
    assert asked_for_codes(known, "alice").status_code == 401
    assert asked_for_codes(None, "alice/bob").status_code == 404


class Client:
    name = "alice"


def test_a_robot_learns_only_while_it_is_idle_and_its_budget_lasts(tmp_path):
    idleness = Idleness()
    robot = LearningRobot(tmp_path, Client(), RobotLearningSettings(cpu_s=time.process_time() + 1e3), idleness)
    with pytest.raises(BusyRobotError):
        robot.prepare(None)
    spent = LearningRobot(tmp_path, Client(), RobotLearningSettings(cpu_s=1e-3), idleness)
    with pytest.raises(LearningEndError, match="CPU time"):
        spent.prepare(None)
