"""What a robot knows of its fleet: over real HTTP, from a service whose worker applies packets at once."""

from contextlib import closing

import numpy as np
import pytest

from fcslam.cloud.settings import CloudConfig, FleetConfig
from fcslam.errors import CloudError
from fcslam.live.fleet_view import FleetView
from fcslam.maps.joint_voxels import read_points
from fcslam.wire.fleet_client import FleetClient
from fcslam.wire.keys import Server
from fcslam.wire.packets import encode
from tests.cloud.space_fleet import sent
from tests.maps.test_joint_tiles import known_cells
from tests.service.http.desk import SCRIPT, A, B, Desk
from tests.waiting import wait_for


@pytest.fixture
def desk(tmp_path, scripted):
    scripted(SCRIPT)
    with Desk(tmp_path / "data") as desk:
        yield desk


def client(desk, robot):
    return FleetClient(Server(str(desk.client.base_url), f"token of {robot}"))


def view(desk, robot, pose=None, limit_kBps=None):
    return FleetView(client(desk, robot), robot, lambda: pose, limit_kBps, clock=lambda: 0.0)


def follow(fleet):
    for _ in range(100):
        before = fleet.version
        fleet.step()
        if fleet.version == before:
            return fleet
    raise AssertionError("it never ends")


def test_each_robot_of_a_map_gets_its_frontiers_and_the_page_those_of_all_maps(desk):
    desk.send("a", A)
    desk.send("b", B)
    with closing(view(desk, "a")) as fleet:
        follow(fleet)
    (of_all,) = desk.ask("GET", "/api/v1/frontiers", "eye").json()
    (of_a,) = desk.ask("GET", "/api/v1/frontiers?robot=a", "a").json()
    assert of_all["map"] == of_a["map"] == 0
    assert of_all["frontiers"]
    assert [(one.point, one.robots) for its in fleet.frontiers for one in its.frontiers] == [
        (tuple(one["point"]), tuple(one["robots"])) for one in of_a["frontiers"]
    ]
    for whole, part in zip(of_all["frontiers"], of_a["frontiers"], strict=True):
        assert set(part["distances"]) == set(whole["distances"]) & {"a"}
    assert {robot for one in of_all["frontiers"] for robot in one["robots"]} <= {"a", "b"}


def test_each_robot_knows_how_good_its_map_is(desk):
    desk.send("a", A)
    desk.send("b", B)
    with closing(view(desk, "a")) as fleet:
        follow(fleet)
    certificate = desk.ask("GET", "/api/v1/quality.json", "eye").json()["0"]
    (known,) = fleet.quality
    assert (known.map_index, known.error_95_m) == (0, certificate["error_95"])
    assert known.verdict == desk.ask("GET", "/api/v1/verdicts", "eye").json()[0]["sentence"]
    (of_all,) = desk.ask("GET", "/api/v1/quality", "eye").json()
    assert of_all == desk.ask("GET", "/api/v1/quality?robot=a", "a").json()[0]


@pytest.mark.parametrize("what", ["frontiers", "quality"])
def test_an_unknown_robot_has_no_map_and_reading_needs_a_token(desk, what):
    desk.send("a", A)
    assert desk.ask("GET", f"/api/v1/{what}?robot=nobody", "eye").json() == []
    assert desk.ask("GET", f"/api/v1/{what}?robot=no/body", "eye").status_code == 400
    assert desk.ask("GET", f"/api/v1/{what}").status_code == 401


def test_robots_in_one_map_have_the_same_joint_map_and_it_is_that_of_the_service(desk):
    desk.send("a", A)
    with closing(view(desk, "a")) as first:
        follow(first)
        alone = known_cells(first.joint_map)
        desk.send("b", B)
        with closing(view(desk, "b", limit_kBps=0.5)) as second:
            follow(first), follow(second)
            assert known_cells(first.joint_map) == known_cells(second.joint_map) != alone
            assert [mate.robot for mate in first.robots()] == ["a", "b"]
            assert first.map_index == second.map_index == 0
            other = first.robots()[1]
            (place,) = first.teammates(0)
            assert np.array_equal(place[:2], other.T_map_base[:2])
            assert 0.0 <= other.age_s <= place[2]
            assert not len(first.teammates(1))
            assert first.news == ["map 0 holds a", "map 0 holds a, b; joined: b"]
            before = first.received_bytes
            follow(first)
            assert first.received_bytes - before < 1000, "nothing changed, so no tile travels"


