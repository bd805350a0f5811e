"""Verification of many pairs of submaps: here, or in batches on other processes. The results are the same."""

import itertools
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
)
from fcslam.records import FloatArray

BATCH_S: Final = 0.02
"""Least work of a batch: handing one over takes a few milliseconds."""
BATCHES_EACH: Final = 4
"""Most batches of a process in one call, unless it is faster than others."""
AHEAD: Final = 2
"""Batches that a process has at a time: it begins the next one while the result of the last one travels."""
PATIENCE_S: Final = 1.0
PATIENCE_FACTOR: Final = 20.0
"""A batch is repeated after this time and this many times its expected length."""
REST_S: Final = 5.0
"""A process that failed gets no batch for so long."""
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
    """Two submaps that may show the same place, as ``verify`` takes them."""

    a: Submap
    b: Submap
    T_a_b_guess: FloatArray
    prior: FloatArray = NO_PRIOR
    noise: Callable[[], float] = no_noise
    """As in ``judge``. Stays in this process: it needs the scans."""
    predicted: bool = False
    """As in ``judge``."""


VerifyPairs = Callable[[Sequence[Pair], VerificationConfig], list[Verification]]
"""Verifies pairs and returns the results in their order."""

Processes = Callable[[], Sequence[Executor]]
"""The other processes that take batches now. Each executor runs its tasks in one process."""


