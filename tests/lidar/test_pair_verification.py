"""Pairs verified on an executor give what they give here, whatever the order in which batches are complete."""

import os
import pickle
import signal
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context

import numpy as np
import pytest

from fcslam.cloud.fleet import Fleet
from fcslam.cloud.settings import FleetConfig
from fcslam.geometry import se2
from fcslam.lidar.pair_verification import AHEAD, Pair, VerificationPool, verify_here
from fcslam.lidar.scan import point_scan
from fcslam.lidar.submap import build_submap
from fcslam.lidar.verification import Gate
from tests import small_fleet
from tests.small_fleet import fingerprint, in_order

pytestmark = pytest.mark.slow


class Failing(Executor):
    """Fails in a way of its own."""

    def __init__(self, fails):
        self.fails = fails
        self.asked = 0

    def submit(self, function, *arguments):
        self.asked += 1
        return self.fails(function, arguments)


@pytest.fixture(scope="module")
def packets():
    return in_order(packet for robot in small_fleet.draw(2).robots for packet in small_fleet.sent_by(robot))


def pairs_of(every, rows_of):
    """Pairs of submaps along one drive; ``rows_of`` their count gives the numbers of each pair and how far its guess
    is off."""
    rng = np.random.default_rng(4)
    (robot,) = small_fleet.draw(1, path_length_m=12.0).robots
    kept = list(robot.scans())[::every]
    poses = small_fleet.truth_at(robot, [scan.stamp for scan in kept])
    submaps = [build_submap([(point_scan(scan.ranges_m, scan.laser), np.zeros(3))]) for scan in kept]
    return [
        Pair(submaps[a], submaps[b], se2.between(poses[a], poses[b]) + rng.normal(0.0, (off, off, 0.1 * off)))
        for a, b, off in rows_of(len(kept))
    ]


@pytest.fixture(scope="module")
def pairs():
    """At guesses that are right, slightly off and wrong."""
    return pairs_of(4, lambda count: [(a, a + 1, off) for a in range(count - 1) for off in (0.02, 0.2, 3.0)])


@pytest.fixture
def pool():
    """Makes pools with small batches."""
    with ExitStack() as stack:

        def make(workers):
            executors = [stack.enter_context(ThreadPoolExecutor(1)) for _ in range(workers)]
            return VerificationPool(lambda: executors, batch=2)

        yield make


def written(checks):
    return [
        (check.T_a_b.tobytes(), check.information.tobytes(), check.strict, check.loose, check.partial, check.reason)
        for check in checks
    ]


@pytest.mark.parametrize("workers", [1, 2, 3, 20])
def test_a_pool_finds_what_is_found_here(pairs, workers, pool):
    """The limits are such that the noise of the submaps, which its processes do not know, decides some pairs."""
    asked = []
    loose = Gate(explained=0.2, violation=0.02, count=10, overlap=0.25)
    noisy = [pair._replace(noise=lambda: asked.append(1) or 0.5, predicted=True, loose=loose) for pair in pairs]
    expected = written(verify_here(noisy))
    assert 0 < len(asked) < len(pairs)
    verify = pool(workers)
    for _ in range(2):
        found = verify(noisy)
        assert written(found) == expected
    assert len({check.loose for check in found}) == 2, "pairs of both kinds"


def test_a_submap_is_sent_once_however_often_it_is_built(pairs):
    sent = []

    def run(function, arguments):
        sent.extend(arguments[1])
        done = Future()
        done.set_result(function(*arguments))
        return done

    executor = Failing(run)
    verify = VerificationPool(lambda: [executor], batch=2)
    for _ in range(3):
        rebuilt = [pair._replace(a=pickle.loads(pickle.dumps(pair.a))) for pair in pairs]
        verify(rebuilt)
    assert 0 < len(sent) == len(set(sent))


def gone(*_):
    raise BrokenExecutor("it is gone")


def ending(end):
    """An executor whose futures end so; ``end`` is given the future and the batch."""

    def submit(_function, arguments):
        end(future := Future(), arguments[0])
        return future

    return submit


dies = ending(lambda future, _: future.set_exception(ConnectionError("it died")))
is_cancelled = ending(lambda future, _: future.cancel())
stays_away = ending(lambda *_: None)
forgets = ending(lambda future, batch: future.set_result(list(batch)))


@pytest.mark.parametrize("fails", [gone, dies, is_cancelled, stays_away, forgets])
def test_what_a_process_does_not_do_is_done_by_others(pairs, fails, caplog):
    failing = Failing(fails)
    expected = written(verify_here(pairs))
    with ThreadPoolExecutor(1) as works:
        verify = VerificationPool(lambda: [failing, works], batch=2, patience_s=0.05)
        for _ in range(3):
            assert written(verify(pairs)) == expected
    assert failing.asked
    if fails is not forgets:
        assert failing.asked <= AHEAD + 1, "it rests, or still has what it was given"
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == (fails is gone)


def test_an_error_of_the_pairs_is_that_of_this_process(pairs, pool):
    broken = [pair._replace(T_a_b_guess=np.zeros(1)) for pair in pairs]
    with pytest.raises((IndexError, ValueError, TypeError)) as here:
        verify_here(broken)
    with pytest.raises(here.type):
        pool(2)(broken)


def test_a_fleet_with_a_pool_is_the_same(packets, pool):
    results = []
    for options in ({}, {"verify_pairs": pool(3)}):
        fleet = Fleet(FleetConfig(), 0, **options)
        for packet in packets:
            fleet.apply(packet)
        results.append(fingerprint(fleet.conclude()))
    assert results[0] == results[1]


def test_processes_find_what_is_found_here(pairs):
    """One of them is killed."""
    with ProcessPoolExecutor(1, get_context("spawn")) as one, ProcessPoolExecutor(1, get_context("spawn")) as two:
        found = VerificationPool(lambda: [one, two], batch=2)
        killed = one.submit(os.getpid).result()
        two.submit(os.getpid).result()
        for batch in (pairs, pairs[::-1], pairs[3:9], pairs):
            assert written(found(batch)) == written(verify_here(batch))
            if len(batch) < len(pairs):
                os.kill(killed, signal.SIGKILL)
