"""Processes: a host without semaphores, such as a container without /dev/shm, gets one clear line; memory goes back."""

import errno
import subprocess
import sys
from multiprocessing import synchronize

import pytest

from fcslam.cluster.verifying import verifying
from fcslam.errors import InputError
from fcslam.mission.driving import side_by_side
from fcslam.robot.backend_runner import worker_process
from fcslam.robot.frontend import RobotConfig
from fcslam.sources import open_source


@pytest.fixture
def no_semaphores(monkeypatch):
    def refuse(*_args, **_kwargs):
        raise OSError(errno.EACCES, "refused")

    monkeypatch.setattr(synchronize.SemLock, "__init__", refuse)


def verify(_):
    with verifying("2"):
        pass


def drive(logs):
    with side_by_side(2)([open_source(log) for log in logs[:2]], RobotConfig()):
        pass


@pytest.mark.parametrize("start", [lambda _: worker_process(), verify, drive])
def test_more_than_one_process(no_semaphores, logs, start):
    with pytest.raises(InputError, match="/dev/shm: more than one process needs semaphores"):
        start(logs)


def test_a_single_robot_does_without(no_semaphores, logs):
    with side_by_side(2)([open_source(logs[0])], RobotConfig()) as (legs,):
        assert list(legs)[-1].tracks


FREEING = """
import resource
from fcslam.processes import keep_memory_trimmed, trim_memory

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()

if {kept}:
    keep_memory_trimmed()
bytearray(8_000_000)  # freed at once, it teaches the allocator to put such into a heap
arrays, kept = [], []
for _ in range(100):
    arrays.append(bytearray(b"x") * 1_000_000)
    kept.append(bytearray(b"x") * 5_000)
full = resident()
arrays.clear()
if {trimmed}:
    trim_memory()
print(full - resident())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_freed_memory_goes_back_although_some_between_it_is_in_use():
    def freed(kept, trimmed):
        command = [sys.executable, "-c", FREEING.format(kept=kept, trimmed=trimmed)]
        return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)

    assert freed(kept=False, trimmed=False) < 20e6, "what the allocator does by itself"
    assert freed(kept=True, trimmed=False) > 90e6
    assert freed(kept=False, trimmed=True) > 90e6
