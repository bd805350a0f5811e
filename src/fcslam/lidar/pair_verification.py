"""Verification of many pairs of submaps: here, or in batches on an executor. The results are the same."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import NamedTuple

from fcslam.lidar.submap import Submap
from fcslam.lidar.verification import NO_PRIOR, Verification, VerificationConfig, no_noise, verify
from fcslam.records import FloatArray


class Pair(NamedTuple):
    """Two submaps that may show the same place; the fields are those of ``verify``."""

    a: Submap
    b: Submap
    T_a_b_guess: FloatArray
    prior: FloatArray = NO_PRIOR
    noise: Callable[[], float] = no_noise
    """Stays in this process: it is asked for rarely, and needs the scans."""


VerifyPairs = Callable[[Sequence[Pair], VerificationConfig], list[Verification]]
"""Verifies pairs and returns the results in their order."""


def verify_here(pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
    """Verify the pairs one after another in this process."""
    return [verify(a, b, guess, config, prior, noise) for a, b, guess, prior, noise in pairs]


class VerificationPool:
    """Verifies pairs on an executor, such as a pool of processes. It has the signature ``VerifyPairs``."""

    def __init__(self, executor: Executor, workers: int) -> None:
        """``workers``: into how many batches the pairs are divided. The caller shuts the executor down."""
        self._executor, self._workers = executor, workers

    def __call__(self, pairs: Sequence[Pair], config: VerificationConfig) -> list[Verification]:
        """Results in the order of the pairs, whichever batch is complete first."""
        size = max(1, -(-len(pairs) // self._workers))
        batches = [[pair[:4] for pair in pairs[begin : begin + size]] for begin in range(0, len(pairs), size)]
        running = [self._executor.submit(_verify_batch, batch, config) for batch in batches]
        checks = [check for batch in running for check in batch.result()]
        return [
            verify_here([pair], config)[0] if check is None else check
            for pair, check in zip(pairs, checks, strict=True)
        ]


class _NoiseNeededError(Exception):
    """The noise of the submaps decides."""


def _no_scans() -> float:
    raise _NoiseNeededError


def _verify_batch(
    batch: Sequence[tuple[Submap, Submap, FloatArray, FloatArray]], config: VerificationConfig
) -> list[Verification | None]:
    """The results of a batch in another process; None where the noise decides."""
    results: list[Verification | None] = []
    for a, b, guess, prior in batch:
        try:
            results.append(verify(a, b, guess, config, prior, _no_scans))
        except _NoiseNeededError:
            results.append(None)
    return results
