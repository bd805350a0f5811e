"""Worker processes that end with the process that started them, however that ends."""

import multiprocessing
import os
import signal
import sys
import threading
from typing import Any


def start_method() -> Any:
    """The context of quick workers: copies of this process, which has loaded all code, where such copies are safe."""
    return multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


def obey_parent() -> None:
    """Make this process a worker: Ctrl-C, which reaches all processes, is its parent's, and it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that is killed cannot end its workers."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
