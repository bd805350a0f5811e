"""Examples of a robot that learns: keyframes on disk, split once and for all, and taught codes at the right pixels."""

import asyncio
import json
import time

import httpx
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.federated.fleet_grid import FleetGrid
from fcslam.federated.fleet_server import FleetApp
from fcslam.federated.identity import ROBOT_HEADER, RobotAuthenticator
from fcslam.federated.live_settings import HeldOutSettings, RobotLearningSettings
from fcslam.federated.own_examples import SPLIT_FILE, own_examples
from fcslam.federated.robot_learning import BusyRobotError, Idleness, LearningEndError, LearningRobot, checked_lessons
from fcslam.records import Channel, Place, frozen
from fcslam.robot.backend import RobotBackend
from fcslam.robot.beside import Inline
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.keyframe_folder import KeyframeFolder, read_keyframes
from fcslam.wire.batches import write_batch
from fcslam.wire.messages import Packet, TaughtPlace
from fcslam.wire.packets import decode, encode
from tests.robot.test_views import records_of
from tests.wire.examples import ACKNOWLEDGEMENT, TAUGHT_PLACE, packet

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


def asked_for_codes(keys, path="/fleet/taught", **headers):
    """The answer of a port that teaches each robot its name."""

    async def ask():
        app = FleetApp(FleetGrid(keys), RobotAuthenticator(keys), lambda _line: None, str.encode)
        transport = httpx.ASGITransport(app.asgi())
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return await client.post(path, headers=headers)

    return asyncio.run(ask())


def test_a_robot_is_taught_its_own_places_only():
    """The port gives what was asked in the robot's own name, which its signature proves."""
    alice = {ROBOT_HEADER: "alice"}
    assert asked_for_codes(None, **alice).content == b"alice"
    assert asked_for_codes(None).status_code == 401
    assert asked_for_codes(None, "/fleet/taught/bob", **alice).status_code == 404
    assert asked_for_codes({}, **alice).status_code == 401


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
