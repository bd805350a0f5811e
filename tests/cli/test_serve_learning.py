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
        (["--learn-config", "few.yaml"], "--learn-config needs --learn"),
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
    given = {"learn": True, "config": None, "token_file": tmp_path / "token", "ca": None, "own": None} | options
    learning = RobotLearning(**given).checked(False)
    return learning.plan(config or RobotConfig(), "http://localhost:8340,http://192.0.2.1:8340", tmp_path)


def test_a_robot_learns_at_the_service_that_maps_it(tmp_path):
    found = plan(tmp_path)
    shown = (found.server, found.token_file, found.ca, found.state)
    assert shown == ("http://localhost:8340", tmp_path / "token", None, tmp_path)
    assert plan(tmp_path, learn=False) is None


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"config": RobotConfig(channels=(Channel.LIDAR,))}, "trains the camera's network"),
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
        RobotLearning(True, None, None, None, None).plan(RobotConfig(), **given)
