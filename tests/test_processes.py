"""A host without semaphores for processes, such as a container without /dev/shm, gets one clear line."""

import errno
from multiprocessing import synchronize

import pytest

from fcslam.cluster.verifying import verifying
from fcslam.cluster.workers import Workers
from fcslam.errors import InputError
from fcslam.mission.driving import side_by_side
from fcslam.robot.backend_runner import worker_process
from fcslam.robot.frontend import RobotConfig
from fcslam.sources import Recording


def let_semaphores_fail(monkeypatch, number):
    def refuse(*_args, **_kwargs):
        raise OSError(number, "refused")

    monkeypatch.setattr(synchronize.SemLock, "__init__", refuse)


@pytest.fixture
def no_semaphores(monkeypatch):
    let_semaphores_fail(monkeypatch, errno.EACCES)


def verify():
    with verifying(Workers("2")):
        pass


def drive(tmp_path):
    with side_by_side(2)([Recording(tmp_path, name) for name in ("a", "b")], RobotConfig()):
        pass


@pytest.mark.parametrize("start", [worker_process, verify])
def test_workers(no_semaphores, start):
    with pytest.raises(InputError, match="/dev/shm: more than one process needs semaphores"):
        start()


def test_robots_side_by_side(no_semaphores, tmp_path):
    with pytest.raises(InputError, match="/dev/shm: more than one process needs semaphores"):
        drive(tmp_path)


def test_too_many_open_files_say_so(monkeypatch):
    let_semaphores_fail(monkeypatch, errno.EMFILE)
    with pytest.raises(OSError, match="refused"):
        worker_process()
