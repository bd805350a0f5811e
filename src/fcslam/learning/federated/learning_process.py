"""Starts and stops the process in which a robot learns beside its mapping; loads no library of training itself."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fcslam.learning.federated.settings import RobotLearningSettings
from fcslam.robot.keyframe_folder import KEYFRAMES

STOP_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class RobotLearningPlan:
    """Where and how a robot learns."""

    server: str
    """Address of the service."""
    settings: RobotLearningSettings
    state: Path
    """The robot's state folder, with its keyframes."""
    credentials: Path | None = None
    """Folder with the robot's credentials."""


class LearningProcess:
    """The process; it ends with ``close``."""

    def __init__(self, plan: RobotLearningPlan, robot: str, on_notice: Callable[[str], None]) -> None:
        """Start it. ``on_notice`` is called with lines for the user, in a thread of its own."""
        options = [] if plan.credentials is None else ["--credentials", str(plan.credentials)]
        keyframes, cache = plan.state / KEYFRAMES, plan.state / "learning"
        words = [str(keyframes), str(cache), plan.server, robot, plan.settings.model_dump_json()]
        command = [sys.executable, "-m", "fcslam.learning.federated.robot_learning", *words, *options]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self._on_notice = on_notice
        self._thread = threading.Thread(target=self._listen, name="learning", daemon=True)
        self._thread.start()

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself."""
        return self._process.poll() is not None

    def set_idle(self, is_idle: bool) -> None:
        """Say whether the robot is idle, or busy."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.write(b"idle\n" if is_idle else b"busy\n")
            self._process.stdin.flush()

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(STOP_S)
        self._process.kill()
        self._process.wait()
        self._thread.join(STOP_S)

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout:
            for line in self._process.stdout:
                with suppress(ValueError, KeyError, TypeError):
                    self._on_notice(f"learning: {json.loads(line)['notice']}")