def test_points_of_a_map_in_space_come_once_somebody_asks_for_them(tmp_path):
    now = [0.0]
    packets = [encode(packet) for packet in sent("a", "B") if packet.robot == "a"]
    with Desk(tmp_path / "data", config=CloudConfig(fleet=FleetConfig(dimensions=3))) as desk:
        with closing(FleetView(client(desk, "a"), "a", lambda: None, clock=lambda: now[0])) as fleet:
            fleet.step()
            assert fleet.points() is None
            fleet.step()
            assert fleet.points() is None, "it is in no map yet"
            desk.send("a", packets)
            now[0] += 1000.0
            fleet.step()
            points, before = fleet.points(), fleet.received_bytes
            now[0] += 1000.0
            fleet.step()
            assert fleet.received_bytes - before < 2000, "nothing changed, so no point travels"
        (written, _) = read_points((desk.state.mission.run_folder / "map.ply").read_bytes(), "map.ply")
        assert np.array_equal(points, written)
        assert desk.ask("GET", "/api/v1/robots/b/points", "b").status_code == 404


def test_a_new_frame_shows_no_map_before_all_its_tiles_came(desk):
    desk.send("a", A)
    with closing(view(desk, "a", limit_kBps=0.1)) as fleet:
        fleet.step()
        assert fleet.version == 1
        assert fleet.joint_map is None
        assert fleet.map_index == 0
        follow(fleet)
        with closing(view(desk, "a", limit_kBps=1e6)) as at_once:
            at_once.step()
            assert known_cells(fleet.joint_map) == known_cells(at_once.joint_map)


def test_a_robot_that_is_taken_out_leaves_the_map_with_one_event(desk):
    desk.send("a", A)
    desk.send("b", B)
    with closing(view(desk, "a")) as fleet:
        follow(fleet)
        answer = desk.ask("POST", "/api/v1/edits", "boss", json={"kind": "removal", "content": {"robot": "b"}})
        assert answer.status_code == 201, answer.text
        desk.state.mission.worker.notify()
        follow(fleet)
        assert fleet.news[1:] == ["map 0 holds a; taken out: b"]


def test_a_robot_says_where_it_is_and_others_believe_what_it_can_have_driven(desk):
    desk.send("a", A)
    desk.send("b", B)
    with closing(view(desk, "b")) as fleet:
        follow(fleet)
        there = next(mate for mate in fleet.robots() if mate.robot == "a").T_map_base
        near, far = there + np.array((0.5, 0.0, 0.1)), there + np.array((0.0, 1e6, 0.0))
        for said, seen in ((near, near), (far, there)):
            with closing(view(desk, "a", (0, said))) as other:
                other.step()
            fleet.step()
            (mate,) = (mate for mate in fleet.robots() if mate.robot == "a")
            assert np.allclose(mate.T_map_base, seen)
            assert 0.0 <= mate.age_s < 1e9


def test_following_goes_on_through_an_outage(desk):
    desk.send("a", A)
    both = FleetClient(Server(f"http://127.0.0.1:9,{desk.client.base_url}", "token of a"))
    with closing(FleetView(both, "a", lambda: None)) as fleet:
        fleet.start()
        wait_for(lambda: fleet.joint_map is not None)


def test_a_robot_reads_no_other_robots_map_and_says_nothing_for_it(desk):
    desk.send("a", A)
    with closing(client(desk, "b")) as other:
        with pytest.raises(CloudError, match="does not speak for robot 'a'"):
            other.exchange("a", 0, (0.0, 0.0, 0.0))
        with pytest.raises(CloudError, match="does not speak for robot 'a'"):
            other.tiles("a", "", 1000)
    assert desk.ask("GET", "/api/v1/robots/a/map").status_code == 401
    assert desk.ask("GET", "/api/v1/robots/a/map", "eye").status_code == 200
    assert desk.ask("GET", "/api/v1/robots/b/map", "b").status_code == 404


@pytest.mark.parametrize("body", [{"map": 0, "pose": [0, 0]}, {"map": -1}, {"pose": ["x", 0, 0]}, {"who": 1}])
def test_a_pose_that_is_none_is_refused(desk, body):
    assert desk.ask("POST", "/api/v1/robots/a/fleet", "a", json=body).status_code == 400
