"""Closures are verified by the chosen processes, which live as long as a block.

The choice is a text: the number of processes, this one included, or the address of a Dask scheduler, tcp://HOST:PORT or
tls://HOST:PORT. Of a cluster, those workers are used that compute, bit by bit, what this process computes.
"""

import hashlib
import logging
import re
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any, Final, Self

import numpy as np

import fcslam
from fcslam.errors import InputError
from fcslam.lidar.pair_verification import VerificationPool, VerifyPairs, align_batch, verify_here
from fcslam.lidar.scan import point_scan
from fcslam.lidar.submap import build_submap, submap_bytes
from fcslam.processes import worker_pool
from fcslam.records import LaserModel
from fcslam.storage.state_file import code_version

MOST_PROCESSES: Final = 256
_CLUSTER: Final = re.compile(r"(tcp|tls)://[^/\s]+:\d{1,5}")
CONNECT_S: Final = 10.0
"""Longest wait for the scheduler."""
ANSWER_S: Final = 5.0
"""Longest wait for a scheduler that answered before."""
CHECK_S: Final = 120.0
"""Longest wait for the first check of workers, which compile their code first."""
LOOK_EVERY_S: Final = 1.0
"""Between two looks at which workers there are, and for a scheduler that went away."""

_log = logging.getLogger(__name__)


def is_cluster(workers: str) -> bool:
    """Whether a choice names a cluster."""
    return _CLUSTER.fullmatch(workers) is not None


def check_workers(workers: str) -> None:
    """Check that this can be a choice."""
    if not (is_cluster(workers) or (workers.isdecimal() and 1 <= int(workers) <= MOST_PROCESSES)):
        raise InputError(
            f"--workers: '{workers}' is neither a number from 1 to {MOST_PROCESSES} nor the address of a Dask "
            "scheduler, tcp://HOST:PORT or tls://HOST:PORT"
        )


@contextmanager
def verifying(workers: str, must_connect: bool = True) -> Iterator[VerifyPairs]:
    """Verify pairs on the chosen processes until the block ends. All of them give the same results.

    Args:
        workers: the choice.
        must_connect: whether a cluster must be there now; otherwise this process verifies until it is.
    """
    check_workers(workers)
    with ExitStack() as stack:
        if is_cluster(workers):
            cluster = stack.enter_context(DaskCluster(workers, must_connect))
            yield VerificationPool(cluster.executors)
        elif (others := int(workers) - 1) > 0:
            pools = [stack.enter_context(worker_pool()) for _ in range(others)]
            yield VerificationPool(lambda: pools)
        else:
            yield verify_here


