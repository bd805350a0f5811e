"""Robots side by side in processes: the same run as one by one, and errors arrive."""

import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fcslam.errors import FcslamError, SourceError
from fcslam.mission import driving
from fcslam.mission.driving import one_by_one, side_by_side
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.records import Keyscan
from fcslam.robot.frontend import RobotConfig
from fcslam.sources import open_source
from fcslam.sources.faults import Fault, Faults
from tests.small_fleet import contents
from tests.waiting import wait_for
from tests.wire.examples import same

pytestmark = pytest.mark.slow


class Broken:
    """A recording that ends its reader."""

    faults = Faults({})

    def __init__(self, name, end):
        self.name, self._end = name, end

    def records(self):
        self._end()
        yield


def refuse():
    raise SourceError("robot.clf: cut off; copy it again")


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def test_processes_change_no_byte_of_a_run_and_faults_arrive(logs, tmp_path):
    damaged = tmp_path / "damaged.clf"
    damaged.write_bytes(logs[0].read_bytes() + b"FLASER 3 1 2\n")
    recordings, seen = [damaged, *logs[1:]], []
    alone = run_mission([open_source(log) for log in recordings], MissionConfig())
    together = run_mission(
        [open_source(log) for log in recordings], MissionConfig(), seen.append, drive=side_by_side(2)
    )
    assert seen[-1].faults["damaged"][Fault.BROKEN_LINE].count == 1
    assert not seen[-1].faults["robot_2"]
    for name, run in (("alone", alone), ("together", together)):
        run.save(tmp_path / name)
    assert len(contents(tmp_path / "alone")) > 10
    assert contents(tmp_path / "together") == contents(tmp_path / "alone")


def test_legs_are_the_same_and_their_arrays_read_only(logs):
    with one_by_one([open_source(logs[0])], RobotConfig()) as (here,):
        expected = list(here)
    with side_by_side(5)([open_source(log) for log in logs[:2]], RobotConfig()) as (there, _):
        legs = list(there)
    sent, wanted = ([sized.packet for leg in found for sized in leg.packets] for found in (legs, expected))
    assert all(same(one, other) for one, other in zip(sent, wanted, strict=True))
    assert not any(packet.body.ranges_m.flags.writeable for packet in sent if isinstance(packet.body, Keyscan))
    assert legs[-1].faults == expected[-1].faults


def test_the_back_end_of_a_single_robot_runs_beside_it_and_changes_no_packet(logs, monkeypatch):
    monkeypatch.setattr(driving, "MOST_WAITING", 3)  # so that the robot waits
    source = open_source(logs[0])
    with one_by_one([source], RobotConfig()) as (here,):
        expected = list(here)
    with side_by_side(2)([source], RobotConfig()) as (there,):
        legs = [next(there)]
        assert len(multiprocessing.active_children()) == 1
        legs += there
    assert not multiprocessing.active_children()
    sent, wanted = ([sized.data for leg in found for sized in leg.packets] for found in (legs, expected))
    assert sent == wanted
    assert legs[-1].faults == expected[-1].faults
    for session, track in expected[-1].tracks.items():
        np.testing.assert_array_equal(legs[-1].tracks[session].T_keyscan_base, track.T_keyscan_base)


def test_a_back_end_that_is_killed_ends_the_run(logs):
    with side_by_side(2)([open_source(logs[0])], RobotConfig()) as (legs,):
        next(legs)
        multiprocessing.active_children()[0].kill()
        with pytest.raises(FcslamError, match="the process of its back end failed"):
            list(legs)


def test_an_error_of_a_single_robot_is_raised_here():
    with side_by_side(4)([Broken("a", refuse)], RobotConfig()) as (legs,), pytest.raises(SourceError):
        next(legs)


@pytest.mark.parametrize(("end", "error", "text"), [(refuse, SourceError, "cut off"), (die, FcslamError, "code -9")])
def test_an_error_in_a_process_is_raised_here(end, error, text):
    sources = [Broken("a", end), Broken("b", end)]
    with side_by_side(2)(sources, RobotConfig()) as (legs, _), pytest.raises(error, match=text):
        next(legs)


def test_processes_end_with_the_one_that_started_them(tmp_path):
    """Even if that was killed."""
    script = (
        "import os, time\n"
        "from fcslam.mission.driving import side_by_side\n"
        "from fcslam.robot.frontend import RobotConfig\n"
        "from tests.mission.test_driving import Broken\n"
        "file = os.open(os.environ['PIDS'], os.O_CREAT | os.O_WRONLY | os.O_APPEND)\n"
        "def note(): os.write(file, f'{os.getpid()}\\n'.encode()); time.sleep(60)\n"
        "with side_by_side(2)([Broken('a', note), Broken('b', note)], RobotConfig()) as (legs, _): next(legs)\n"
    )
    pids = tmp_path / "pids"
    parent = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PIDS": str(pids)})
    wait_for(lambda: pids.exists() and len(pids.read_text().split()) == 2)
    parent.kill()
    parent.wait()
    wait_for(lambda: not any(is_running(int(pid)) for pid in pids.read_text().split()))


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
