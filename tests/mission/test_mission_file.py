"""A mission that goes on from its file is the mission of all recordings at once, byte for byte."""

import multiprocessing
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

import fcslam
from fcslam.cloud.settings import CloudConfig, FleetConfig
from fcslam.errors import InputError, SourceError
from fcslam.mission.edits import kind_of
from fcslam.mission.localization import read_map
from fcslam.mission.mission_file import edit_mission, read_mission
from fcslam.records import Cut, FloorLabel, ManualClosure, MapRegion, Pin, RegionUse, Removal, Undo, Veto
from fcslam.runs import open_run
from tests.small_fleet import contents

pytestmark = pytest.mark.slow

GOLDEN = Path(__file__).parent / "golden" / "mission_8.fcslam"


@pytest.fixture(scope="module")
def whole(logs, tmp_path_factory):
    """The run of three recordings at once."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    fcslam.map_recordings(logs, output=folder)
    return folder


@pytest.fixture(scope="module")
def begun(logs, tmp_path_factory):
    """The run of the first two, which went on once."""
    folder = tmp_path_factory.mktemp("begun")
    fcslam.map_recordings(logs[:1], output=folder / "one")
    fcslam.map_recordings(logs[1:2], output=folder / "run", onto=folder / "one" / "mission.fcslam")
    return folder / "run"


def test_a_mission_goes_on_more_than_once_without_its_recordings(logs, whole, begun, tmp_path):
    fcslam.map_recordings(logs[2:], output=tmp_path / "run", onto=begun)
    assert contents(tmp_path / "run") == contents(whole)


def copied(run, folder):
    return Path(shutil.copytree(run, folder))


def test_a_mission_that_is_mapped_again_is_the_same(begun, tmp_path):
    fcslam.map_recordings([], output=tmp_path / "again", onto=begun)
    assert contents(tmp_path / "again") == contents(begun)


@pytest.mark.attack
def test_killed_while_it_goes_on_a_mission_is_as_before_or_the_next(logs, whole, begun, tmp_path):
    """SIGKILL, while the run folder replaces the one that it goes on from."""
    run, before = copied(begun, tmp_path / "run"), contents(begun)
    for after_s in (0.05, 0.3, 0.6):
        arguments = {"recordings": logs[2:], "onto": run, "output": run, "force": True}
        process = multiprocessing.get_context("fork").Process(target=fcslam.map_recordings, kwargs=arguments)
        process.start()
        process.join(after_s)
        process.kill()
        process.join()
        assert contents(run) == (contents(whole) if process.exitcode == 0 else before)
        if process.exitcode == 0:
            run = copied(begun, tmp_path / f"{after_s}")
    fcslam.map_recordings(logs[2:], onto=run, output=run, force=True)
    assert contents(run) == contents(whole)


@pytest.mark.attack
def test_names_of_folders_that_are_no_utf8_are_names(begun, tmp_path):
    run = copied(begun, tmp_path / os.fsdecode(b"run \xff"))
    assert open_run(run).pose_graph_g2o == open_run(begun).pose_graph_g2o
    assert read_mission(run / "mission.fcslam").edits == read_mission(begun).edits
    assert read_map(run).cells.tobytes() == read_map(begun).cells.tobytes()
    fcslam.map_recordings([], onto=run, output=tmp_path / os.fsdecode(b"\xfe"))
    assert contents(tmp_path / os.fsdecode(b"\xfe")) == contents(begun)


@pytest.mark.attack
def test_a_mission_beyond_the_limit_is_refused_by_its_size(begun, tmp_path):
    """Files with a hole, of 3 GB: nothing of them is read."""
    run = copied(begun, tmp_path / "run")
    os.truncate(run / "mission.fcslam", 3 << 30)
    for read in (read_mission, lambda path: edit_mission(path, [], "me", 0.0)):
        with pytest.raises(SourceError, match=r"mission\.fcslam has 3221\.2 MB; the limit is 2147\.5 MB$"):
            read(run)


def test_a_robot_that_comes_back_begins_a_new_session(logs, begun, tmp_path):
    again = tmp_path / logs[0].name
    shutil.copy(logs[2], again)
    run = fcslam.map_recordings(again, onto=begun)
    first, second = (path.stem for path in logs[:2])
    assert list(run.trajectories) == [first, f"{first}+1", second]
    assert len({trajectory.map_index for trajectory in run.trajectories.values()}) == 1


def test_vetoes_stay_in_force(logs, tmp_path):
    first, second = (path.stem for path in logs[:2])
    fcslam.map_recordings(logs[:2], output=tmp_path / "apart", vetoes=[Veto(first, second)])
    assert [edit.time_s for edit in read_mission(tmp_path / "apart").edits] == [0.0]  # the same bytes whenever it runs
    run = fcslam.map_recordings([], onto=tmp_path / "apart")
    between = [c for c in run.closures if {c.robot_i, c.robot_j} == {first, second}]
    assert between
    assert not any(c.status is fcslam.ClosureStatus.ACCEPTED for c in between)


def test_the_settings_of_the_cloud_are_kept(logs, tmp_path):
    fcslam.map_recordings(logs[:2], output=tmp_path / "alone", config={"fleet": {"join_maps": False}})
    run = fcslam.map_recordings([], onto=tmp_path / "alone")
    assert len({trajectory.map_index for trajectory in run.trajectories.values()}) == 2


def test_what_is_no_mission_file_is_told_in_one_line_and_stays_as_it_is(tmp_path):
    whole = GOLDEN.read_bytes()
    with pytest.raises(SourceError, match=r"nowhere: no such file; `fcslam map` writes mission.fcslam"):
        read_mission(tmp_path / "nowhere")
    shares = {f"cut{share}": whole[: int(share * len(whole))] for share in (0.01, 0.3, 0.99)}
    for name, content in {"empty": b"", "text": b"hello\n" * 999, **shares}.items():
        path = tmp_path / name
        path.write_bytes(content)
        for read in (read_mission, lambda path: edit_mission(path, [Removal("ben")], "me", 0.0)):
            with pytest.raises(SourceError, match=f"{name}[^\n]*$") as refused:
                read(path)
            assert "disk full" not in str(refused.value)
            assert path.read_bytes() == content
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(("empty", "text", *shares))


def test_the_golden_mission_means_what_it_says():
    mission = read_mission(GOLDEN)
    assert {robot: len(sent) for robot, sent in mission.packets.items()} == {"anna": 24, "ben": 26}
    assert [len(track.stamps) for track in mission.tracks.values()] == [19, 19]
    assert mission.tracks["ben"].stamps[[0, -1]].tolist() == [1000.001, 1009.001]
    assert [kind_of(edit.content) for edit in mission.edits] == ["veto", "cut", "region", "undo"]
    assert {edit.author for edit in mission.edits} == {"boss"}
    # A mission keeps the settings with which it began; the defaults were others then.
    assert mission.config == CloudConfig(fleet=FleetConfig(submaps_kept=1000))
    assert mission.refused == ()


def test_a_mission_is_mapped_again_with_its_edits():
    run = fcslam.map_recordings([], onto=GOLDEN)
    assert set(run.trajectories) == {"anna", "ben"}
    assert b"Room 1" in run.map_files["map_areas.geojson"]


@pytest.mark.parametrize("version", [7, 9])
def test_a_mission_file_of_another_version_is_refused(tmp_path, version):
    other = tmp_path / "mission.fcslam"
    shutil.copy(GOLDEN, other)
    with closing(sqlite3.connect(other)) as connection:
        connection.execute(f"PRAGMA user_version={version}")
    with pytest.raises(SourceError, match=f"a file of version {version}; this fcslam reads version 8"):
        read_mission(other)


@pytest.mark.parametrize(
    "wrong",
    [
        Removal("zoe"), Removal("ben", 1), Veto("anna", "zoe"), Pin("anna", "ben", (1000.0, 5000.0)), Undo(1), Undo(9),
        FloorLabel("zoe", "2"), FloorLabel("ben", "no floor"),
        Cut("ben", 2.0, 1.0), MapRegion(RegionUse.ERASE, "", "ben", 1000.0, ((0.0, 0.0), (1.0, 0.0))),
    ],
    ids=str,
)  # fmt: skip
def test_a_wrong_edit_leaves_the_file_as_it_was(tmp_path, wrong):
    mission = Path(shutil.copy(GOLDEN, tmp_path / "mission.fcslam"))
    with pytest.raises(InputError) as refused:
        edit_mission(mission, [Removal("ben"), wrong], "me", 0.0)
    assert "\n" not in str(refused.value)
    assert mission.read_bytes() == GOLDEN.read_bytes()


def test_no_closure_by_hand_is_made_between_floors_that_users_named(tmp_path):
    mission = Path(shutil.copy(GOLDEN, tmp_path / "mission.fcslam"))
    edit_mission(mission, [FloorLabel("ben", "2")], "me", 0.0)
    made = ManualClosure("anna", 1000.0, "ben", 1000.0, (0.0, 0.0, 0.0), (0.1, 0.1))
    with pytest.raises(InputError, match="different floors"):
        edit_mission(mission, [made], "me", 0.0)
    edit_mission(mission, [FloorLabel("anna", "2"), made], "me", 0.0)
