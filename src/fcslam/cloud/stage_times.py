"""How often the stages of the cloud ran, and how long: for those who watch a service. Nothing is decided by it."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple


class StageTotal(NamedTuple):
    """All runs of one stage."""

    runs: int
    seconds: float
    """Wall-clock time."""


class StageTimes:
    """Totals by the name of the stage."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.totals: dict[str, StageTotal] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Count the block as one run of the stage."""
        began = self._clock()
        try:
            yield
        finally:
            runs, seconds = self.totals.get(stage, StageTotal(0, 0.0))
            self.totals[stage] = StageTotal(runs + 1, seconds + self._clock() - began)
