"""Token buckets: how much each of several clients may do on average, and how much at once."""

import threading
from collections.abc import Callable


class TokenBuckets:
    """A bucket for each name, full at first. Any thread may call."""

    def __init__(self, clock: Callable[[], float], rate: float, burst: float) -> None:
        """``rate``: tokens per second that fill a bucket; ``burst``: those in a full one."""
        self._clock, self._rate, self._burst = clock, rate, burst
        self._level: dict[str, tuple[float, float]] = {}
        """Level of each bucket and its time."""
        self._lock = threading.Lock()

    def wait_s(self, name: str, cost: float) -> float:
        """Take ``cost`` tokens; if there are too few, how long to wait, and none is taken."""
        with self._lock:
            now = self._clock()
            level, then = self._level.get(name, (self._burst, now))
            level = min(self._burst, level + (now - then) * self._rate) - cost
            if level < 0.0:
                return -level / self._rate
            self._level[name] = level, now
            return 0.0
