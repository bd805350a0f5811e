"""Verification of many pairs of submaps: here, or in batches on other processes. The results are the same."""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Final, NamedTuple

import numpy as np

from fcslam.lidar.submap import Agreement, Submap, read_submap, submap_bytes
from fcslam.lidar.verification import LOOSE, NO_PRIOR, Aligned, Gate, Verification, align, judge, no_noise
from fcslam.records import FloatArray

BATCH: Final = 20
"""Pairs that are handed over together, about 20 ms of work: handing them over takes a few milliseconds."""
AHEAD: Final = 2
"""Batches that a process has at a time: it begins the next one while the result of the last one travels."""
PATIENCE_S: Final = 10.0
"""A batch is repeated after this time."""
REST_S: Final = 0.5 * PATIENCE_S
"""A process that failed gets no batch for so long."""
SUBMAPS_KEPT: Final = 1000
"""Submaps that another process keeps, 0.2 MB each; the least recently used ones are dropped first."""
NAMES_KEPT: Final = SUBMAPS_KEPT // 5
"""Submaps whose hash is kept here."""

_log = logging.getLogger(__name__)


class Pair(NamedTuple):
    """Two submaps that may show the same place, as ``verify`` takes them."""

    a: Submap
    b: Submap
    T_a_b_guess: FloatArray
    prior: FloatArray = NO_PRIOR
    noise: Callable[[], float] = no_noise
    """As in ``judge``. Stays in this process: it needs the scans."""
    predicted: bool = False
    """As in ``judge``."""
    loose: Gate = LOOSE
    """As in ``judge``."""


VerifyPairs = Callable[[Sequence[Pair]], list[Verification]]
"""Verifies pairs and returns the results in their order."""


def verify_here(pairs: Sequence[Pair]) -> list[Verification]:
    """Verify the pairs one after another in this process."""
    return _judged(_aligned_here(pairs), pairs)


def _aligned_here(pairs: Sequence[Pair]) -> list[Aligned]:
    return [align(pair.a, pair.b, pair.T_a_b_guess, pair.prior) for pair in pairs]


def _judged(aligned: Sequence[Aligned], pairs: Sequence[Pair]) -> list[Verification]:
    return [judge(found, pair.noise, pair.predicted, pair.loose) for found, pair in zip(aligned, pairs, strict=True)]


@dataclass(slots=True)
class _Peer:
    executor: Executor
    sent: set[bytes] = field(default_factory=set)
    """Hashes of the submaps that it was sent and may keep."""
    pending: "list[Future[Answer]]" = field(default_factory=list)
    rests_until: float = -math.inf
    warned: bool = False


