"""Who explores which frontier of the joint maps, as the service says it."""

import asyncio
import time
from types import SimpleNamespace

import httpx
import numpy as np
from fastapi import FastAPI

from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.service.http.joint_maps import joint_map_router
from fcslam.service.joint_maps import JointMaps, JointSession, ServedJointMaps, write_joint_maps
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.missions import OpenMission


def room(open_side):
    """A room of 4 m that is open on one side: -1 to the left, 0 to the right."""
    cells = np.full((42, 42), Occupancy.OCCUPIED, np.uint8)
    cells[1:-1, 1:-1] = Occupancy.FREE
    cells[1:-1, open_side] = Occupancy.FREE
    return OccupancyMap(cells, 0.1, (0.0, 0.0))


def session(robot, number):
    return JointSession(robot, 0, number, "", (2.0, 2.0, 0.0), 10.0, 1000.0)


A, B = room(-1), room(0)


def test_frontiers_follow_a_map_that_changes_its_number():
    served = ServedJointMaps()
    before = JointMaps([session("a", 0), session("b", 1)], {0: A, 1: B}, {0: "frame a", 1: "frame b"}, 0.2)
    first = served.explorations(before, 1000.0)
    assert first[0][2]["a"].point[0] > 3.5
    assert first[1][2]["b"].point[0] < 0.5
    after = JointMaps([session("b", 0), session("a", 1)], {0: B, 1: A}, {0: "frame b", 1: "frame a"}, 0.2)
    assert served.explorations(after, 1001.0) == {0: first[1], 1: first[0]}


def test_frontiers_of_a_frame_that_is_gone_are_not_served():
    served = ServedJointMaps()
    served.explorations(JointMaps([session("a", 0)], {0: A}, {0: "frame"}, 0.2), 1000.0)
    turned = JointMaps([session("a", 0)], {0: B}, {0: "another frame"}, 0.2)
    assert served.explorations(turned, 1001.0)[0][2]["a"].point[0] < 0.5


def test_frontiers_are_kept_for_some_seconds():
    served = ServedJointMaps()
    maps = JointMaps([session("a", 0)], {0: A}, {0: "frame"}, 0.2)
    first, second, later = (served.explorations(maps, now_s)[0] for now_s in (1000.0, 1004.0, 1100.0))
    assert first is second
    assert later is not first


def test_missions_that_are_asked_in_turn_keep_their_own_poses(tmp_path):
    missions = [OpenMission(MissionFolder(tmp_path / name), None, None, None, time.time) for name in "xy"]
    for mission in missions:
        mission.folder.path.mkdir()
        write_joint_maps(mission.joint_maps, JointMaps([session("a", 0)], {0: A}, {0: "frame"}, 0.2))
    state = SimpleNamespace(mission=missions[0], require=lambda *_: [])
    app = FastAPI()
    app.include_router(joint_map_router(state))

    def pose_of_a(robot, **own):
        async def exchange():
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost") as client:
                return await client.post(f"/robots/{robot}/fleet", json=own)

        (pose,) = (one["pose"] for one in asyncio.run(exchange()).json()["robots"])
        return pose

    assert pose_of_a("a", map=0, pose=(2.5, 2.0, 0.0)) == [2.5, 2.0, 0.0]
    state.mission = missions[1]
    assert pose_of_a("b") == [2.0, 2.0, 0.0]
    state.mission = missions[0]
    assert pose_of_a("b") == [2.5, 2.0, 0.0]
