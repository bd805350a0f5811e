"""The process in which a robot learns beside its mapping: ``python -m fcslam.learning.federated.robot_learning``.

It works only while the robot is idle, as its parent says on stdin: `idle` or `busy`. It ends with stdin. Its notices
are events for the parent. It reads the keyframes that the robot keeps on its disk, joins the rounds of the fleet, and
sends weights and reports on pairs of keyframes. Images never leave it. A server can send weights and settings, and no
program.
"""

import argparse
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Final, TypeVar
from urllib.parse import quote

import httpx
import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.config import one_line
from fcslam.errors import FcslamError, InputError, UnavailableError
from fcslam.features.detector import GreyImage, decode_grey, padded
from fcslam.geometry import se2
from fcslam.learning.code_batches import RevisitExamples, RevisitPair
from fcslam.learning.code_training import CodeInputs
from fcslam.learning.federated.client import Client, RevisitClient, reply_to
from fcslam.learning.federated.fleet_server import ANSWER_S, NUMBER_HEADER, RETRY_S
from fcslam.learning.federated.held_out import HeldOutPairs
from fcslam.learning.federated.learning_process import NOTICE
from fcslam.learning.federated.messages import TrainingReply, read_request, write_reply
from fcslam.learning.federated.settings import RobotLearningSettings
from fcslam.learning.revisits import Keyframe, revisits_in_map
from fcslam.processes import emit_event
from fcslam.records import FloatArray
from fcslam.robot.keyframe_folder import KeptKeyframe, read_keyframes
from fcslam.storage.files import write_file
from fcslam.wire.http_transport import HttpClient
from fcslam.wire.keys import Server, read_server

_T = TypeVar("_T")

MOST_KEYFRAMES: Final = 400
"""Newest keyframes that are compared with one another."""
HELD_OUT_EVERY: Final = 4
"""One in this many squares of the robot's map is held out from training."""
HELD_OUT_SIDE_M: Final = 4.0
"""Side of these squares."""
SPLIT_FILE: Final = "split.json"
"""Says of each keyframe that was ever used whether it is held out."""
NICENESS: Final = 19
FRESH_S: Final = 20.0
"""Time for which the examples are not looked for again."""


class RobotLink(HttpClient):
    """The connection of a robot with the service that it learns at; ``robot`` is its name."""

    def __init__(self, server: Server, robot: str) -> None:
        super().__init__(server)
        self.robot = robot
        self._path = f"robots/{quote(robot, safe='')}/learning/"
        self._client.timeout = httpx.Timeout(ANSWER_S)

    def fetch(self) -> tuple[int, bytes] | None:
        """A request with its number; None if no request waits.

        Raises:
            CloudError: the server does not accept the robot, or is not a server of a fleet.
            UnavailableError: the server cannot be reached.
        """
        response = self._ask("POST", self._path + "next", passes=(204,))
        if response.status_code == httpx.codes.NO_CONTENT:
            return None
        with self._reading():
            return int(response.headers[NUMBER_HEADER]), response.content

    def reply(self, number: int, body: bytes) -> str:
        """Bring a reply; returns the reason why the server does not want it, or nothing. Raises as ``fetch``."""
        response = self._ask("POST", f"{self._path}reply/{number}", body, passes=(204, 410, 413))
        return response.content.decode(errors="replace")


def serve_requests(
    link: RobotLink,
    client: Client,
    on_notice: Callable[[str], None],
    sleep: Callable[[float], None] = time.sleep,
    is_ready: Callable[[], bool] = lambda: True,
) -> None:
    """Answer the server's requests until the robot is interrupted. Waits for a server that is not there, or gone.

    ``on_notice`` is called with one line for a request that was refused, and while the server is not there.
    ``is_ready`` is asked before each request; if false, the robot asks for none now.
    """

    def retried(operation: Callable[[], _T]) -> _T:
        while True:
            try:
                return operation()
            except UnavailableError as error:
                on_notice(f"waiting: {error}")
                sleep(max(RETRY_S, error.retry_after_s))

    while True:
        if not is_ready():
            sleep(RETRY_S)
            continue
        found = retried(link.fetch)
        if found is None:
            continue
        number, data = found
        try:
            reply = reply_to(read_request(data), link.robot, client)
        except InputError as error:
            reply = TrainingReply(link.robot, "", error=str(error))
        if reply.error:
            on_notice(f"refused: {one_line(reply.error)}")
        reason = retried(partial(link.reply, number, write_reply(reply)))
        if reason:
            on_notice(f"the server does not take a reply: {reason}")


def own_examples(folder: Path, side_m: float = HELD_OUT_SIDE_M) -> tuple[RevisitExamples, HeldOutPairs]:
    """What a robot saw again by its keyframes: examples to train on, and pairs that are held out.

    ``side_m``: of the squares of the map that are held out as a whole.
    """
    kept = read_keyframes(folder, MOST_KEYFRAMES)
    version = kept[-1].detector_version if kept else ""
    shown = [(frame, picture) for frame in kept if (picture := _picture(frame, version)) is not None]
    held_out = _split(folder / SPLIT_FILE, [frame for frame, _ in shown], side_m)
    trained = [each for each, is_held_out in zip(shown, held_out, strict=True) if not is_held_out]
    judged = [each for each, is_held_out in zip(shown, held_out, strict=True) if is_held_out]
    frames, poses = _keyframes(trained)
    pairs = [_pair(frames, poses, i, j, rows) for i, j, rows in revisits_in_map(frames, poses)]
    examples = RevisitExamples([frame.image for frame in frames], pairs)
    return examples, HeldOutPairs.of(*_keyframes(judged))


