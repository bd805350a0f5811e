"""`fcslam serve --learn` and `fcslam play --learn`: wrong options end in one line, before anything starts."""

import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")

from fcslam.cli.training_options import learning_plan
from fcslam.errors import InputError
from fcslam.records import Channel
from fcslam.robot.frontend import RobotConfig
from fcslam.wire.keys import Server


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--learn", "--data", "few"], "fewest_pairs"),
        (["--learn", "--store", "postgresql://u@h/d"], "leave out --store"),
    ],
)
def test_a_service_that_cannot_learn_says_why(options, reason, tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "few").mkdir()
    (tmp_path / "few" / "learning.yaml").write_text("fewest_pairs: 0")
    assert reason in refused("serve", "--data", tmp_path / "data", "--port", 0, *options)
    assert not (tmp_path / "data").exists()


def plan(tmp_path, config=None):
    server = Server("http://localhost:8340,http://192.0.2.1:8340")
    return learning_plan(config or RobotConfig(), server, tmp_path, tmp_path)


def test_a_robot_learns_at_the_service_that_maps_it(tmp_path):
    found = plan(tmp_path)
    assert (found.server, found.credentials, found.state) == ("http://localhost:8340", tmp_path, tmp_path)


def test_a_robot_without_a_camera_cannot_learn(tmp_path):
    with pytest.raises(InputError, match="trains the camera's network"):
        plan(tmp_path, RobotConfig(channels=(Channel.LIDAR,)))


@pytest.mark.parametrize(("server", "has_state"), [(None, True), ("http://localhost:8340", False)])
def test_a_live_robot_learns_with_a_service_and_a_state_folder(server, has_state, tmp_path):
    with pytest.raises(InputError, match="give --server and --state"):
        learning_plan(RobotConfig(), server and Server(server), None, tmp_path if has_state else None)
