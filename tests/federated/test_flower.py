"""The internals of Flower that fcslam relies on. If an upgrade of Flower fails, it fails here, with the reason."""

import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.errors import TrainingError
from fcslam.federated import flower
from fcslam.federated.messages import ARRAYS_KEY, CONFIG_KEY
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.strategies import create_strategy
from fcslam.federated.tls import Address, Certificates
from tests.federated.fakes import START, Fake, run, settings

ADDRESS = Address("server.lab", 8000)
STRATEGIES = ("fedavg", "fedprox", "fedadam", "fedmedian", "fedtrimmedavg", "krum")


def test_the_installed_version_is_supported_and_the_one_that_is_required():
    flower.check_version(version("flwr"))
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    (required,) = [each for each in project["project"]["optional-dependencies"]["federated"] if each.startswith("flwr")]
    first, end = (".".join(map(str, each)) for each in flower.SUPPORTED_VERSIONS)
    assert required == f"flwr>={first},<{end}"


@pytest.mark.parametrize("other", ["1.40.2", "1.42.0", "2.0.0"])
def test_another_version_is_refused_with_the_one_that_is_needed(other):
    with pytest.raises(TrainingError, match=rf"flwr {other} is installed, but fcslam needs flwr>=1\.41,<1\.42"):
        flower.check_version(other)


def test_a_message_asks_the_task_identity_who_sends_it():
    flower.InProcessGrid(flower.ClientApp(), 1)
    identity = flower.TaskIdentity
    assert (identity.task_id, identity.run_id, identity.node_id) == (flower.RUN_ID,) * 3
    message = flower.Message(flower.RecordDict({}), flower.FIRST_NODE, flower.MessageType.TRAIN)
    assert message.metadata.src_node_id == flower.RUN_ID
    assert message.metadata.dst_node_id == flower.FIRST_NODE


def test_the_grid_in_this_process_implements_all_of_flowers_grid():
    assert flower.Grid.__abstractmethods__ <= vars(flower.InProcessGrid).keys()
    assert not flower.InProcessGrid.__abstractmethods__


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_strategy_asks_every_node_of_a_selection(strategy):
    chosen = create_strategy(FederatedSettings(strategy=strategy, normalisation="frozen"))
    flower.InProcessGrid(flower.ClientApp(), 3)
    arrays = flower.ArrayRecord({"a": flower.Array(np.zeros(2, np.float32))})
    messages = list(chosen.configure_train(1, arrays, flower.ConfigRecord(), flower.NodeSelection([2, 4])))
    assert sorted(message.metadata.dst_node_id for message in messages) == [2, 4]
    assert all({ARRAYS_KEY, CONFIG_KEY} <= message.content.keys() for message in messages)


def test_the_moments_of_fedadam_can_be_read_and_restored(tmp_path):
    trained = {name: array for name, array in START.items() if name != "a.running_var"}
    state, _ = run([Fake("a")], tmp_path, settings(strategy="fedadam", normalisation="frozen"), start=trained)
    kept = {name: array for name, array in state.strategy_state.items() if name.startswith(("m_t/", "v_t/"))}
    assert {name.partition("/")[2] for name in kept} == trained.keys()
    adam = create_strategy(FederatedSettings(strategy="fedadam", normalisation="frozen"))
    assert flower.strategy_moments(adam) == {"m_t": {}, "v_t": {}}
    flower.restore_moments(adam, {"m_t": {"a": np.ones(2)}, "v_t": {}})
    assert flower.strategy_moments(adam)["m_t"].keys() == {"a"}
    assert flower.strategy_moments(create_strategy(FederatedSettings())) == {"m_t": {}, "v_t": {}}


def options(program):
    """What a program of Flower says of its options."""
    command = [str(Path(sys.executable).with_name(program)), "--help"]
    return subprocess.run(command, env=flower.QUIET, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
@pytest.mark.parametrize("secure", [False, True])
def test_the_daemons_know_the_options_that_they_are_given(secure):
    files = Certificates(Path("ca.crt"), Path("own.crt"), Path("own.key")) if secure else None
    link = flower.superlink_command(ADDRESS, files)
    node = flower.supernode_command(ADDRESS, {"robot": "a"}, files, Path("robot.key") if secure else None)
    for program, *words in (link, [*node, "--port", "1"]):
        known = options(program)
        assert all(word in known for word in words if word.startswith("--")), program


def test_the_app_is_one_that_flower_accepts(tmp_path):
    from flwr.cli.config_utils import load_and_validate

    flower.write_app(
        tmp_path / "app",
        "fcslam.federated.deployed_apps:server_app",
        "fcslam.federated.deployed_apps:robot_app",
        {"task": '{"output": "a \\"name\\""}'},
    )
    config, warnings = load_and_validate(tmp_path / "app" / "pyproject.toml")
    assert warnings == []
    assert config["tool"]["flwr"]["app"]["config"] == {"task": '{"output": "a \\"name\\""}'}