def _picture(frame: KeptKeyframe, version: str) -> GreyImage | None:
    """The image of a keyframe of the present detector, in whole cells; None for another one, or if it is broken."""
    picture = decode_grey(frame.image.encoded) if frame.detector_version == version else None
    return None if picture is None else padded(picture)


def _split(path: Path, frames: Sequence[KeptKeyframe], side_m: float) -> list[bool]:
    """Which keyframes are held out; what was decided once stays, wherever the map moves."""
    known: dict[str, bool] = {}
    with suppress(OSError, ValueError, AttributeError):
        known = {str(name): bool(value) for name, value in json.loads(path.read_text(encoding="utf-8")).items()}
    names = [f"{frame.session}-{frame.image.keyscan}" for frame in frames]
    for name, frame in zip(names, frames, strict=True):
        known.setdefault(name, is_held_out(frame.T_own_base, side_m))
    write_file(path, json.dumps(known))
    return [known[name] for name in names]


def is_held_out(T_own_base: FloatArray, side_m: float) -> bool:
    """Whether a new keyframe at this pose in the robot's own map, shape (3,), is held out."""
    column, row = (math.floor(float(each) / side_m) for each in T_own_base[:2])
    # Neither a row nor a column of squares is held out as a whole, or not at all.
    return (column + (HELD_OUT_EVERY // 2) * row) % HELD_OUT_EVERY == 0


def _keyframes(shown: Sequence[tuple[KeptKeyframe, GreyImage]]) -> tuple[list[Keyframe], FloatArray]:
    frames = [
        Keyframe.of(picture, frame.features, frame.image.camera, frame.image.surroundings) for frame, picture in shown
    ]
    return frames, np.array([frame.T_own_base for frame, _ in shown]).reshape(-1, 3)


def _pair(frames: Sequence[Keyframe], poses: FloatArray, i: int, j: int, rows: NDArray[np.int64]) -> RevisitPair:
    points = frames[i].features.keypoints_px[rows[:, 0]], frames[j].features.keypoints_px[rows[:, 1]]
    return RevisitPair((i, j), points, _in_map(frames[i], poses[i])[rows[:, 0]])


def _in_map(frame: Keyframe, T_own_base: FloatArray) -> FloatArray:
    """Positions of a frame's keypoints in the robot's map, shape (K, 3); of no meaning without one."""
    positions = frame.positions.copy()
    positions[:, :2] = se2.transform(T_own_base, positions[:, :2])
    return positions


class LearningRobot:
    """Lets a client work while the robot is idle and its budget lasts, on examples from its newest keyframes."""

    def __init__(
        self,
        folder: Path,
        client: RevisitClient,
        cpu_s: float,
        idle: threading.Event,
        notice: Callable[[str], None],
    ) -> None:
        """``folder``: of the keyframes; ``cpu_s``: the budget; ``idle``: set while the robot is idle."""
        self._folder, self._client, self._cpu_s, self._idle, self._notice = folder, client, cpu_s, idle, notice
        self._looked_s = float("-inf")
        self._seen = 0

    def pause(self, _robot: str = "", _steps: int = 0) -> None:
        """Before each step: wait while the robot is busy; an ``InputError`` if the budget is spent."""
        if time.process_time() > self._cpu_s:
            raise InputError(f"the CPU time for learning is spent ({self._cpu_s:.0f} s)")
        self._idle.wait()

    def prepare(self) -> bool:
        """Before each request: look for new examples; returns whether there are any. Raises as ``pause``."""
        self.pause()
        if time.monotonic() - self._looked_s > FRESH_S:
            written = max((path.stat().st_mtime_ns for path in self._folder.glob("*.state")), default=0)
            if written != self._seen:
                self._seen = written
                revisits, held_out = own_examples(self._folder)
                self._client.revisits, self._client.held_out, self._client.inputs = revisits, held_out, CodeInputs()
                self._notice(
                    f"learns from {len(revisits.images)} images: {len(revisits.pairs)} pairs of its own; "
                    f"{len(held_out.revisits)} pairs held out"
                )
            self._looked_s = time.monotonic()
        return bool(self._client.revisits)


def _listen(idle: threading.Event) -> None:
    """Follow the parent; end with it."""
    for line in sys.stdin:
        if line.strip() == "idle":
            idle.set()
        else:
            idle.clear()
    os._exit(0)


def main(arguments: Sequence[str]) -> int:
    """Learn until the budget is spent or the parent ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("keyframes", type=Path)
    parser.add_argument("cache", type=Path)
    parser.add_argument("server")
    parser.add_argument("name")
    parser.add_argument("settings", type=RobotLearningSettings.model_validate_json)
    parser.add_argument("--credentials", type=Path)
    given = parser.parse_args(arguments)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(NICENESS)
    torch.set_num_threads(1)
    idle, told = threading.Event(), ""
    threading.Thread(target=_listen, args=(idle,), daemon=True).start()

    def notice(line: str) -> None:
        nonlocal told
        if line != told:
            told = line
            emit_event(NOTICE, line)

    try:
        server = read_server(given.server, given.credentials)
        client = RevisitClient(given.name, given.cache)
        robot = LearningRobot(given.keyframes, client, given.settings.cpu_s, idle, notice)
        client.on_step = robot.pause
        with closing(RobotLink(server, given.name)) as link:
            serve_requests(link, client, notice, is_ready=robot.prepare)
    except (FcslamError, OSError) as error:
        notice(f"learning ends: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