class VerificationPool:
    """Aligns pairs in this process and in others, and judges them here: a ``VerifyPairs``.

    Every process takes the next batch when it is done with its last one, so a slow one does less. A batch that fails or
    does not come back is repeated by another process, or here. The alignment is a pure function, so the results are the
    same, bit by bit, wherever a batch is aligned.

    A submap takes longer to send than to compare. Each process keeps those that it got, by a hash of their content.

    ``processes`` gives the other processes that take batches now, one by one each; the others: see their defaults.
    """

    def __init__(
        self,
        processes: Callable[[], Sequence[Executor]],
        batch: int = BATCH,
        patience_s: float = PATIENCE_S,
        rest_s: float = REST_S,
    ) -> None:
        self.answers = 0
        """Batches that other processes have aligned so far."""
        self._processes = processes
        self._batch, self._patience_s, self._rest_s = batch, patience_s, rest_s
        self._peers: dict[Executor, _Peer] = {}
        self._hashes: dict[int, tuple[bytes, Submap]] = {}
        """By identity; the reference keeps the identity from being used again."""

    def __call__(self, pairs: Sequence[Pair]) -> list[Verification]:
        """Results in the order of the pairs, whichever process is done first."""
        self._peers = {executor: self._peers.get(executor) or _Peer(executor) for executor in self._processes()}
        starts = range(0, len(pairs), self._batch)
        batches = {start: pairs[start : start + self._batch] for start in starts}
        todo = deque(starts)
        running: dict[Future[Answer], tuple[_Peer, int, float]] = {}
        done: dict[int, list[Aligned]] = {}
        while len(done) < len(batches):
            for peer in [*self._peers.values()] * AHEAD:
                if len(todo) > 1 and self._has_room(peer):  # the last one is done here
                    start = todo.popleft()
                    try:
                        future = self._submit(peer, batches[start])
                    except RuntimeError as error:  # the executor is broken or shut down
                        self._failed(peer, error)
                        todo.append(start)
                    else:
                        running[future] = peer, start, time.perf_counter() + self._patience_s
            if todo:
                start = todo.pop()
                done[start] = _aligned_here(batches[start])
            else:
                until_late_s = min(late_s for _, _, late_s in running.values()) - time.perf_counter()
                wait(running, max(0.0, until_late_s), FIRST_COMPLETED)
            for future, (peer, start, late_s) in list(running.items()):
                if future.done() or time.perf_counter() >= late_s:
                    del running[future]
                    if (found := self._result(peer, future)) is None:
                        todo.append(start)
                    else:
                        done[start] = found
        return _judged([found for start in starts for found in done[start]], pairs)

    def _has_room(self, peer: _Peer) -> bool:
        peer.pending = [future for future in peer.pending if not future.done()]
        return peer.rests_until <= time.perf_counter() and len(peer.pending) < AHEAD

    def _submit(self, peer: _Peer, pairs: Sequence[Pair]) -> "Future[Answer]":
        submaps = {self._hash(submap): submap for pair in pairs for submap in (pair.a, pair.b)}
        number = {name: k for k, name in enumerate(submaps)}
        rows = [
            (number[self._hash(pair.a)], number[self._hash(pair.b)], *pair.T_a_b_guess, *pair.prior.ravel())
            for pair in pairs
        ]
        new = {name: submap_bytes(submap) for name, submap in submaps.items() if name not in peer.sent}
        future = peer.executor.submit(align_batch, list(submaps), new, np.array(rows).tobytes())
        peer.sent.update(submaps)
        peer.pending.append(future)
        return future

    def _result(self, peer: _Peer, future: "Future[Answer]") -> list[Aligned] | None:
        """The answer of the process; None: another one must repeat the batch."""
        try:
            answer = future.result(0.0)
        except (Exception, CancelledError) as error:  # it is repeated here, where an error of the pairs is raised again
            self._failed(peer, error)
            return None
        if isinstance(answer, bytes):
            self.answers += 1
            return [_aligned(row) for row in np.frombuffer(answer).reshape(-1, _WIDTH).copy()]
        peer.sent.difference_update(answer)
        return None

    def _failed(self, peer: _Peer, error: BaseException) -> None:
        level = logging.WARNING if isinstance(error, BrokenExecutor) and not peer.warned else logging.INFO
        _log.log(level, "another process verifies the closures of one that failed: %s: %s", type(error).__name__, error)
        peer.warned = True
        peer.sent.clear()
        peer.rests_until = time.perf_counter() + self._rest_s

    def _hash(self, submap: Submap) -> bytes:
        if id(submap) not in self._hashes:
            if len(self._hashes) >= NAMES_KEPT:
                self._hashes.clear()
            self._hashes[id(submap)] = blake2b(submap_bytes(submap), digest_size=16).digest(), submap
        return self._hashes[id(submap)][0]


Answer = bytes | list[bytes]
"""Alignments of a batch, a row of ``_row`` each; or the hashes of submaps that the process does not have."""

_kept: dict[bytes, Submap] = {}
"""Submaps of a process that takes batches, by the hash of their content. Newest last."""
_keeping: Final = threading.Lock()
"""Held while ``_kept`` changes: a worker of a cluster may have several threads."""


def align_batch(names: Sequence[bytes], new: Mapping[bytes, bytes], rows: bytes) -> Answer:
    """The alignments of a batch, in another process.

    It compares submaps named by their hashes, of which ``new`` ones were not sent yet. ``rows``, float64 of shape (N,
    14), has the numbers of both submaps in ``names``, the guess and its prior for each pair.
    """
    with _keeping:
        for name, data in new.items():
            _kept[name] = read_submap(data)
        missing = [name for name in names if name not in _kept]
        if missing:
            return missing
        submaps = [_kept.pop(name) for name in names]
        _kept.update(zip(names, submaps, strict=True))
        while len(_kept) > SUBMAPS_KEPT:
            del _kept[next(iter(_kept))]
    table = np.frombuffer(rows).reshape(-1, 14).copy()
    pairs = [Pair(submaps[int(row[0])], submaps[int(row[1])], row[2:5], row[5:].reshape(3, 3)) for row in table]
    return np.array([_row(found) for found in _aligned_here(pairs)]).tobytes()


_ENDS: Final = np.cumsum([3, 3 * 3, 4, 3 * 3])
"""Where the parts of a row end: transform, information, shares and normal tensor; then follows the gap."""
_WIDTH: Final = int(_ENDS[-1]) + 3


def _row(found: Aligned) -> FloatArray:
    worse = found.worse
    shares = worse.explained, worse.violation, worse.count, worse.overlap
    return np.concatenate(
        (found.T_a_b, found.information.ravel(), shares, worse.normal_tensor.ravel(), found.gap), dtype=np.float64
    )


def _aligned(row: FloatArray) -> Aligned:
    T_a_b, information, (explained, violation, count, overlap), tensor, gap = np.split(row, _ENDS)
    worse = Agreement(float(explained), float(violation), int(count), float(overlap), tensor.reshape(3, 3))
    return Aligned(T_a_b, information.reshape(3, 3), worse, gap)
