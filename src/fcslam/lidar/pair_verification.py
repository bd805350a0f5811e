"""Verification of many pairs of submaps: here, or in batches on other processes too. The results are the same."""

import itertools
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Final, NamedTuple, TypeVar

import numpy as np

from fcslam.lidar.submap import Agreement, Submap
from fcslam.lidar.submap_bytes import read_submap, submap_bytes
from fcslam.lidar.verification import (
    NO_PRIOR,
    Aligned,
    Verification,
    VerificationConfig,
    align,
    judge,
    no_noise,
    verify,
)
from fcslam.processes import obey_parent, worker_pool
from fcslam.records import FloatArray

BATCH_S: Final = 0.02
"""Least work of a batch: handing one over takes a few milliseconds."""
BATCHES_EACH: Final = 4
"""Most batches of a process in one call, unless it is faster than others."""
AHEAD: Final = 2
"""Batches that a process has at a time: it begins the next one while the result of the last one travels."""
SUBMAPS_KEPT: Final = 1000
"""Submaps that another process keeps, 0.2 MB each; the least recently used ones are dropped first."""
NAMES_KEPT: Final = 200
"""Submaps whose hash is kept here."""
_FIRST_GUESS_S: Final = 1e-3
"""Length of a pair before one was measured."""
_LENGTH_S: Final = (1e-4, 0.1)
"""Limits of what is taken for the length of a pair: the first one may have waited for the compiler."""
_SMOOTHING: Final = 0.1
_ROW: Final = 14
"""Numbers of a pair in a request: two submaps, guess, prior."""

_log = logging.getLogger(__name__)


class Pair(NamedTuple):
    """Two submaps that may show the same place; the fields are those of ``verify``."""

    a: Submap
    b: Submap
    T_a_b_guess: FloatArray
    prior: FloatArray = NO_PRIOR
    noise: Callable[[], float] = no_noise
    """Stays in this process: it needs the scans."""


VerifyPairs = Callable[[Sequence[Pair], VerificationConfig], list[Verification]]
"""Verifies pairs and returns the results in their order."""

_Kept = TypeVar("_Kept")


