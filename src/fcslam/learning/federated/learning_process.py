"""Starts and stops the process in which a robot learns while it stands still; loads no library of training itself."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fcslam.geometry import se2
from fcslam.learning.federated.settings import RobotLearningSettings
from fcslam.live.records import RobotPose
from fcslam.processes import Child, module_command
from fcslam.records import FloatArray
from fcslam.robot.keyframe_folder import KEYFRAMES

STANDS_AFTER_S: Final = 10.0
MOVED_M = 0.05
MOVED_RAD = MOVED_M
"""Largest displacement of a robot that stands; matched scans and corrections move its pose by less."""
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


class Standstill:
    """Follows the poses of a robot and tells when it stops and when it drives on."""

    def __init__(self, on_stop: Callable[[], None], on_drive: Callable[[], None]) -> None:
        """``on_stop`` is called once it has stood still for ten seconds of its stamps, ``on_drive`` when it moves."""
        self._on_stop, self._on_drive = on_stop, on_drive
        self._reference: FloatArray | None = None
        self._since = 0.0
        self._stands = False

    def follow(self, pose: RobotPose) -> None:
        """Take the pose of the next scan, by odometry if there is one."""
        T = pose.T_map_base if pose.T_odom_base is None else pose.T_odom_base
        moved = None if self._reference is None else se2.between(self._reference, T)
        has_moved = moved is None or np.hypot(moved[0], moved[1]) > MOVED_M or abs(moved[2]) > MOVED_RAD
        if has_moved or pose.stamp < self._since:
            self._reference, self._since = T, pose.stamp
            if self._stands:
                self._stands = False
                self._on_drive()
        elif not self._stands and pose.stamp - self._since >= STANDS_AFTER_S:
            self._stands = True
            self._on_stop()
