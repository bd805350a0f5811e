"""The clocks of a robot's stamps, by the times at which messages are recorded, or arrive."""

from array import array
from collections.abc import Sequence
from statistics import median
from typing import Any

from fcslam.sources.bags.codec import NANOSECONDS
from fcslam.sources.bags.messages import stamp_ns_of
from fcslam.sources.gate import FIRST_MESSAGES


class StampClock:
    """The clock of the stamps of one topic: messages without a stamp are read by it."""

    def __init__(self) -> None:
        self.unstamped = 0
        """Messages with a stamp of zero."""
        self._lags_s = array("d")

    def note(self, header: Any, now_ns: int) -> None:
        """Take the header of the next message, which is recorded at ``now_ns``."""
        stamp_ns = stamp_ns_of(header)
        self.unstamped += not stamp_ns
        if stamp_ns and len(self._lags_s) < FIRST_MESSAGES:
            self._lags_s.append((now_ns - stamp_ns) / NANOSECONDS)

    @property
    def lags_s(self) -> Sequence[float]:
        """Times from the stamps of the first messages to their recording, which count if none has a stamp."""
        return self._lags_s or [0.0] * min(self.unstamped, FIRST_MESSAGES)

    @property
    def lag_ns(self) -> int:
        """Time of recording less the clock of the stamps that are set, in whole milliseconds; 0 if none is missing."""
        return round(1e3 * median(self._lags_s)) * 10**6 if self.unstamped and self._lags_s else 0


def restamped(content: Any, now_ns: int, lag_ns: int) -> Any:
    """The content of a message by the clock of its topic: a stamp that is the time of recording was zero."""
    if isinstance(content, list):
        return [restamped(each, now_ns, lag_ns) for each in content]
    if isinstance(content, ValueError) or content.stamp != now_ns / NANOSECONDS:
        return content
    return content._replace(stamp=(now_ns - lag_ns) / NANOSECONDS)
