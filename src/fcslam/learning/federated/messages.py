"""Requests of the coordinator to robots and their replies, and how they are written: a JSON header and raw float32.

Replies come from outside, so nothing in them is trusted before it is checked.
"""

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.config import one_line
from fcslam.errors import InputError
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights, size_bytes

PAIRS: Final = "pairs"
"""Name of the array in which a robot reports on the pairs that it holds out."""
MAX_NAME_LENGTH: Final = 64
MAX_FIGURES: Final = 32
"""A reply with more figures than this is refused: fcslam's clients send fewer than ten."""
LARGEST_FIGURE: Final = 1e6
"""Losses are of the order of 1. A larger one, or one that is not a number, would spoil a mean."""
_LENGTH_BYTES: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class TrainingRequest:
    """A request to train from weights, or to report on held-out pairs with them."""

    is_training: bool
    weights: Weights
    version: str
    """Detector version of the weights."""
    round_number: int
    """From 0."""
    run_id: str
    """Identifies the run to clients that keep state over its rounds."""
    settings: FederatedSettings


@dataclass(frozen=True, slots=True, eq=False)
class TrainingReply:
    """A robot's reply."""

    robot: str
    version: str
    """Version of the weights in the request."""
    arrays: Weights = field(default_factory=dict)
    figures: Mapping[str, float] = field(default_factory=dict)
    """Losses."""
    error: str = ""
    """Why there is nothing else."""


def write_request(request: TrainingRequest) -> bytes:
    """Serialise a request; ``read_request`` is the inverse."""
    header = {
        "is_training": request.is_training,
        "version": request.version,
        "round": request.round_number,
        "run": request.run_id,
        "settings": request.settings.model_dump(mode="json"),
    }
    return _pack(header, request.weights)


def read_request(data: bytes) -> TrainingRequest:
    """Read a request on the robot; an ``InputError`` if these bytes are not one of this version of fcslam."""
    try:
        header, weights = _unpack(data)
        settings = FederatedSettings.model_validate(header["settings"])
        names = str(header["version"]), int(header["round"]), str(header["run"])
        return TrainingRequest(bool(header["is_training"]), weights, *names, settings)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise InputError(
            f"the server's request cannot be read ({error}); install the same version of fcslam on both machines"
        ) from error


def write_reply(reply: TrainingReply) -> bytes:
    """Serialise a reply; ``read_reply`` is the inverse."""
    header = {"robot": reply.robot, "version": reply.version, "figures": dict(reply.figures), "error": reply.error}
    return _pack(header, reply.arrays)


def read_reply(data: bytes) -> TrainingReply:
    """Read a robot's reply. Its arrays have the right type; ``screen`` checks their names, shapes and values.

    Raises:
        ValueError: these bytes are not a reply.
    """
    try:
        header, arrays = _unpack(data)
        figures = {str(name): float(value) for name, value in header["figures"].items()}
        return TrainingReply(str(header["robot"]), str(header["version"]), arrays, figures, str(header["error"]))
    except (KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"a reply that cannot be read ({type(error).__name__})") from error


def _pack(header: Mapping[str, Any], arrays: Weights) -> bytes:
    text = json.dumps({**header, "arrays": {name: array.shape for name, array in arrays.items()}}).encode()
    content = (np.asarray(array, "<f4").tobytes() for array in arrays.values())
    return b"".join((len(text).to_bytes(_LENGTH_BYTES, "little"), text, *content))


def _unpack(data: bytes) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    begin = _LENGTH_BYTES + int.from_bytes(data[:_LENGTH_BYTES], "little")
    try:
        header = json.loads(data[_LENGTH_BYTES:begin])
    except RecursionError as error:
        raise ValueError("a header that is nested too deeply") from error
    arrays = {}
    for name, shape in header.pop("arrays").items():
        if not all(isinstance(side, int) and side >= 0 for side in shape):
            raise ValueError(f"{name} has no shape")
        part = data[begin : begin + 4 * math.prod(shape)]
        if len(part) != 4 * math.prod(shape):
            raise ValueError(f"{name} is cut off")
        arrays[str(name)] = np.frombuffer(part, "<f4").astype(np.float32).reshape(shape)
        begin += len(part)
    if begin != len(data):
        raise ValueError(f"{len(data) - begin} bytes too many")
    return header, arrays


def checked_reply(reply: TrainingReply, robot: str, version: str) -> TrainingReply:
    """The reply, if it is one of this robot about this version.

    Raises:
        ValueError: it is an error, or about something else, or has implausible figures.
    """
    if reply.error:
        raise ValueError(reply.error)
    if (reply.robot, reply.version) != (robot, version):
        raise ValueError(f"an answer by {reply.robot} about version {reply.version}, not by {robot} about {version}")
    figures = reply.figures
    if len(figures) > MAX_FIGURES or not all(name.isidentifier() and len(name) <= MAX_NAME_LENGTH for name in figures):
        raise ValueError("figures that the server did not request")
    for name, value in figures.items():
        if not abs(value) <= LARGEST_FIGURE:
            raise ValueError(f"{name} is {value:g}")
    return reply


@dataclass(slots=True)
class RoundReplies:
    """The updates of a round by robot, and the reasons why other robots gave none."""

    weights: dict[str, Weights] = field(default_factory=dict)
    losses: dict[str, Mapping[str, float]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    bytes_up: int = 0
    """Size of the arrays of all replies that could be read."""

    def leave_out(self, robot: str, reason: str) -> None:
        """Remove a robot's update from the round."""
        self.left_out[robot] = one_line(reason)  # cut, so that one robot cannot flood the table of rounds
        for kept in (self.weights, self.losses):
            kept.pop(robot, None)


def collect_updates(replies: Mapping[str, TrainingReply], asked: Collection[str], version: str) -> RoundReplies:
    """The updates in the replies to a training request; ``screen`` checks the arrays afterwards."""
    found = RoundReplies()
    for robot in asked:
        if robot not in replies:
            found.leave_out(robot, "no answer: gone, or later than the deadline")
            continue
        try:
            reply = checked_reply(replies[robot], robot, version)
        except ValueError as error:
            found.leave_out(robot, str(error))
            continue
        found.bytes_up += size_bytes(reply.arrays)
        found.weights[robot], found.losses[robot] = reply.arrays, reply.figures
    return found
