"""Waiting for what other threads and processes do."""

import time
from collections.abc import Callable
from typing import Any


def wait_for(condition: Callable[[], Any]) -> Any:
    """Wait until ``condition`` is true, for two minutes at most, and return what it says."""
    end = time.monotonic() + 120.0
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(0.01)
    assert found
    return found
