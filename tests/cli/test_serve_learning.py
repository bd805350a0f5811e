"""`fcslam serve --learn` and `fcslam robot --learn`: wrong options end in one line, before anything starts."""

import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.cli import main
from fcslam.cli.learning_options import RobotLearning
from fcslam.errors import InputError
from fcslam.records import Channel
from fcslam.robot.frontend import RobotConfig


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--learn-server", "localhost:1"], "need --learn"),
        (["--robot-key", "r.pub"], "need --learn"),
        (["--learn", "--learn-server", "localhost"], "is not a HOST:PORT"),
        (["--learn", "--learn-server", "192.0.2.1:8341"], "everybody who reaches 192.0.2.1:8341 could train"),
        (["--learn", "--learn-ca", "ca.pem"], "--learn-ca and --robot-key belong together"),
        (["--learn", "--robot-key", "nowhere.pub"], "is not a public key"),
        (["--learn", "--learn-config", "all.yaml"], "set federated.trained to codes"),
        (["--learn", "--learn-config", "few.yaml"], "fewest_pairs"),
        (["--learn", "--store", "postgresql://u@h/d"], "leave out --store"),
    ],
)
def test_a_service_that_cannot_learn_says_why(options, reason, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "all.yaml").write_text("federated: {trained: all}")
    (tmp_path / "few.yaml").write_text("gate: {fewest_pairs: 0}")
    assert main(["serve", "--data", str(tmp_path / "data"), "--port", "0", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line
    assert not (tmp_path / "data").exists()


def plan(tmp_path, config=None, **options):
    given = {"learn": True, "server": None, "config": None, "ca": None, "key": None} | options
    learning = RobotLearning(**given).checked(False)
    return learning.plan("alice", config or RobotConfig(), "http://localhost:8340,http://192.0.2.1:8340", tmp_path)


def test_a_robot_learns_at_the_service_that_maps_it(tmp_path):
    found = plan(tmp_path)
    assert (found.host, found.port, found.ca, found.state) == ("localhost", 8341, None, tmp_path)
    assert plan(tmp_path, learn=False) is None


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"server": "192.0.2.1:8341"}, "is another machine; give --learn-ca and --learn-key"),
        ({"config": RobotConfig(channels=(Channel.LIDAR,))}, "trains the camera's network"),
        ({"learn": False, "server": "localhost:1"}, "need --learn"),
    ],
)
def test_a_robot_that_cannot_learn_says_why(options, reason, tmp_path):
    with pytest.raises(InputError, match=reason):
        plan(tmp_path, **options)


def test_a_robot_that_localises_does_not_learn():
    with pytest.raises(InputError, match="for a robot that maps; leave out --localize or --learn"):
        RobotLearning(True, None, None, None, None).checked(True)


@pytest.mark.parametrize("missing", ["service", "state"])
def test_a_live_robot_learns_with_a_service_and_a_state_folder(missing, tmp_path):
    given = {"service": "http://localhost:8340", "state": tmp_path} | {missing: None}
    with pytest.raises(InputError, match="give --server and --state"):
        RobotLearning(True, None, None, None, None).plan("alice", RobotConfig(), **given)
