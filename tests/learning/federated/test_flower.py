"""The internals of Flower that fcslam relies on. If an upgrade of Flower fails, it fails here, with the reason."""

import tomllib
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.errors import TrainingError
from fcslam.learning.federated import flower
from fcslam.learning.federated.messages import ARRAYS_KEY, CONFIG_KEY
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.strategies import create_strategy


def test_the_installed_version_is_supported_and_the_one_that_is_required():
    flower.check_version(version("flwr"))
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8"))
    (required,) = [each for each in project["project"]["optional-dependencies"]["federated"] if each.startswith("flwr")]
    first, end = (".".join(map(str, each)) for each in flower.SUPPORTED_VERSIONS)
    assert required == f"flwr>={first},<{end}"


@pytest.mark.parametrize("other", ["1.40.2", "1.42.0", "2.0.0"])
def test_another_version_is_refused_with_the_one_that_is_needed(other):
    with pytest.raises(TrainingError, match=rf"flwr {other} is installed, but fcslam needs flwr>=1\.41,<1\.42"):
        flower.check_version(other)


def test_a_message_asks_the_task_identity_who_sends_it():
    flower.InProcessGrid({"a": flower.ClientApp()})
    identity = flower.TaskIdentity
    assert (identity.task_id, identity.run_id, identity.node_id) == (flower.RUN_ID,) * 3
    message = flower.Message(flower.RecordDict({}), flower.FIRST_NODE, flower.MessageType.TRAIN)
    assert message.metadata.src_node_id == flower.RUN_ID
    assert message.metadata.dst_node_id == flower.FIRST_NODE


@pytest.mark.parametrize("strategy", ["fedavg", "fedmedian"])
def test_a_strategy_asks_every_node_of_a_selection(strategy):
    chosen = create_strategy(FederatedSettings(strategy=strategy, normalisation="frozen"))
    flower.InProcessGrid({name: flower.ClientApp() for name in "abc"})
    arrays = flower.ArrayRecord({"a": flower.Array(np.zeros(2, np.float32))})
    messages = list(chosen.configure_train(1, arrays, flower.ConfigRecord(), flower.NodeSelection([2, 4])))
    assert sorted(message.metadata.dst_node_id for message in messages) == [2, 4]
    assert all({ARRAYS_KEY, CONFIG_KEY} <= message.content.keys() for message in messages)


def test_a_message_arrives_as_it_was_sent():
    flower.use_own_identity()
    arrays = flower.ArrayRecord({"a": flower.Array(np.arange(3, dtype=np.float32))})
    content = flower.RecordDict({ARRAYS_KEY: arrays, CONFIG_KEY: flower.ConfigRecord({"version": "v"})})
    sent = flower.Message(content, flower.FIRST_NODE, flower.MessageType.TRAIN)
    received = flower.request_from_bytes(flower.message_to_bytes(sent))
    assert received.metadata.message_type == flower.MessageType.TRAIN
    assert received.content[CONFIG_KEY]["version"] == "v"
    assert received.content[ARRAYS_KEY]["a"].numpy().tolist() == [0.0, 1.0, 2.0]


def test_a_reply_cannot_name_its_sender():
    """Only the content is taken from the bytes of a robot."""
    flower.use_own_identity()
    first, second = (flower.Message(flower.RecordDict({}), node, flower.MessageType.TRAIN) for node in (2, 3))
    forged = flower.message_to_bytes(flower.Message(flower.RecordDict({}), reply_to=second))
    assert flower.reply_from_bytes(forged, first).metadata.src_node_id == 2


@pytest.mark.parametrize("data", [b"x" * 100, b"\xff" * 9, flower.MessageProto().SerializeToString()])
def test_bytes_that_are_no_message_are_refused(data):
    flower.use_own_identity()
    request = flower.Message(flower.RecordDict({}), 2, flower.MessageType.TRAIN)
    with pytest.raises(ValueError, match=r"cannot be read|None"):
        flower.reply_from_bytes(data, request)