def verify_here(pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
    """Verify the pairs one after another in this process."""
    return [_judge(align(pair.a, pair.b, pair.T_a_b_guess, pair.prior), pair, config) for pair in pairs]


def _judge(aligned: Aligned, pair: Pair, config: VerificationConfig) -> Verification:
    return judge(aligned, config, pair.noise, pair.predicted)


class VerificationPool:
    """Aligns pairs in this process and in others, and judges them here: a ``VerifyPairs``.

    Every process takes the next batch when it is done with its last one, so a slow one does less. A batch that fails or
    does not come back is repeated by another process, or here. The alignment is a pure function, so the results are the
    same, bit by bit, wherever a batch is aligned.

    A submap takes longer to send than to compare. Each process keeps those that it got, by a hash of their content.
    """

    def __init__(self, processes: Processes) -> None:
        """Start with no submap sent; the caller shuts the executors down."""
        self._processes = processes
        self._peers: dict[Executor, _Peer] = {}
        self._hashes: dict[int, tuple[bytes, Submap]] = {}
        """By identity; the reference keeps the identity from being used again. Newest last."""
        self._pair_s = _FIRST_GUESS_S

    def __call__(self, pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
        """Results in the order of the pairs, whichever process is done first."""
        if not pairs:
            return []
        peers = self._present()
        batches = _split(len(pairs), 1 + len(peers), math.ceil(BATCH_S / self._pair_s))
        aligned = self._align(pairs, batches, peers)
        return [_judge(found, pair, config) for found, pair in zip(aligned, pairs, strict=True)]

    def _present(self) -> "list[_Peer]":
        executors, now = self._processes(), time.perf_counter()
        self._peers = {executor: self._peers.get(executor) or _Peer(executor) for executor in executors}
        return [peer for peer in self._peers.values() if peer.rests_until <= now]

    def _align(self, pairs: Sequence[Pair], batches: Sequence[range], peers: "list[_Peer]") -> list[Aligned]:
        call = _Call(pairs, deque(batches), {}, {})
        while len(call.done) < len(batches):
            self._hand_out(call, peers)
            if call.todo:
                batch = call.todo.pop()
                began = time.perf_counter()
                call.done[batch] = [align(p.a, p.b, p.T_a_b_guess, p.prior) for p in pairs[_slice(batch)]]
                self._measured((time.perf_counter() - began) / len(batch))
            else:
                wait(call.running, self._until_late_s(call), FIRST_COMPLETED)
            self._collect(call)
        return [found for batch in batches for found in call.done[batch]]

    def _hand_out(self, call: "_Call", peers: "list[_Peer]") -> None:
        """Give batches to all processes that have room for them; the last one is done here."""
        for _ in range(AHEAD):
            for peer in peers:
                if len(call.todo) <= 1 or peer.rests_until > time.perf_counter() or not peer.has_room():
                    continue
                batch = call.todo.popleft()
                try:
                    future = peer.submit(call.pairs[_slice(batch)], self._hash)
                except RuntimeError as error:  # the executor is broken or shut down
                    self._failed(peer, error)
                    call.todo.append(batch)
                else:
                    late_s = time.perf_counter() + PATIENCE_S + PATIENCE_FACTOR * AHEAD * len(batch) * self._pair_s
                    call.running[future] = _Running(peer, batch, late_s)

    def _until_late_s(self, call: "_Call") -> float:
        return max(0.0, min(running.late_s for running in call.running.values()) - time.perf_counter())

    def _collect(self, call: "_Call") -> None:
        for future, (peer, batch, late_s) in list(call.running.items()):
            if not future.done() and time.perf_counter() < late_s:
                continue
            del call.running[future]
            found = self._result(peer, future, len(batch))
            if found is None:
                call.todo.append(batch)
            else:
                call.done[batch] = found

    def _result(self, peer: "_Peer", future: "Future[Answer]", count: int) -> list[Aligned] | None:
        """The answer of the process; None: another one must repeat the batch."""
        if not future.done():
            self._failed(peer, TimeoutError("no answer"))
            return None
        try:
            answer = future.result()
        except (Exception, CancelledError) as error:  # it is repeated here, where an error of the pairs is raised again
            self._failed(peer, error)
            return None
        if isinstance(answer, bytes):
            return _read_aligned(answer, count)
        peer.lost(answer)
        return None

    def _failed(self, peer: "_Peer", error: BaseException) -> None:
        local = isinstance(error, BrokenExecutor)
        level = logging.WARNING if local and not peer.warned else logging.INFO
        _log.log(level, "another process verifies the closures of one that failed: %s: %s", type(error).__name__, error)
        peer.warned = True
        peer.sent.clear()
        peer.rests_until = math.inf if local else time.perf_counter() + REST_S

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


@dataclass(slots=True)
class _Call:
    """One call of a pool."""

    pairs: Sequence[Pair]
    todo: deque[range]
    running: "dict[Future[Answer], _Running]"
    done: dict[range, list[Aligned]]


class _Running(NamedTuple):
    peer: "_Peer"
    batch: range
    late_s: float
    """When it is repeated, by the clock of the pool."""


@dataclass(slots=True)
class _Peer:
    """Another process, and what it was sent."""

    executor: Executor
    sent: dict[bytes, None] = field(default_factory=dict)
    """Hashes of the submaps that it keeps; newest last."""
    pending: "list[Future[Answer]]" = field(default_factory=list)
    rests_until: float = -math.inf
    warned: bool = False

    def has_room(self) -> bool:
        """Whether it may have one more batch; one that does not answer gets none."""
        self.pending = [future for future in self.pending if not future.done()]
        return len(self.pending) < AHEAD

    def submit(self, pairs: Sequence[Pair], hash_of: Callable[[Submap], bytes]) -> "Future[Answer]":
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
        for name in submaps:
            self.sent.pop(name, None)
            self.sent[name] = None
        while len(self.sent) > SUBMAPS_KEPT:
            del self.sent[next(iter(self.sent))]
        self.pending.append(future)
        return future

    def lost(self, names: Sequence[bytes]) -> None:
        """It has these submaps no more."""
        for name in names:
            self.sent.pop(name, None)


Answer = bytes | list[bytes]
"""Alignments of a batch, as ``_aligned_bytes`` writes them; or the hashes of submaps that the process does not have."""

_kept: dict[bytes, Submap] = {}
"""Submaps of a process that takes batches, by the hash of their content. Newest last."""
_keeping: Final = threading.Lock()
"""Held while ``_kept`` changes: a worker of a cluster may have several threads."""


def align_batch(names: Sequence[bytes], new: Mapping[bytes, bytes], rows: bytes) -> Answer:
    """The alignments of a batch, in another process.

    Args:
        names: hashes of the submaps that the batch compares.
        new: those that the process was not sent yet, by their hashes.
        rows: float64, shape (N, 14): the numbers of both submaps in ``names``, the guess and its prior, of each pair.
    """
    with _keeping:
        for name, data in new.items():
            _kept[name] = read_submap(data)
        missing = [name for name in names if name not in _kept]
        if missing:
            return missing
        submaps = []
        for name in names:
            submaps.append(_kept.pop(name))
            _kept[name] = submaps[-1]
        while len(_kept) > SUBMAPS_KEPT:
            del _kept[next(iter(_kept))]
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
