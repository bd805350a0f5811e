"""The clock of a robot on a ROS network, and the stamps of ``map -> odom`` by it.

The clock is the computer's, a simulator's or that of a played bag. Between scans the transform is published again.
"""

import threading
import time

from fcslam.records import FloatArray
from fcslam.sources.bags.codec import MessageCodec

CLOCK_TOPIC, CLOCK = "/clock", "rosgraph_msgs/Clock"


class RosClock:
    """Time in nanoseconds. With ``simulated`` it is what the last message on /clock says."""

    def __init__(self, simulated: bool) -> None:
        self.simulated = simulated
        self._ticked_ns: int | None = None

    @property
    def is_running(self) -> bool:
        """Whether the time is known."""
        return not self.simulated or self._ticked_ns is not None

    def tick(self, payload: bytes, codec: MessageCodec) -> None:
        """Take a message of /clock; an invalid one is ignored."""
        try:
            clock = codec.decode(payload, CLOCK).clock
        except ValueError:
            return
        self._ticked_ns = clock.sec * 10**9 + clock.nanosec

    def now_ns(self) -> int:
        """The time; 0 before the first message on /clock."""
        return (self._ticked_ns or 0) if self.simulated else time.time_ns()


class TransformStream:
    """``map -> odom`` for any time near the newest scan. Stamps only grow until ``restart``. Any thread may call.

    Between two scans the transform is constant, because a robot's motion is that of ``odom -> base``. It holds for at
    most ``bound_ns`` after the newest scan: then navigation must see that the robot is blind.
    """

    def __init__(self, bound_ns: int, timeout_ns: int) -> None:
        """``timeout_ns``: how far stamps lie ahead, so that a listener finds a transform for the present."""
        self._bound_ns, self._timeout_ns = bound_ns, timeout_ns
        self._lock = threading.Lock()
        self._newest: tuple[int, int, FloatArray] | None = None
        """Stamp of the newest scan, when it came, and its transform."""
        self._last_ns: int | None = None

    def add(self, stamp_ns: int, now_ns: int, T_map_odom: FloatArray) -> None:
        """Take the transform of a scan with this stamp, which comes at ``now_ns`` by any clock."""
        with self._lock:
            if self._newest is None or stamp_ns >= self._newest[0]:
                self._newest = stamp_ns, now_ns, T_map_odom

    def pause(self) -> None:
        """Publish nothing until the next ``add``: the transform is not known any more."""
        with self._lock:
            self._newest = None

    def restart(self) -> None:
        """Forget all stamps, as the clock stepped back."""
        with self._lock:
            self._newest = self._last_ns = None

    def due(self, now_ns: int) -> tuple[int, FloatArray] | None:
        """The stamp and the transform to publish at ``now_ns``; None without a scan, or if nothing newer is known."""
        with self._lock:
            if self._newest is None:
                return None
            scanned_ns, came_ns, T_map_odom = self._newest
            elapsed_ns = min(max(0, now_ns - came_ns), self._bound_ns)
            stamp_ns = scanned_ns + elapsed_ns + self._timeout_ns
            if self._last_ns is not None and stamp_ns <= self._last_ns:
                return None
            self._last_ns = stamp_ns
            return stamp_ns, T_map_odom
