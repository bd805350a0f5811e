"""Starts and stops the process in which a robot learns beside its mapping; loads no library of training itself."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fcslam.learning.federated.settings import RobotLearningSettings
from fcslam.processes import Child, module_command
from fcslam.robot.keyframe_folder import KEYFRAMES

STOP_S: Final = 5.0
NOTICE: Final = "notice"
"""The event with a line for the user."""


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
        self._child = Child(module_command("fcslam.learning.federated.robot_learning", *words, *options))
        self._on_notice = on_notice
        self._thread = threading.Thread(target=self._listen, name="learning", daemon=True)
        self._thread.start()

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself."""
        return self._child.pid is None

    def set_idle(self, is_idle: bool) -> None:
        """Say whether the robot is idle, or busy."""
        self._child.send("idle" if is_idle else "busy")

    def close(self) -> None:
        """End it."""
        self._child.stop(STOP_S)
        self._thread.join(STOP_S)

    def _listen(self) -> None:
        for event, content in self._child.events():
            if event == NOTICE:
                self._on_notice(f"learning: {content}")
