"""Pairs verified on an executor give what they give here, whatever the order in which batches are complete."""

import pickle
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from fcslam.cloud.fleet import Fleet
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.lidar.pair_verification import Pair, VerificationPool, verify_here
from fcslam.lidar.scan import point_scan
from fcslam.lidar.submap import build_submap
from fcslam.lidar.verification import VerificationConfig
from tests import small_fleet
from tests.small_fleet import fingerprint, in_order


class LastFirst(Executor):
    """Runs its tasks in reverse, and only when the first result is asked for; arguments pass as between processes."""

    def __init__(self):
        self.tasks = []

    def submit(self, function, *arguments):
        future = Future()
        future.result = lambda: self._run(future)
        self.tasks.append((future, pickle.dumps((function, arguments))))
        return future

    def _run(self, wanted):
        while self.tasks:
            future, data = self.tasks.pop()
            function, arguments = pickle.loads(data)
            future.set_result(pickle.loads(pickle.dumps(function(*arguments))))
        return Future.result(wanted)


@pytest.fixture(scope="module")
def packets():
    return in_order(packet for robot in small_fleet.draw(2).robots for packet in small_fleet.sent_by(robot))


@pytest.fixture(scope="module")
def pairs():
    """Submaps along one drive, at guesses that are right, slightly off and wrong."""
    rng = np.random.default_rng(4)
    (robot,) = small_fleet.draw(1, path_length_m=12.0).robots
    kept = list(robot.scans())[::4]
    poses = small_fleet.truth_at(robot, [scan.stamp for scan in kept])
    submaps = [build_submap([(point_scan(scan.ranges_m, scan.laser), np.zeros(3))]) for scan in kept]
    rows = [(a, a + 1, off) for a in range(len(kept) - 1) for off in (0.02, 0.2, 3.0)]
    return [
        Pair(submaps[a], submaps[b], se2.between(poses[a], poses[b]) + rng.normal(0.0, (off, off, 0.1 * off)))
        for a, b, off in rows
    ]


def pool(workers, submaps_kept=3):
    """Executors whose processes soon drop a submap."""
    return VerificationPool([LastFirst() for _ in range(workers)], submaps_kept)


def written(checks):
    return [
        (check.T_a_b.tobytes(), check.information.tobytes(), check.strict, check.loose, check.partial, check.reason)
        for check in checks
    ]


@pytest.mark.parametrize("workers", [1, 2, 3, 20])
def test_a_pool_finds_what_is_found_here(pairs, workers):
    """The limits are such that the noise of the submaps, which its processes do not know, decides some pairs."""
    asked = []
    noisy = [pair._replace(noise=lambda: asked.append(1) or 0.5) for pair in pairs]
    config = VerificationConfig(strict={"violation": 0.02, "explained": 0.2, "count": 10})
    expected = written(verify_here(noisy, config))
    assert 0 < len(asked) < len(pairs)
    verify = pool(workers)
    for _ in range(2):
        found = verify(noisy, config)
        assert written(found) == expected
    assert len({check.strict for check in found}) == 2, "pairs of both kinds"


def test_no_pairs_need_no_batch():
    executor = LastFirst()
    assert VerificationPool([executor], 2)([], VerificationConfig()) == []
    assert not executor.tasks


def test_a_fleet_with_a_pool_is_the_same(packets):
    results = []
    for options in ({}, {"verify_pairs": pool(3)}):
        fleet = Fleet(FleetConfig(), 0, **options)
        for packet in packets:
            fleet.apply(packet)
        results.append(fingerprint(fleet.conclude()))
    assert results[0] == results[1]


@pytest.mark.slow
def test_processes_find_what_is_found_here(pairs):
    config = VerificationConfig()
    with ProcessPoolExecutor(1, get_context("spawn")) as one, ProcessPoolExecutor(1, get_context("spawn")) as two:
        found = VerificationPool([one, two], 4)
        for batch in (pairs, pairs[::-1], pairs[3:9]):
            assert written(found(batch, config)) == written(verify_here(batch, config))
