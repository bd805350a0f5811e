"""Closures are verified by the chosen processes, which live as long as a block."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from fcslam.cluster.workers import Workers
from fcslam.lidar.pair_verification import VerificationPool, VerifyPairs, verify_here
from fcslam.processes import obey_parent, worker_pool


@contextmanager
def verifying(workers: Workers, must_connect: bool = True) -> Iterator[VerifyPairs]:
    """Verify pairs on the chosen processes until the block ends. All of them give the same results.

    Args:
        workers: the processes.
        must_connect: whether a cluster must be there now; otherwise this process verifies until it is.

    Raises:
        InputError: the choice is not valid, the cluster is not there or refused, or the host gives processes no
            semaphores.
    """
    workers.check()
    with ExitStack() as stack:
        if workers.is_cluster:
            from fcslam.cluster.dask_cluster import DaskCluster

            cluster = stack.enter_context(DaskCluster(workers, must_connect))
            yield VerificationPool(cluster.executors)
        elif (others := int(workers.where) - 1) > 0:
            pools = [stack.enter_context(worker_pool(obey_parent)) for _ in range(others)]
            yield VerificationPool(lambda: pools)
        else:
            yield verify_here