def verify_here(pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
    """Verify the pairs one after another in this process."""
    return [verify(a, b, guess, config, prior, noise) for a, b, guess, prior, noise in pairs]


class VerificationPool:
    """Aligns pairs in this process and in others of this machine, and judges them here: a ``VerifyPairs``.

    Every process takes the next batch when it is done with its last one, so a slow one does less. A batch that fails is
    repeated here, and its process gets no more. The alignment is a pure function, so the results are the same, bit by
    bit, wherever a batch is aligned.

    A submap takes longer to send than to compare. Each process keeps those that it got, by a hash of their content.
    """

    def __init__(self, processes: Sequence[Executor]) -> None:
        """Each executor runs its tasks in one process, in order; the caller shuts it down."""
        self._peers = [_Peer(executor) for executor in processes]
        self._hashes: dict[int, tuple[bytes, Submap]] = {}
        """By identity; the reference keeps the identity from being used again. Newest last."""
        self._pair_s = _FIRST_GUESS_S

    def __call__(self, pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
        """Results in the order of the pairs, whichever process is done first."""
        if not pairs:
            return []
        batches = _split(len(pairs), 1 + len(self._peers), math.ceil(BATCH_S / self._pair_s))
        aligned = self._align(pairs, batches)
        return [judge(found, config, pair.noise) for found, pair in zip(aligned, pairs, strict=True)]

    def _align(self, pairs: Sequence[Pair], batches: Sequence[range]) -> list[Aligned]:
        todo, done = deque(batches), dict[range, list[Aligned]]()
        running: dict[Future[bytes], tuple[_Peer, range]] = {}
        while len(done) < len(batches):
            self._hand_out(pairs, todo, running)
            if todo:
                batch = todo.pop()
                began = time.perf_counter()
                done[batch] = [align(p.a, p.b, p.T_a_b_guess, p.prior) for p in pairs[_slice(batch)]]
                self._measured((time.perf_counter() - began) / len(batch))
            else:
                wait(running, return_when=FIRST_COMPLETED)
            for future in [future for future in running if future.done()]:
                peer, batch = running.pop(future)
                try:
                    done[batch] = _read_aligned(future.result(), len(batch))
                except (Exception, CancelledError) as error:  # an error of the pairs is raised again here
                    self._failed(peer, error)
                    todo.append(batch)
        return [found for batch in batches for found in done[batch]]

    def _hand_out(
        self, pairs: Sequence[Pair], todo: deque[range], running: "dict[Future[bytes], tuple[_Peer, range]]"
    ) -> None:
        """Give batches to all processes that have room for them; the last one is done here."""
        for _ in range(AHEAD):
            for peer in list(self._peers):
                if len(todo) <= 1 or sum(busy is peer for busy, _ in running.values()) >= AHEAD:
                    continue
                try:
                    future = peer.submit(pairs[_slice(todo[0])], self._hash)
                except RuntimeError as error:  # the executor is broken or shut down
                    self._failed(peer, error)
                else:
                    running[future] = peer, todo.popleft()

    def _failed(self, peer: "_Peer", error: BaseException) -> None:
        if peer in self._peers:
            self._peers.remove(peer)
            _log.warning("closures are verified without a process that failed: %s: %s", type(error).__name__, error)

    def _measured(self, pair_s: float) -> None:
        shortest, longest = _LENGTH_S
        self._pair_s += _SMOOTHING * (min(max(pair_s, shortest), longest) - self._pair_s)

    def _hash(self, submap: Submap) -> bytes:
        known = self._hashes.pop(id(submap), None)
        if known is None:
            known = blake2b(submap_bytes(submap), digest_size=16).digest(), submap
            if len(self._hashes) >= NAMES_KEPT:
                del self._hashes[next(iter(self._hashes))]
        self._hashes[id(submap)] = known
        return known[0]


@contextmanager
def verifying(processes: int) -> Iterator[VerifyPairs]:
    """Verify pairs on this many processes, this one included, until the block ends. The results are always the same.

    Raises:
        InputError: the host gives processes no semaphores.
    """
    with ExitStack() as stack:
        others = [stack.enter_context(worker_pool(obey_parent)) for _ in range(processes - 1)]
        yield VerificationPool(others) if others else verify_here


@dataclass(slots=True, eq=False)
class _Peer:
    """Another process, and what it was sent."""

    executor: Executor
    sent: dict[bytes, None] = field(default_factory=dict)
    """Hashes of the submaps that it keeps, as ``_kept`` there; newest last."""

    def submit(self, pairs: Sequence[Pair], hash_of: Callable[[Submap], bytes]) -> "Future[bytes]":
        """Start to align a batch."""
        submaps = {hash_of(submap): submap for pair in pairs for submap in (pair.a, pair.b)}
        number = {name: k for k, name in enumerate(submaps)}
        rows = np.array(
            [
                (number[hash_of(pair.a)], number[hash_of(pair.b)], *pair.T_a_b_guess, *pair.prior.ravel())
                for pair in pairs
            ]
        )
        new = {name: submap_bytes(submap) for name, submap in submaps.items() if name not in self.sent}
        future = self.executor.submit(align_batch, list(submaps), new, rows.tobytes())
        _keep(self.sent, dict.fromkeys(submaps))
        return future


_kept: dict[bytes, Submap] = {}
"""Submaps of a process that takes batches, by the hash of their content. Newest last."""


def _keep(kept: dict[bytes, _Kept], named: Mapping[bytes, _Kept]) -> None:
    """Add what a batch needs as the newest, and drop the oldest beyond ``SUBMAPS_KEPT``: here as in the process."""
    for name, value in named.items():
        kept.pop(name, None)
        kept[name] = value
    while len(kept) > SUBMAPS_KEPT:
        del kept[next(iter(kept))]


def align_batch(names: Sequence[bytes], new: Mapping[bytes, bytes], rows: bytes) -> bytes:
    """The alignments of a batch, in another process.

    Args:
        names: hashes of the submaps that the batch compares.
        new: those that the process does not keep, by their hashes.
        rows: float64, shape (N, 14): the numbers of both submaps in ``names``, the guess and its prior, of each pair.
    """
    named = {name: read_submap(new[name]) if name in new else _kept[name] for name in names}
    _keep(_kept, named)
    submaps = list(named.values())
    return _aligned_bytes(
        [
            align(submaps[int(row[0])], submaps[int(row[1])], row[2:5].copy(), row[5:].reshape(3, 3).copy())
            for row in np.frombuffer(rows).reshape(-1, _ROW)
        ]
    )


def _aligned_bytes(batch: Sequence[Aligned]) -> bytes:
    """float64, shape (N, 29)."""
    return np.array(
        [
            (
                *found.T_a_b,
                *found.information.ravel(),
                found.worse.explained,
                found.worse.violation,
                found.worse.count,
                found.worse.overlap,
                *found.worse.normal_tensor.ravel(),
                found.weakest,
                *found.gap,
            )
            for found in batch
        ]
    ).tobytes()


def _read_aligned(data: bytes, count: int) -> list[Aligned]:
    return [
        Aligned(
            row[:3].copy(),
            row[3:12].reshape(3, 3).copy(),
            Agreement(float(row[12]), float(row[13]), int(row[14]), float(row[15]), row[16:25].reshape(3, 3).copy()),
            float(row[25]),
            row[26:29].copy(),
        )
        for row in np.frombuffer(data).reshape(count, -1)
    ]


def _split(count: int, processes: int, least: int) -> list[range]:
    """Ranges of about equal length, of at least ``least`` pairs, as many for each process; one if that is too few."""
    batches = min(count // least, BATCHES_EACH * processes)
    if batches > processes:
        batches -= batches % processes
    batches = max(batches, 1)
    ends = [count * k // batches for k in range(batches + 1)]
    return [range(*span) for span in itertools.pairwise(ends)]


def _slice(batch: range) -> slice:
    return slice(batch.start, batch.stop)
