"""Closures are verified by the chosen processes, which live as long as a block.

The choice is a text: the number of processes, this one included, or the address of a Dask scheduler, tcp://HOST:PORT or
tls://HOST:PORT.
"""

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Final

from fcslam.errors import InputError
from fcslam.lidar.pair_verification import VerificationPool, VerifyPairs, verify_here
from fcslam.processes import worker_pool

MOST_PROCESSES: Final = 256
_CLUSTER: Final = re.compile(r"(tcp|tls)://[^/\s]+:\d{1,5}")


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
            from fcslam.cluster.dask_cluster import DaskCluster

            cluster = stack.enter_context(DaskCluster(workers, must_connect))
            yield VerificationPool(cluster.executors)
        elif (others := int(workers) - 1) > 0:
            pools = [stack.enter_context(worker_pool()) for _ in range(others)]
            yield VerificationPool(lambda: pools)
        else:
            yield verify_here
