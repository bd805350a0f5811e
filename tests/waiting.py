"""Waiting for what other threads and processes do."""

import time
from collections.abc import Callable
from typing import Any


def wait_for(condition: Callable[[], Any], longest_s: float = 120.0) -> Any:
    """Wait until ``condition`` is true, and return what it says."""
    end = time.monotonic() + longest_s
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(0.01)
    assert found
    return found
