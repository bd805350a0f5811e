"""After the warm-ups nothing is left to be compiled, whatever robots see and send, even if they are lost."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fcslam.wire.packets import encode

COMPILED = """
import gc, json, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher

def compiled():
    return {
        f"{value.py_func.__module__}.{value.py_func.__name__}": set(map(str, value.signatures))
        for name, module in list(sys.modules.items()) if name.startswith("fcslam.")
        for value in vars(module).values() if isinstance(value, Dispatcher)
    }

"""
"""The signatures of every function that is compiled, by its name."""

SCRIPT = """
import numpy as np
from fcslam.mission.driving import one_by_one
from fcslam.places.vocabulary import VocabularyConfig
from fcslam.robot.backend import OwnPlaces
from fcslam.robot.frontend import RobotConfig
from fcslam.warmup import WARM_UPS, is_cold, warm_up_decoding, warm_up_fleet
from fcslam.sources import open_source

def news(before):
    return {name: sorted(kinds - before.get(name, set())) for name, kinds in compiled().items()
            if kinds - before.get(name, set())}

from fcslam.cloud.cloud import Cloud

from fcslam.cloud.settings import FleetConfig
from fcslam.cloud.report import keyscan_track, run_of
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.wire.packets import decode

stream = [bytes.fromhex(data) for data in json.loads(Path(sys.argv[1]).read_text())]
cold = compiled()
warm_up_decoding()
decoding = compiled()
for data in stream:
    decode(data)
of_decoding = news(decoding)
warm_up_fleet()
warm = compiled()
cloud = Cloud(FleetConfig(), seed=1)
for data in stream:
    cloud.receive(data)
result = cloud.finalize()
tracks = {robot.robot: keyscan_track(robot) for robot in result.robots}
run_of(result, tracks, (), "", OccupancyConfig(), with_local_maps=False)
between = sum(c.i.robot != c.j.robot for c in result.closures)
of_fleet = news(warm)
for run in WARM_UPS:
    run()
hot = compiled()
places = OwnPlaces(VocabularyConfig(train_batch=2))
for k in range(4):
    places.store(k, np.zeros((0, 2)))
places.most_similar(3, range(3), 1)
places.forget(0)  # as after many visits of one place
with one_by_one([open_source(path) for path in sys.argv[2:]], RobotConfig()) as robots:
    legs = sum(len(list(robot)) for robot in robots)
print(json.dumps([sum(map(len, cold.values())), sum(map(len, warm.values())), sum(map(len, hot.values())),
                  is_cold(), of_decoding, of_fleet, news(hot), between, legs]))
"""


@pytest.mark.slow
def test_after_the_warm_ups_fleet_and_robots_find_all_their_code_compiled(tmp_path, packets, logs):
    stream = tmp_path / "stream.json"
    stream.write_text(json.dumps([encode(packet).hex() for packet in packets]))
    done = subprocess.run(
        [sys.executable, "-c", COMPILED + SCRIPT, stream, *logs], capture_output=True, text=True, check=True
    )
    cold, warm, hot, is_cold, of_decoding, of_fleet, of_robots, between, legs = json.loads(done.stdout)
    assert cold < warm < hot, "the warm-ups compile something"
    assert not is_cold
    assert between > 0, "the fleet gives the matcher and the verification something to do"
    assert legs > 3
    assert (of_decoding, of_fleet, of_robots) == ({}, {}, {})


TRACKING = """
from fcslam.records import Channel
from fcslam.robot.backend_runner import in_worker
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.warmup import warm_up_tracking
from tests.robot.kidnapping import kidnapping
from tests.robot.test_backend_runner import Held

config, executor = RobotConfig(channels=(Channel.LIDAR,)), Held()
robot = RobotFrontend("r", config, in_worker("r", config, executor))
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
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", COMPILED + TRACKING], cwd=root, capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == [True, True, 2, True]


SPACE = """
from fcslam.lidar3d.voxel_matching import prepared
from fcslam.records import VoxelMap
from fcslam.robot.backend import SessionConfig
from fcslam.robot.frontend3d import RobotFrontend3d
from fcslam.warmup import warm_up_space
from tests.spinning_lidar import circle, drive, room

warm_up_space()
warm = compiled()
robot, scans = RobotFrontend3d("r", SessionConfig()), drive(room(1), circle((6.0, 4.0), 1.6, 0.8), 90, azimuths=120)
bodies = [packet.body for scan, _ in scans for packet in robot.process(scan)]
maps = [prepared(body) for body in bodies if isinstance(body, VoxelMap)]
print(json.dumps([len(maps) > 0, all(each.free.any() for each in maps), warm == compiled()]))
"""


@pytest.mark.slow
def test_after_the_warm_up_a_robot_in_space_and_its_fleet_find_all_their_code_compiled():
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", COMPILED + SPACE], cwd=root, capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == [True, True, True]