class DaskCluster:
    """The workers of a Dask cluster as executors; a context.

    A thread follows the cluster: workers that join are checked before they get work, and a scheduler that went away is
    looked for until it is back. Nobody waits for that.
    """

    def __init__(self, address: str, must_connect: bool = True) -> None:
        """Connect to a scheduler, and check all workers."""
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise InputError(
                f"{address}: needs Dask; install it: pip install 'fcslam[distributed]' ({error})"
            ) from error
        _quiet()
        self._address = address
        self._client: Any = None
        self._executors: dict[str, Executor] = {}
        """By address, of the workers that passed the check."""
        self._refused: set[str] = set()
        """Addresses of workers that did not."""
        self._asked: dict[str, Any] = {}
        """Answers of workers that are checked now, by address."""
        self._is_gone = False
        self._ending = threading.Event()
        try:
            refusals, until = self._look(), time.monotonic() + CHECK_S
            while self._asked and time.monotonic() < until:
                time.sleep(0.05)
                refusals += self._look()
            if must_connect and refusals:
                raise InputError(f"{address}: worker {refusals[0]}")
            if must_connect and not self._executors:
                raise InputError(f"{address}: the cluster has no worker; start one: dask worker ADDRESS")
        except Exception as error:
            self._disconnect()
            if not must_connect:
                self._warn(_text(error))
            elif isinstance(error, InputError):
                raise
            else:
                raise InputError(
                    f"{address}: no Dask scheduler answers ({_text(error)}); start one: dask scheduler"
                ) from error
        else:
            self._say(refusals)
        self._thread = threading.Thread(target=self._follow, name="dask cluster", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join(ANSWER_S)  # it may wait for a scheduler
        self._disconnect()

    def executors(self) -> Sequence[Executor]:
        """The workers that take batches now."""
        return list(self._executors.values())

    def _follow(self) -> None:
        while not self._ending.wait(LOOK_EVERY_S):
            try:
                refusals = self._look()
            except Exception as error:
                self._disconnect()
                self._warn(_text(error))
            else:
                self._say(refusals)

    def _say(self, refusals: Sequence[str]) -> None:
        for refusal in refusals:
            _log.warning("a worker of the cluster gets no work: %s", refusal)
        if not self._executors:
            self._warn("it has no worker")
        elif self._is_gone:
            self._is_gone = False
            _log.info("the cluster %s is back", self._address)

    def _warn(self, reason: str) -> None:
        """Say once that it is gone, until it is back."""
        if not self._is_gone and not self._ending.is_set():
            _log.warning(
                "the cluster %s is gone (%s); this process verifies closures alone, which is slower",
                self._address,
                reason,
            )
        self._is_gone = True

    def _look(self) -> list[str]:
        """Follow which workers there are; returns why new ones are refused."""
        if self._client is None:
            self._connect()
        client = self._client
        if client.status != "running":
            raise ConnectionError("the scheduler closed the connection")
        identity = client.sync(client.scheduler.identity, n_workers=-1, callback_timeout=ANSWER_S)
        names = {address: str(about["name"]) for address, about in identity["workers"].items()}
        self._refused &= names.keys()
        self._executors = {address: worker for address, worker in self._executors.items() if address in names}
        new = names.keys() - self._executors.keys() - self._refused - self._asked.keys()
        # Not pure: Dask would look for a result of the same arguments, and hash all of them.
        self._asked = {address: answer for address, answer in self._asked.items() if address in names} | {
            address: client.submit(identify, workers=[address], pure=False) for address in new
        }
        refusals = []
        for address in [address for address, answer in self._asked.items() if answer.done()]:
            refusal = _refusal(self._asked.pop(address))
            if refusal is None:
                worker = client.get_executor(workers=[address], pure=False)
                self._executors = {**self._executors, address: worker}
            else:
                self._refused.add(address)
                named = address if names[address] == address else f"'{names[address]}' ({address})"
                refusals.append(f"{named} {refusal}")
        return refusals

    def _connect(self) -> None:
        from distributed import Client
        from distributed.security import Security

        try:  # TLS as Dask is configured (``distributed.comm.tls``)
            security = Security(require_encryption=self._address.startswith("tls://"))
        except (OSError, ValueError) as error:
            raise InputError(f"{self._address}: the certificates cannot be used ({_text(error)})") from error
        self._client = Client(self._address, timeout=CONNECT_S, set_as_default=False, security=security, name="fcslam")
        self._client.loop.asyncio_loop.set_exception_handler(_note)

    def _disconnect(self) -> None:
        self._executors, self._asked = {}, {}
        client, self._client = self._client, None
        if client is not None:
            try:
                client.close(timeout=ANSWER_S)
            except Exception as error:  # whatever it was, it is gone
                _log.debug("the client of the cluster was not closed: %s", _text(error))


def _refusal(answer: Any) -> str | None:
    """Why a worker may not verify closures, by its answer to ``identify``; None: it may."""
    version, code, proof = identify()
    try:
        there, its_code, its_proof = answer.result()
    except Exception as error:
        return f"cannot verify closures ({_text(error)}); install fcslam {version} there"
    if (there, its_code) != (version, code):
        return (
            f"has fcslam {there}, whose sources or libraries differ from fcslam {version} here; "
            "install the same ones there"
        )
    if its_proof != proof:
        return "computes other digits, as its processor differs; the map would depend on who verifies"
    return None


@cache
def identify() -> tuple[str, str, str]:
    """Version, code and a hash of alignments that all processes that verify closures share; compiles what they need."""
    return fcslam.__version__, code_version(), hashlib.blake2b(_proof(), digest_size=16).hexdigest()


def _proof() -> bytes:
    """The alignments of two views of a made-up room, at guesses that are off by up to a metre."""
    laser = LaserModel(360, 0.001 - np.pi, 2.0 * np.pi / 360, 20.0)  # no beam along a wall
    poses = np.array([(0.0, 0.0, 0.0), (0.9, -0.4, 0.3)])
    submaps = [submap_bytes(build_submap([(point_scan(_ranges(laser, pose), laser), np.zeros(3))])) for pose in poses]
    names = [hashlib.blake2b(data, digest_size=16).digest() for data in submaps]
    rng = np.random.default_rng(0)
    guesses = poses[1] + rng.normal(0.0, (0.3, 0.3, 0.05), (20, 3))
    priors = [np.zeros((3, 3)), np.diag((10.0, 10.0, 100.0))]
    rows = np.array([(0, 1, *guess, *priors[k % 2].ravel()) for k, guess in enumerate(guesses)])
    answer = align_batch(names, dict(zip(names, submaps, strict=True)), rows.tobytes())
    assert isinstance(answer, bytes), "it was sent all submaps"
    return answer


def _ranges(laser: LaserModel, pose: np.ndarray) -> np.ndarray:
    """Distance to the walls of a room of 9 m x 6 m with a round pillar, along every beam from a pose, shape (B,)."""
    angles = laser.angles_rad() + pose[2]
    along = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    walls = np.min((np.sign(along) * (4.5, 3.0) - pose[:2]) / along, axis=1)
    to_pillar = np.array((2.0, 1.0)) - pose[:2]
    nearest = along @ to_pillar
    inside = 0.6**2 - (to_pillar @ to_pillar - nearest**2)
    pillar = np.where((inside > 0.0) & (nearest > 0.0), nearest - np.sqrt(np.maximum(inside, 0.0)), np.inf)
    return np.asarray(np.minimum(walls, pillar))


def _quiet() -> None:
    """Silence Dask: this module logs a lost connection once, and a batch may be large."""
    import dask

    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})
    for name in ("distributed", "distributed.client", "distributed.core", "distributed.comm"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _note(_loop: object, context: dict[str, Any]) -> None:
    """Log errors of connections that Dask gave up, which asyncio would print."""
    _log.debug("%s: %s", context["message"], context.get("exception"))


def _text(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
