"""Waiting for what other threads and processes do."""

import time
from collections.abc import Callable


def wait_for(condition: Callable[[], object]) -> None:
    """Wait until ``condition`` is true, for two minutes at most."""
    end = time.monotonic() + 120.0
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    assert condition()
