"""What server and robots write to each other, as Flower's records: writer and reader side by side."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.flower import Array, ArrayRecord, ConfigRecord, MetricRecord, RecordDict
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.weights import Weights

ARRAYS_KEY, CONFIG_KEY, METRICS_KEY = "arrays", "config", "metrics"
EXAMPLES_KEY = "num-examples"
"""Flower's name for how much an update weighs."""
MAX_NAME_LENGTH = 64
MAX_METRICS = 32


@dataclass(frozen=True, slots=True)
class ClientRequest:
    """What a robot is asked."""

    weights: Weights
    version: str
    """Of the weights."""
    round_number: int
    run: str
    """Names the run, to whoever keeps something over its rounds."""
    settings: FederatedSettings


def request_config(version: str, round_number: int, run: str, settings: FederatedSettings) -> ConfigRecord:
    """What goes with the weights to every robot."""
    order = {"version": version, "round": round_number, "run": run, "settings": settings.model_dump_json()}
    return ConfigRecord(order)


def read_request(content: RecordDict) -> ClientRequest:
    """An order as a robot gets it.

    Raises:
        TrainingError: it is none.
        ConfigError: its settings are of another version of fcslam.
    """
    try:
        config = content[CONFIG_KEY]
        settings = FederatedSettings.model_validate_json(config["settings"])
        version, number, run = str(config["version"]), int(config["round"]), str(config["run"])
        return ClientRequest(record_to_weights(content[ARRAYS_KEY]), version, number, run, settings)
    except (KeyError, TypeError, ValueError) as error:
        raise TrainingError(f"the server's order cannot be read ({error}); are both of one version?") from error


def weights_to_record(weights: Weights) -> ArrayRecord:
    """Weights as a record."""
    return ArrayRecord({name: Array(np.asarray(array, order="C")) for name, array in weights.items()})


def record_to_weights(record: ArrayRecord) -> dict[str, NDArray[np.float32]]:
    """Weights of a record, as they are: neither names nor shapes nor numbers are checked.

    Raises:
        ValueError: an array is none, or none of numbers.
    """
    _check_kind(record, ArrayRecord)
    try:
        arrays = {str(name): array.numpy() for name, array in record.items()}
    except Exception as error:  # bytes of another machine's making: NumPy's parser fails on them in many ways
        raise ValueError(f"an array that cannot be read: {type(error).__name__}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError("an archive in place of an array")
    return arrays


def record_bytes(record: ArrayRecord) -> int:
    """Bytes of its arrays.

    Raises:
        ValueError: it is another record.
    """
    _check_kind(record, ArrayRecord)
    return sum(len(array.data) for array in record.values())


def client_reply(
    robot: str, version: str, figures: Mapping[str, float], arrays: ArrayRecord | None = None
) -> RecordDict:
    """A robot's answer to an order that came with weights of this version."""
    records = {CONFIG_KEY: ConfigRecord({"robot": robot, "version": version}), METRICS_KEY: MetricRecord(dict(figures))}
    return RecordDict(records if arrays is None else records | {ARRAYS_KEY: arrays})


def reply_sender(content: RecordDict) -> tuple[str, str]:
    """Who answers, and which version it was asked about.

    Raises:
        ValueError: the answer does not say.
    """
    try:
        config = content[CONFIG_KEY]
        robot, version = config["robot"], config["version"]
    except (KeyError, TypeError) as error:
        raise ValueError("an answer without a name") from error
    if not (isinstance(robot, str) and 0 < len(robot) <= MAX_NAME_LENGTH and robot.isprintable()):
        raise ValueError("an answer without a usable name")
    return robot, str(version)


def reply_metrics(content: RecordDict) -> dict[str, float]:
    """The numbers of an answer.

    Raises:
        ValueError: there are none, too many, or some with odd names.
    """
    record = content[METRICS_KEY]
    _check_kind(record, MetricRecord)
    figures = {str(name): float(value) for name, value in record.items() if isinstance(value, int | float)}
    if len(figures) > MAX_METRICS or not all(name.isidentifier() and len(name) <= MAX_NAME_LENGTH for name in figures):
        raise ValueError("figures that nobody asked for")
    return figures


def _check_kind(record: object, kind: type) -> None:
    if not isinstance(record, kind):
        raise ValueError(f"a {type(record).__name__} in place of a {kind.__name__}")
