"""A service and robots as processes of their own on loopback, and whether their map is that of `fcslam map`.

No benchmark itself.
"""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import common

PATIENCE_S = 600.0
"""What takes longer has failed."""
FULL_BYTES = 4096
UPLINK = ("hello", "keyscan", "constraint", "place")


class Process:
    """A command that can be killed and started again."""

    def __init__(self, arguments: Sequence[object], log: Path) -> None:
        self._arguments = [sys.executable, "-c", common._COMMAND, *map(str, arguments)]
        self.log = log
        self.kills = 0
        self.start()

    def start(self) -> None:
        environment = {**os.environ, "PYTHONPATH": str(Path(common.fcslam.__file__).parents[1]), "OMP_NUM_THREADS": "1"}
        with self.log.open("ab") as output:
            self.process = subprocess.Popen(self._arguments, env=environment, stdout=output, stderr=output)

    def kill_and_start(self) -> None:
        """Without a word; one that is done rests."""
        if self.process.poll() is None:
            self.kill()
            self.kills += 1
            self.start()

    def kill(self) -> None:
        """If it still runs: a script that fails leaves nobody behind."""
        self.process.kill()
        self.process.wait()

    def kill_children(self) -> None:
        """What it has started; it is expected to start them again."""
        threads = Path(f"/proc/{self.process.pid}/task").glob("*/children")
        for child in " ".join(path.read_text(encoding="ascii") for path in threads).split():
            with suppress(ProcessLookupError):
                os.kill(int(child), signal.SIGKILL)
                self.kills += 1

    def ended(self) -> bool:
        """Whether it is done; that it failed ends the script."""
        code = self.process.poll()
        if code:
            sys.exit(f"{' '.join(self._arguments[3:])} ended with {code}:\n{self.log.read_text()[-3000:]}")
        return code == 0

    def fill_disk(self) -> None:
        """No file may become larger than a few kB: what SQLite writes next fails as on a full disk."""
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (FULL_BYTES, resource.RLIM_INFINITY))

    def empty_disk(self) -> None:
        unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, unlimited)


@contextmanager
def cloud(place: Path, *options: object) -> Iterator[tuple[Process, int]]:
    """A server on a port of its own, with these options of `fcslam serve`."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ("serve", "--data", place / "cloud", "--host", "127.0.0.1", "--port", port, *options)
    server = Process(arguments, place / "server.log")
    wait_for(port, server)
    try:
        yield server, port
    finally:
        server.process.send_signal(signal.SIGTERM)
        server.process.wait(PATIENCE_S)


def wait_for(port: int, server: Process) -> None:
    """Until the server answers."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        if server.ended():
            sys.exit("the server ended")
        with suppress(OSError):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=5).close()
            return
        time.sleep(0.2)
    sys.exit("the server does not answer")


@contextmanager
def robot(log: Path, port: int, place: Path, speed: object) -> Iterator[Process]:
    """Plays a recording; goes on with it when it is started again."""
    state = place / "state" / log.stem
    url = f"http://127.0.0.1:{port}"
    arguments = ("play", log, "--server", url, "--state", state, "--speed", speed, "--resume")
    process = Process(arguments, place / f"{log.stem}.log")
    try:
        yield process
    finally:
        process.kill()


class Compared(NamedTuple):
    """A service's run beside that of `fcslam map`; columns of a table."""

    packets: float
    lost: float
    twice: float
    closures: int
    """Accepted."""
    closures_same: str
    off: float
    """Largest difference of any number of the two pose graphs."""
    map_same: str
    poses_same: str

    @property
    def passed(self) -> bool:
        """No tolerance but for the graph, which is text: the same digits."""
        same = (self.closures_same, self.map_same, self.poses_same)
        return set(same) == {"yes"} and self.off <= 1e-9 and self.lost == self.twice == 0.0


def compare(run: Path, reference: Path) -> Compared:
    ours, theirs = common.metrics(run), common.metrics(reference)
    kinds = [name for name in theirs if name.endswith("_packets") and name.split("_")[0] in UPLINK]
    more = [ours[name] - theirs[name] for name in kinds]
    lines = [(folder / "closures.csv").read_text(encoding="utf-8").splitlines() for folder in (run, reference)]
    accepted = sum(line.split(",")[9] == "accepted" for line in lines[0][1:])
    return Compared(
        sum(ours[name] for name in kinds), sum(max(0.0, -n) for n in more), sum(max(0.0, n) for n in more), accepted,
        yes(lines[0] == lines[1]), graph_difference(run, reference), yes(maps(run) == maps(reference)),
        yes(has_poses(run, reference)),
    )  # fmt: skip


def yes(is_so: bool) -> str:
    return "yes" if is_so else "NO"


def maps(run: Path) -> dict[str, bytes]:
    """Every map of the run, byte for byte."""
    return {path.name: path.read_bytes() for path in run.glob("map*.pgm")}


def has_poses(run: Path, reference: Path) -> bool:
    """Whether the service's poses, those of keyscans, stand digit by digit among the other's, of all scans."""
    files = [{path.name: path for path in (folder / "trajectories").glob("*.tum")} for folder in (run, reference)]
    return files[0].keys() == files[1].keys() and all(
        set(path.read_text(encoding="ascii").splitlines())
        <= set(files[1][name].read_text(encoding="ascii").splitlines())
        for name, path in files[0].items()
    )


def graph_difference(run: Path, reference: Path) -> float:
    """Largest difference of any number of the two graphs; infinite if they have not the same lines."""
    graphs = [(folder / "pose_graph.g2o").read_text(encoding="utf-8").split() for folder in (run, reference)]
    if len(graphs[0]) != len(graphs[1]):
        return float("inf")
    largest = 0.0
    for ours, theirs in zip(*graphs, strict=True):
        if ours != theirs:
            try:
                largest = max(largest, abs(float(ours) - float(theirs)))
            except ValueError:
                return float("inf")
    return largest


def finalize(port: int) -> Path:
    """Ask for the result of all packets, and wait for its run folder."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/v1/finalize", data=b"", timeout=PATIENCE_S) as answer:
        return Path(json.load(answer)["run"])
