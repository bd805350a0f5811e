"""After the warm-up, no pose waits for the compiler, not even that of a robot that is lost."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import gc, json, sys
from numba.core.dispatcher import Dispatcher
from fcslam.records import Channel
from fcslam.robot.backend_runner import WorkerBackend
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.robot.warmup import warm_up_tracking
from tests.robot.kidnapping import kidnapping
from tests.robot.test_backend_runner import Held

def compiled():
    return {
        f"{name}.{attribute}": sorted(map(str, value.signatures))
        for name, module in sys.modules.items() if name.startswith("fcslam.")
        for attribute, value in vars(module).items() if isinstance(value, Dispatcher)
    }

config, executor = RobotConfig(channels=(Channel.LIDAR,)), Held()
robot = RobotFrontend("r", config, WorkerBackend("r", config, executor))
executor.holds = True  # only the front end works
scans, _ = kidnapping()
cold = compiled()
warm_up_tracking(config)
warm = compiled()
for scan in scans:
    robot.process(scan)
print(json.dumps([cold != warm, gc.get_freeze_count() > 0, len(robot.tracks), warm == compiled()]))
"""


@pytest.mark.slow
def test_after_the_warm_up_a_robot_finds_all_its_code_compiled():
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", SCRIPT], cwd=root, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [True, True, 2, True]
