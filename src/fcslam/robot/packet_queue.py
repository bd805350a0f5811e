"""The packets of one robot: what its back end makes of each input, numbered in the order of the inputs."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, replace
from typing import Any

from fcslam.errors import FeatureError
from fcslam.robot.backend import NewKeyscan, Task, essential
from fcslam.robot.track import ScanTrack
from fcslam.wire.messages import Body, Hello, Packet


@dataclass(frozen=True, slots=True)
class _Waiting:
    input: object
    output: "Future[list[Body]]"
    epoch: int
    track: ScanTrack
    time: float
    """The largest stamp so far."""


class PacketQueue:
    """Gives inputs to the back end and numbers the packets; each session numbers its own from 0."""

    def __init__(self, robot: str, submit: "Callable[[Any], Future[list[Body]]]") -> None:
        self.failure: str | None = None
        """Why the back end ended early; from then on the robot sends neither closures nor places. None if it works."""
        self._robot, self._submit = robot, submit
        self._waiting: deque[_Waiting] = deque()
        self._time = float("-inf")
        self._sequence = 0
        self._hello: Hello | None = None

    @property
    def backlog(self) -> int:
        """Number of inputs that the back end has not handled yet."""
        return len(self._waiting)

    @property
    def newest(self) -> "Future[list[Body]] | None":
        """Done when the back end has handled everything so far; None if it has."""
        return self._waiting[-1].output if self._waiting else None

    def advance(self, stamp: float) -> None:
        """Stamp the packets of the following inputs with ``stamp``, unless an earlier one was larger."""
        self._time = max(self._time, stamp)

    def submit(self, input: object, epoch: int, track: ScanTrack) -> "Future[list[Body]]":
        """Give the back end its next input, of session ``epoch`` with the poses ``track``."""
        try:
            output = self._submit(input)
        except BrokenExecutor as error:
            # An input that came while the executor broke may be lost (Python 3.11): nothing else completes its future.
            for waiting in self._waiting:
                waiting.output.cancel()
            output = Future()
            output.set_exception(error)
        self._waiting.append(_Waiting(input, output, epoch, track, self._time))
        return output

    def ready(self, wait: bool) -> list[Packet]:
        """The next packets, without those that the back end still works on, or after it has handled everything."""
        packets = []
        while self._waiting and (wait or self._waiting[0].output.done()):
            done = self._waiting.popleft()
            for body in self._bodies(done):
                if isinstance(body, Hello):
                    self._hello = body
                packet = Packet(self._robot, done.epoch, self._sequence, done.time, body)
                packets.append(packet.on_floor(done.track.floor))
                self._sequence += 1
            if done.input is Task.END_SESSION:
                self._sequence, self._hello = 0, None
        return packets

    def _bodies(self, done: _Waiting) -> list[Body]:
        """The records that the back end made of an input; once it has failed, those that the map needs in any case."""
        try:
            bodies = done.output.result()
        except FeatureError:  # ``RobotFrontend.set_detector`` reports it
            return []
        except Exception as error:  # tracking must go on, whatever ended the back end
            self.failure = self.failure or f"{type(error).__name__}: {error}"
        if self.failure is None:
            return bodies
        if not isinstance(done.input, NewKeyscan):
            return []
        lasers, last = done.input.lasers, self._hello
        is_known = last is not None and last.lasers == lasers
        hello = Hello(self._robot, done.epoch, lasers, {}) if last is None else replace(last, lasers=lasers)
        return [*([] if is_known else [hello]), *essential(done.input)]
