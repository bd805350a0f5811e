"""A mission that goes on from its file is the mission of all recordings at once, byte for byte."""

import shutil

import pytest

import fcslam
from fcslam.cloud.settings import CloudConfig
from fcslam.errors import SourceError
from fcslam.mission_file import mission_bytes, read_mission
from fcslam.records import Veto
from fcslam.runs import open_run

pytestmark = pytest.mark.slow


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def whole(logs, tmp_path_factory):
    """The run of three recordings at once."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    fcslam.map_recordings(logs, output=folder)
    return folder


@pytest.fixture(scope="module")
def begun(logs, tmp_path_factory):
    """The run of the first two."""
    folder = tmp_path_factory.mktemp("begun") / "run"
    fcslam.map_recordings(logs[:2], output=folder)
    return folder


def test_a_mission_goes_on_without_its_recordings(logs, whole, begun, tmp_path):
    fcslam.map_recordings(logs[2:], output=tmp_path / "run", onto=begun)
    assert contents(tmp_path / "run") == contents(whole)


def test_a_mission_goes_on_more_than_once(logs, whole, tmp_path):
    fcslam.map_recordings(logs[:1], output=tmp_path / "one")
    fcslam.map_recordings(logs[1:2], output=tmp_path / "two", onto=tmp_path / "one" / "mission.fcslam")
    fcslam.map_recordings(logs[2:], output=tmp_path / "three", onto=tmp_path / "two")
    assert contents(tmp_path / "three") == contents(whole)


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
    run = fcslam.map_recordings(logs[2:], onto=tmp_path / "apart")
    between = [c for c in run.closures if {c.robot_i, c.robot_j} == {first, second}]
    assert between
    assert not any(c.status is fcslam.ClosureStatus.ACCEPTED for c in between)


def test_the_settings_of_the_cloud_are_kept(logs, tmp_path):
    fcslam.map_recordings(logs[:2], output=tmp_path / "alone", join_maps=False)
    run = fcslam.map_recordings(logs[2:], onto=tmp_path / "alone")
    assert len({trajectory.map_index for trajectory in run.trajectories.values()}) == 3


def test_a_mission_file_survives_the_run_folder(begun, tmp_path):
    open_run(begun).save(tmp_path / "copy")
    assert (tmp_path / "copy" / "mission.fcslam").read_bytes() == (begun / "mission.fcslam").read_bytes()


def test_what_is_no_mission_file_is_told_in_one_line(begun, tmp_path):
    whole = (begun / "mission.fcslam").read_bytes()
    with pytest.raises(SourceError, match=r"nowhere: no mission file; `fcslam map` writes one"):
        read_mission(tmp_path / "nowhere")
    for name, content in (("empty", b""), ("cut", whole[: len(whole) // 2]), ("text", b"hello\n" * 999)):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(SourceError, match=name):
            read_mission(path)
        assert path.read_bytes() == content
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut", "empty", "text"]


def test_reading_is_the_inverse_of_writing(begun, tmp_path):
    saved = read_mission(begun)
    packets = sorted((sized for sent in saved.packets.values() for sized in sent), key=lambda s: s.packet.order)
    path = tmp_path / "again"
    path.write_bytes(mission_bytes(saved.config, saved.edits, packets, saved.refused, saved.tracks))
    again = read_mission(path)
    assert again.config == saved.config == CloudConfig()
    assert [s.data for sent in again.packets.values() for s in sent] == [
        s.data for sent in saved.packets.values() for s in sent
    ]
    assert again.tracks.keys() == saved.tracks.keys()
    for name, track in saved.tracks.items():
        assert again.tracks[name].stamps.tobytes() == track.stamps.tobytes()
        assert again.tracks[name].T_keyscan_base.tobytes() == track.T_keyscan_base.tobytes()
