"""Waiting for what other threads and processes do."""

import time
from collections.abc import Callable
from typing import Any


def wait_for(condition: Callable[[], Any], longest_s: float = 120.0) -> Any:
    """Wait until ``condition`` is true, and return what it says."""
    end, pause_s = time.monotonic() + longest_s, 0.01
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(pause_s)
        pause_s = min(1.5 * pause_s, 0.1)  # who asks a server again and again slows it
    assert found
    return found
