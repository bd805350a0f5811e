"""Pictures with a GL library: they show what stands where it stands, and are worth looking for features in."""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from fcslam.lab.simulation.decoration import WallPicture, decorate, light_of
from fcslam.lab.simulation.engine import mujoco
from fcslam.lab.simulation.floorplan import draw_floor_plan
from fcslam.lab.simulation.noise import LidarSettings
from fcslam.lab.simulation.options import Building, Lighting
from fcslam.lab.simulation.scene import furnished_model
from fcslam.lab.simulation.sensors import Camera
from fcslam.lab.simulation.simulated_fleet import CameraSettings, SimulationSettings, simulate_fleet
from fcslam.records import CameraImage, LaserScan
from tests.lab.simulation.driving import drive, route
from tests.lab.simulation.gl import require_gl

pytestmark = pytest.mark.system

SMALL = SimulationSettings(
    building=Building.FLAT, robots=2, path_length_m=5.0, lidar=LidarSettings(beams=60, rate_hz=4.0),
    camera=CameraSettings(rate_hz=2.0),
)  # fmt: skip
CAMERA = CameraSettings().model()
FOV_Y_RAD = 2.0 * math.atan(0.5 * CAMERA.height / CAMERA.fy)
RED = np.full((16, 16, 3), (255, 0, 0), dtype=np.uint8)


@pytest.fixture(scope="module", autouse=True)
def gl():
    require_gl()


@pytest.fixture(scope="module")
def flat():
    rng = np.random.default_rng(1)
    plan = draw_floor_plan(rng, Building.FLAT)
    _, poses = drive(route(plan, 40.0, rng), 5.0)
    return plan, decorate(plan, rng), poses


def photographs(plan, decoration, poses, lighting=Lighting.DAY):
    light = light_of(plan, lighting, np.random.default_rng(0))
    model = furnished_model(plan, decoration, light, (CAMERA.width, CAMERA.height), FOV_Y_RAD)
    with Camera(model, CAMERA, light) as camera:
        return [camera.take(pose) for pose in poses]


@pytest.mark.parametrize(
    ("target", "pose"),
    [
        ((2.5, 0.0, 0.6), (3.0, 4.0, 0.0)),
        ((2.5, 0.6, 1.3), (8.0, -2.0, 2.2)),
        ((3.5, -1.0, 0.4), (-1.0, 0.5, -1.1)),
        ((1.6, 0.5, 1.0), (8.0, -2.0, 2.2)),
    ],
)
def test_a_point_is_seen_where_the_intrinsics_and_the_mounting_say(flat, target, pose):
    """A small red plate in an empty place; ``target`` is its middle in the robot's base."""
    plan, decoration, _ = flat
    x, y, heading = pose
    ahead, left, up = target
    cos, sin = math.cos(heading), math.sin(heading)
    centre = (x + cos * ahead - sin * left, y + sin * ahead + cos * left, up)
    plate = WallPicture(RED, centre, (0.12, 0.12), heading + math.pi / 2.0)
    empty = replace(plan, pieces=(), rooms=())
    bare = replace(decoration, looks=(), heights_m=(), room_floors=(), pictures=(plate,))
    light = light_of(plan, Lighting.DAY, np.random.default_rng(0))
    model = furnished_model(empty, bare, light, (CAMERA.width, CAMERA.height), FOV_Y_RAD)
    with Camera(model, CAMERA, light) as camera:
        image = camera.take(np.array(pose)).astype(int)
    rows, columns = np.nonzero((image[..., 0] > 60) & (image[..., 1] < 40) & (image[..., 2] < 40))
    tx, _, tz = CAMERA.T_base_camera.translation_m
    depth = ahead - tx - 0.008
    assert len(rows) > 20
    assert columns.mean() == pytest.approx(CAMERA.cx - CAMERA.fx * left / depth, abs=0.7)
    assert rows.mean() == pytest.approx(CAMERA.cy - CAMERA.fy * (up - tz) / depth, abs=0.7)


@pytest.fixture(scope="module")
def by_day(flat):
    return photographs(*flat)


def test_pictures_have_features_to_find(by_day):
    detector = cv2.ORB_create(500)
    assert np.median([len(detector.detect(image)) for image in by_day]) > 80


def test_pictures_of_one_place_are_alike_and_of_others_not(flat, by_day):
    np.testing.assert_array_equal(photographs(*flat), by_day)
    assert np.abs(np.diff(np.array(by_day, dtype=float), axis=0)).mean() > 5.0


def test_lighting_changes_pictures(flat, by_day):
    evening, failed = (np.mean(photographs(*flat, lighting)) for lighting in (Lighting.EVENING, Lighting.LAMP_OFF))
    assert evening < 0.8 * np.mean(by_day)
    assert failed < np.mean(by_day)


def test_a_recording_holds_images_in_order_and_the_scans_of_a_blind_fleet():
    seeing, blind = simulate_fleet(SMALL, 1), simulate_fleet(SMALL.model_copy(update={"camera": None}), 1)
    items = list(seeing.robots[0].records())
    stamps = [item.stamp for item in items]
    assert stamps == sorted(stamps)
    images = [item for item in items if isinstance(item, CameraImage)]
    np.testing.assert_array_equal([image.stamp for image in images], seeing.robots[0].image_stamps)
    assert cv2.imdecode(np.frombuffer(images[0].encoded, np.uint8), cv2.IMREAD_COLOR).shape == (240, 320, 3)
    scans = [item.ranges_m for item in items if isinstance(item, LaserScan)]
    alone = [item.ranges_m for item in blind.robots[0].records() if isinstance(item, LaserScan)]
    np.testing.assert_array_equal(scans, alone)


def test_an_images_odometry_lies_between_that_of_the_scans_around_it():
    robot = simulate_fleet(SMALL, 1).robots[1]
    for image in (item for item in robot.records() if isinstance(item, CameraImage)):
        after = int(np.searchsorted(robot.stamps, image.stamp))
        before, next_one = robot.T_odom_base[after - 1 : after + 1]
        low, high = np.minimum(before, next_one)[:2] - 1e-3, np.maximum(before, next_one)[:2] + 1e-3
        assert np.all((image.T_odom_base[:2] >= low) & (image.T_odom_base[:2] <= high))


def test_robots_draw_one_after_the_other(monkeypatch):
    """Mesa's software renderer crashes, now and then, where two threads draw at once."""
    module, render, inside, most = mujoco(), mujoco().mjr_render, [], []

    def watched(*arguments):
        inside.append(1)
        most.append(len(inside))
        time.sleep(0.002)
        render(*arguments)
        inside.pop()

    monkeypatch.setattr(module, "mjr_render", watched)
    fleet = simulate_fleet(SimulationSettings(path_length_m=2.0), 1)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda robot: [None for _ in robot.records()], fleet.robots))
    assert len(most) > 20
    assert max(most) == 1
