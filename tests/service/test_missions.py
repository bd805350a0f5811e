"""Missions of one service: begun, opened, brought in, whatever the disk says."""

from types import SimpleNamespace

import pytest

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import StoreError
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.missions import Missions


class Launched:
    """A worker that only counts."""

    pid, starts, is_ready = None, 1, False

    def __init__(self, folder):
        self.folder, self.stopped = folder, False

    def notify(self):
        pass

    def stop(self):
        self.stopped = True


@pytest.fixture
def service(tmp_path):
    """Missions, and the workers that they started."""
    workers = []

    def launch(folder):
        workers.append(Launched(folder))
        return workers[-1]

    missions = Missions(tmp_path / "data", CloudConfig(), lambda: 0.0, lambda: 1e9, launch)
    yield missions, workers
    missions.close()


def test_a_mission_that_cannot_be_opened_leaves_no_worker_and_the_other_one_open(service):
    missions, workers = service
    blocked = missions.root / ".open.partial"
    blocked.mkdir()
    with pytest.raises(StoreError, match="disk full"):
        missions.create("next")
    assert [(worker.folder.name, worker.stopped) for worker in workers] == [("mission", False), ("next", True)]
    assert missions.open_mission.folder.name == "mission"
    blocked.rmdir()
    missions.open("next")
    assert missions.open_mission.folder.name == "next"
    assert [worker.stopped for worker in workers] == [True, True, False]


def test_a_damaged_mission_is_refused_and_the_other_one_stays_open(service):
    missions, workers = service
    missions.create("next")
    missions.open("mission")
    path = MissionFolder.of(missions.root, "next").store
    content = path.read_bytes()
    path.write_bytes(content[:-1000] + bytes(1000))
    for use in (missions.open, lambda name: missions.export(name, missions.root / "backup.sqlite")):
        with pytest.raises(StoreError, match=r"next/mission\.sqlite: damaged .*; put its backup in its place"):
            use("next")
        assert missions.open_mission.folder.name == "mission"
    assert [worker.stopped for worker in workers] == [True, True, False]
    path.write_bytes(content)
    missions.open("next")
    assert missions.open_mission.folder.name == "next"


def test_an_export_is_of_the_mission_that_was_open_when_it_began(tmp_path):
    """Another administrator may open another mission meanwhile."""
    exported = []
    seen = [
        SimpleNamespace(name=name, store=SimpleNamespace(export=lambda _, name=name: exported.append(name)))
        for name in ("first", "second")
    ]

    class Switching(Missions):
        open_mission = property(lambda _: seen.pop(0))

        def __init__(self):
            self.root = tmp_path

    Switching().export("first", tmp_path / "file")
    assert exported == ["first"]


@pytest.mark.parametrize("harm", ["gone", "empty"])
def test_a_mission_without_its_file_is_not_a_new_one(service, harm):
    missions, _ = service
    missions.create("next")
    folder = MissionFolder.of(missions.root, "mission")
    folder.worker_lock.touch()
    folder.store.unlink()
    if harm == "empty":
        folder.store.touch()
    with pytest.raises(StoreError, match="is missing or empty; put its backup in its place"):
        missions.create("mission") if harm == "gone" else missions.open("mission")
    assert missions.open_mission.folder.name == "next"


def test_what_was_left_half_done_is_swept_away_and_the_rest_is_not(tmp_path):
    root = tmp_path / "data"
    left = [root / ".importx1", root / ".exportx2"]
    kept = [root / "detectors" / "lost+found", root / "missions" / "old"]
    for folder in (*left, *kept):
        folder.mkdir(parents=True)
        (folder / "network.onnx").write_text("x")
    (kept[0] / "announced").write_text("v1")
    halves = [folder / ".one.partial" for folder in kept]
    for half in halves:
        half.write_text("half")
    missions = Missions(root, CloudConfig(), lambda: 0.0, lambda: 1e9, Launched)
    assert not any(folder.exists() for folder in left)
    assert all((folder / "network.onnx").exists() for folder in kept)
    assert not any(half.exists() for half in halves)
    assert missions.detectors.versions() == []
    assert missions.detectors.announced() == {}
    missions.close()
