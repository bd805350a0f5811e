"""Verification of many pairs of submaps: here, or in batches on an executor. The results are the same."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from typing import NamedTuple

from fcslam.lidar.submap import Submap
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
from fcslam.records import FloatArray


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


def verify_here(pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
    """Verify the pairs one after another in this process."""
    return [verify(a, b, guess, config, prior, noise) for a, b, guess, prior, noise in pairs]


class VerificationPool:
    """Aligns pairs in this process and on executors of one process each, and judges them here: a ``VerifyPairs``.

    A submap takes longer to send than to compare, so each process keeps those that it got.
    """

    def __init__(self, executors: Sequence[Executor], submaps_kept: int) -> None:
        """Start with no submap sent.

        Args:
            executors: each runs its tasks in one process, in their order. The caller shuts them down.
            submaps_kept: submaps in each process; the least recently used ones are dropped first.
        """
        self._processes = [_Process(executor, submaps_kept) for executor in executors]

    def __call__(self, pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
        """Results in the order of the pairs, whichever process is done first."""
        size = max(1, -(-len(pairs) // (1 + len(self._processes))))
        here, *there = (pairs[begin : begin + size] for begin in range(0, len(pairs) or 1, size))
        running = [process.submit(share, config) for process, share in zip(self._processes, there, strict=False)]
        return verify_here(here, config) + [
            judge(aligned, config, pair.noise)
            for share, batch in zip(there, running, strict=True)
            for pair, aligned in zip(share, batch.result(), strict=True)
        ]


class _Process:
    """Knows which submaps a process keeps."""

    def __init__(self, executor: Executor, submaps_kept: int) -> None:
        self._executor, self._submaps_kept = executor, submaps_kept
        self._sent: dict[int, tuple[int, Submap]] = {}
        """Name in the process, by identity; the reference keeps the identity from being used again. Newest last."""

    def submit(self, pairs: Sequence[Pair], config: VerificationConfig) -> "Future[list[Aligned]]":
        new: dict[int, Submap] = {}
        named = [(self._name(a, new), self._name(b, new), guess, prior) for a, b, guess, prior, _ in pairs]
        surplus = list(self._sent)[: max(0, len(self._sent) - self._submaps_kept)]
        dropped = [self._sent.pop(identity)[0] for identity in surplus]
        return self._executor.submit(_align_batch, new, named, dropped, config)

    def _name(self, submap: Submap, new: dict[int, Submap]) -> int:
        sent = self._sent.pop(id(submap), None)
        if sent is None:
            sent = next(_NAMES), submap
            new[sent[0]] = submap
        self._sent[id(submap)] = sent
        return sent[0]


_NAMES = itertools.count()
"""Names of submaps in other processes; each is used once."""
_kept: dict[int, Submap] = {}
"""Submaps of a process of the pool, by name."""


def _align_batch(
    new: Mapping[int, Submap],
    batch: Sequence[tuple[int, int, FloatArray, FloatArray]],
    dropped: Sequence[int],
    config: VerificationConfig,
) -> list[Aligned]:
    """The alignments of a batch in another process."""
    _kept.update(new)
    results = [align(_kept[a], _kept[b], guess, config, prior) for a, b, guess, prior in batch]
    for name in dropped:
        del _kept[name]
    return results
