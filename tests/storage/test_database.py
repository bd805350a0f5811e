"""Nobody who reads waits for the disk, and those who write wait for it together."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from fcslam.errors import StoreError
from fcslam.storage.database import Database

SCHEMA = "CREATE TABLE numbers (number INTEGER NOT NULL) STRICT"
NUMBERS = "SELECT number FROM numbers ORDER BY number"


@pytest.fixture
def database(tmp_path):
    database = Database(tmp_path / "numbers.sqlite", SCHEMA, 1)
    yield database
    database.close()


def insert(number):
    return lambda connection: connection.execute("INSERT INTO numbers VALUES (?)", (number,)).rowcount


def written_while_another_writes(database, numbers):
    """Results of writers that all come while another one is at work, and the number of their transactions."""
    begun = []
    database._connection.set_trace_callback(lambda text: begun.append(text) if text.startswith("BEGIN") else None)
    with ThreadPoolExecutor(len(numbers)) as pool:
        with database.transaction() as connection:
            insert(0)(connection)
            futures = [pool.submit(database.share, insert(number)) for number in numbers]
            until = time.monotonic() + 120.0
            while len(database._waiting) < len(numbers):
                assert time.monotonic() < until
                time.sleep(0.001)
        outcomes = [future.exception() or future.result() for future in futures]
    return outcomes, len(begun) - 1


def test_a_reader_does_not_wait_for_a_writer_and_sees_what_was_there_before(database):
    database.share(insert(1))
    with database.transaction() as connection:
        insert(2)(connection)
        assert database.rows(NUMBERS) == [(1,)]
    assert database.rows(NUMBERS) == [(1,), (2,)]


def test_writers_that_wait_together_share_one_transaction(database):
    outcomes, transactions = written_while_another_writes(database, range(1, 9))
    assert (outcomes, transactions) == ([1] * 8, 1)
    assert database.rows(NUMBERS) == [(number,) for number in range(9)]


def test_of_writers_that_share_a_transaction_all_succeed_or_none(database):
    outcomes, transactions = written_while_another_writes(database, [1, None, 2])
    assert [type(outcome) for outcome in outcomes] == [StoreError] * 3
    assert transactions == 1
    assert database.rows(NUMBERS) == [(0,)]
    assert database.share(insert(3)) == 1, "the next one is not held up by it"


def test_many_writers_at_once_leave_what_each_of_them_wrote(database):
    barrier = threading.Barrier(8)

    def write(thread):
        barrier.wait()
        return sum(database.share(insert(100 * thread + k)) for k in range(20))

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(write, range(8))) == [20] * 8
    assert database.rows(NUMBERS) == [(100 * thread + k,) for thread in range(8) for k in range(20)]
