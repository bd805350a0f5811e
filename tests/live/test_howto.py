"""The programs of docs/howto/python.md run as they are printed."""

import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import fcslam
from tests import small_fleet
from tests.live.same_thread import SameThread
from tests.live.test_robot import CAMERA
from tests.robot.http_cloud import serving

ROOT = Path(__file__).parents[2]


def programs():
    text = (ROOT / "docs" / "howto" / "python.md").read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.fixture
def my_robot(monkeypatch):
    """The reader's own module."""
    recorded = list(small_fleet.draw(1, path_length_m=3.0).robots[0].scans())
    module = ModuleType("my_robot")
    module.laser = recorded[0].laser
    module.rear_laser = fcslam.LaserModel(*module.laser.beams, 12.0, (-0.2, 0.0, 0.0))
    module.camera = CAMERA
    module.scans = lambda: [(scan.ranges_m, scan.stamp, scan.T_odom_base) for scan in recorded]
    module.rear_scans = module.scans
    module.images = lambda: [np.zeros((48, 64, 3), np.uint8)] * len(recorded)
    monkeypatch.setitem(sys.modules, "my_robot", module)
    return module


@pytest.mark.slow
def test_the_programs_of_the_page_run(my_robot, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with serving() as cloud, fcslam.Robot("before", my_robot.laser) as my_robot.robot:
        my_robot.server = cloud.url
        for scan in my_robot.scans():
            my_robot.robot.add_scan(*scan)
        assert len(programs()) == 6
        for number, program in enumerate(programs()):
            if number == 1:  # the first one has shown that a program gets a process beside it
                monkeypatch.setattr("fcslam.live.records.worker_process", SameThread)
            exec(compile(program, f"program {number}", "exec"), {"__name__": "__main__"})
        assert cloud.cloud.stored
    assert capsys.readouterr().out.count("True") == len(my_robot.scans())
    assert fcslam.open_run("runs/anna").maps
