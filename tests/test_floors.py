"""Floors: places of different floors are never compared, even if the floors look the same."""

from dataclasses import replace

import numpy as np
import pytest

import fcslam
from fcslam.cloud.cloud import Cloud
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import PacketError, SourceError
from fcslam.mission.localization import read_map
from fcslam.records import LaserScan
from fcslam.runs import open_run, separations
from fcslam.sources import open_source
from fcslam.wire.messages import Hello
from tests import small_fleet
from tests.carmen_logs import write_carmen
from tests.mission.test_mission_file import contents
from tests.small_fleet import feed, in_order, map_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def alike():
    """Two robots that see the very same rooms."""
    robot = small_fleet.draw(1).robots[0]
    return small_fleet.sent_by(robot, "below"), small_fleet.sent_by(robot, "above")


@pytest.mark.parametrize(("floors", "maps"), [(("", ""), 1), (("1", "1"), 1), (("1", "2"), 2), (("", "2"), 2)])
def test_only_floors_keep_rooms_apart_that_look_alike(alike, floors, maps):
    packets = in_order(packet.on_floor(floor) for sent, floor in zip(alike, floors, strict=True) for packet in sent)
    result = feed(Cloud(FleetConfig(), 0), packets).finalize()
    assert len(set(map_of(result).values())) == maps
    assert {robot.robot: robot.floor for robot in result.robots} == dict(zip(("below", "above"), floors, strict=True))
    between = [closure for closure in result.closures if closure.i.robot != closure.j.robot]
    assert bool(between) == (maps == 1)


def test_a_session_stays_on_its_floor(alike):
    fleet = Fleet(FleetConfig(), 0)
    (hello,) = (packet for packet in alike[0] if isinstance(packet.body, Hello))
    fleet.apply(hello.on_floor("1"))
    with pytest.raises(PacketError, match="another floor; a new floor needs a new session"):
        fleet.apply(replace(hello.on_floor("2"), sequence=1))


@pytest.fixture(scope="module")
def mapped(logs, tmp_path_factory):
    """Two robots of one floor, and the first of them, 1000 s later, as a third one on another floor."""
    folder = tmp_path_factory.mktemp("floors")
    first, second = logs[:2]
    again = folder / first.name
    scans = (record for record in open_source(first).records() if isinstance(record, LaserScan))
    write_carmen(again, (replace(scan, stamp=scan.stamp + 1000.0) for scan in scans))  # a copy is refused
    recordings = {"a": first, "b": second, "c": again}
    fcslam.map_recordings(recordings, output=folder / "whole", floors={"a": "1", "b": "1", "c": "2"})
    return folder / "whole", recordings


def test_a_run_folder_names_the_floors(mapped):
    run = open_run(mapped[0])
    assert {name: trajectory.floor for name, trajectory in run.trajectories.items()} == {"a": "1", "b": "1", "c": "2"}
    assert [run.trajectories[name].map_index for name in "abc"] == [0, 0, 1]
    assert separations(run) == []


def test_a_mission_goes_on_with_another_floor(mapped, tmp_path):
    whole, recordings = mapped
    below, above = {name: recordings[name] for name in "ab"}, recordings["c"]
    fcslam.map_recordings(below, output=tmp_path / "first", floors="1")
    fcslam.map_recordings({"c": above}, output=tmp_path / "both", onto=tmp_path / "first", floors="2")
    assert contents(tmp_path / "both") == contents(whole)


def test_a_robot_is_localized_in_the_map_of_its_floor(mapped):
    whole, recordings = mapped
    found = fcslam.localize(recordings["c"], whole, floor="2").trajectories.values()
    assert [robot.floor for robot in found if len(robot.stamps)] == ["2"]
    maps = [read_map(whole / name) for name in ("map.yaml", "map_1.yaml")]
    for place in (whole, whole / "mission.fcslam"):
        for floor, expected in zip("12", maps, strict=True):
            assert np.array_equal(read_map(place, floor).cells, expected.cells)
        with pytest.raises(SourceError, match=r"has maps of several floors \(1, 2\); name the robot's floor"):
            read_map(place)
        with pytest.raises(SourceError, match="has no map of floor '3'; its floors: 1, 2"):
            read_map(place, "3")
    with pytest.raises(SourceError, match="leave the floor out"):
        read_map(whole / "map.yaml", "1")


def test_a_recording_has_several_floors(logs, tmp_path):
    stamps = [record.stamp for record in open_source(logs[0]).records() if isinstance(record, LaserScan)]
    cuts = {"b": len(stamps) // 3, "c": 2 * len(stamps) // 3}
    named = {f"x@{stamps[k] - stamps[0]:.3f}": floor for floor, k in cuts.items()}
    run = fcslam.map_recordings({"x": logs[0]}, floors={"x": "a", **named}, output=tmp_path / "run", processes=2)
    assert [(each.robot, each.floor) for each in run.trajectories.values()] == [("x", "a"), ("x+1", "b"), ("x+2", "c")]
    assert [len(each.stamps) for each in run.trajectories.values()] == pytest.approx([len(stamps) / 3] * 3, abs=2)
    assert len({each.map_index for each in run.trajectories.values()}) == 3


def test_a_robot_may_ride_before_its_first_floor_has_a_name(logs):
    run = fcslam.map_recordings({"x": logs[0]}, floors={"x@5": "2"})
    assert [each.floor for each in run.trajectories.values()] == ["", "2"]
