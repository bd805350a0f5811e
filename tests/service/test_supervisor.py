"""The supervisor outlives its workers, however they end and whatever they say."""

import sys
import threading
import time

import pytest

from fcslam.processes import Child
from fcslam.service.supervisor import Supervisor
from tests.waiting import wait_for

pytestmark = pytest.mark.slow

SAYS = 'import sys; print(\'{"event": "live", "content": 7}\', flush=True);'
STAYS = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
"""As a worker that is ready."""
WAITS = (
    "import time, pathlib; go = pathlib.Path(sys.argv[1], 'go');"
    "[time.sleep(0.02 * (not go.exists())) for _ in range(6000)];"
)
"""For the file ``go``, at most 120 s."""


@pytest.fixture
def supervised(tmp_path):
    """Starts a supervisor over workers that run the given code."""
    started = []

    def start(code, command=None):
        told = []
        chosen = command or (sys.executable, "-c", code, str(tmp_path))
        supervisor = Supervisor("a test", lambda: Child(chosen), lambda *event: told.append(event), 0.01)
        started.append(supervisor)
        return supervisor, told

    yield start
    for supervisor in started:
        supervisor.stop()


def test_rings_to_workers_that_die_do_not_keep_the_next_one_from_starting(supervised):
    supervisor, told = supervised(SAYS + "import os; os.close(0); print(flush=True); os._exit(3)")

    def rung():
        supervisor.notify()
        return supervisor.starts >= 4

    wait_for(rung)
    assert told[:2] == [("live", 7)] * 2


def test_rings_that_are_not_read_keep_nobody_waiting(supervised, tmp_path):
    supervisor, told = supervised(SAYS + WAITS + "sys.stdin.buffer.read(1);" + SAYS + "sys.stdin.buffer.read()")
    wait_for(lambda: told)
    for _ in range(100_000):
        supervisor.notify()
    assert len(told) == 1, "it reads nothing yet"
    (tmp_path / "go").touch()
    wait_for(lambda: len(told) == 2)


def test_what_nobody_understands_is_left_out(supervised):
    supervisor, told = supervised("print('oh'); print('[1]'); print('{}');" + SAYS + "sys.stdin.read()")
    wait_for(lambda: told)
    assert (told, supervisor.starts) == ([("live", 7)], 1)


def test_a_worker_that_cannot_be_started_is_tried_again(supervised, tmp_path):
    command = tmp_path / "worker"
    _, told = supervised("", (str(command),))
    time.sleep(0.05)
    command.write_text('#!/bin/sh\necho \'{"event": "live", "content": 7}\'\n')
    command.chmod(0o755)
    wait_for(lambda: told)


def test_a_ring_while_a_worker_ends_or_after_it_is_not_heard(supervised, tmp_path):
    supervisor, told = supervised(STAYS + SAYS + "sys.stdin.buffer.read();" + SAYS + WAITS)
    wait_for(lambda: told)
    stopping = threading.Thread(target=supervisor.stop)
    stopping.start()
    wait_for(lambda: len(told) == 2)
    supervisor.notify()
    (tmp_path / "go").touch()
    stopping.join()
    supervisor.notify()
    assert supervisor.pid is None


def test_a_worker_is_ready_when_it_says_so_and_no_longer_when_it_is_gone(supervised, tmp_path):
    ready = 'print(\'{"event": "progress", "content": 12}\\n{"event": "ready", "content": null}\', flush=True);'
    supervisor, told = supervised(SAYS + WAITS + ready + "sys.stdin.buffer.read()")
    wait_for(lambda: told)
    assert not supervisor.is_ready
    (tmp_path / "go").touch()
    wait_for(lambda: supervisor.is_ready)
    assert told == [("live", 7)], "that is for nobody else"
    assert supervisor.applied == 12
    supervisor.stop()
    assert not supervisor.is_ready


def test_a_worker_that_is_not_ready_keeps_nobody_waiting(supervised):
    supervisor, told = supervised(SAYS + "import time; time.sleep(1000)")
    wait_for(lambda: told)
    supervisor.stop()
    assert (supervisor.pid, supervisor.starts) == (None, 1)
