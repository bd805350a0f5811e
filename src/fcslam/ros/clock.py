"""The clock of a robot on a ROS network: the computer's, or that of a simulator or of a bag that is played."""

import time

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
