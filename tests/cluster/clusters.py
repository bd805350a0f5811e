"""Dask clusters of real processes on this machine."""

import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from tests.waiting import wait_for

needs_dask = pytest.mark.skipif(
    subprocess.run([sys.executable, "-c", "import distributed"], capture_output=True, check=False).returncode != 0,
    reason="needs Dask: make scale-test",
)


class Cluster:
    """A scheduler and its workers; a context."""

    def __init__(self, folder: Path, scheme: str = "tcp", options: tuple[str, ...] = (), *, start: bool = True):
        self.folder, self.scheme, self.options = folder, scheme, options
        self.processes: list[subprocess.Popen[bytes]] = []
        if start:
            self.start_scheduler()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.processes):
            process.kill()
            process.wait()

    def start_scheduler(self, port: int = 0):
        """Start a scheduler, on the port if one is given."""
        file = self.folder / "scheduler.json"
        file.unlink(missing_ok=True)
        host = ("--host", f"{self.scheme}://127.0.0.1:{port}")
        self.scheduler = self.start("scheduler", *host, "--no-dashboard", "--no-jupyter", "--scheduler-file", str(file))
        self.address = wait_for(lambda: written_address(file))

    def start_worker(self, name: str, *options: str, preload: str = ""):
        """Start a worker of one thread; ``preload`` is code that it runs first."""
        preloaded = ("--preload", preload) if preload else ()
        return self.start(
            "worker", self.address, "--name", name, "--nthreads", "1", "--no-dashboard", "--no-nanny",
            "--local-directory", str(self.folder), *preloaded, *options,
        )  # fmt: skip

    def start(self, kind: str, *options: str):
        """Start one of Dask's commands."""
        command = (sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, *self.options)
        log = (self.folder / f"{kind}-{len(self.processes)}.log").open("wb")
        with log:
            process = subprocess.Popen(command, stdout=log, stderr=log, env=os.environ | {"OMP_NUM_THREADS": "1"})
        self.processes.append(process)
        return process


def written_address(file: Path) -> str | None:
    """The address in a scheduler's file, once it is complete."""
    with suppress(FileNotFoundError, ValueError):
        return json.loads(file.read_text())["address"]
    return None
