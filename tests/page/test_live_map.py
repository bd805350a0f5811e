"""The page beside the mapping: which maps it shows and when, and that the mapping never waits for one."""

from itertools import pairwise

import pytest

from fcslam.mission.mission import MissionCloud, MissionConfig
from fcslam.page.live_map import LiveMap
from fcslam.page.shown_run import ShownRun
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.viewed_mission import viewed_run
from fcslam.wire.packets import measure
from tests.service.inline import InlineTask


class Copy:
    """A task in a copy of the process, done when the test ends it."""

    def __init__(self, task):
        self.exitcode, self.is_ended = None, False
        self._task = task

    def end(self):
        self._task()
        self.exitcode = 0

    def terminate(self):
        self.is_ended = True

    def join(self):
        assert self.is_ended


class Mapping:
    """A mission whose packets come by and by; the test moves the clock."""

    def __init__(self, folder, packets, start):
        self.now, self.copies = 0.0, []
        self.cloud = MissionCloud(MissionConfig())
        self.live = LiveMap(
            MissionFolder(folder), lambda: self.now, lambda task: self.copies.append(start(task)) or self.copies[-1]
        )
        self._packets = iter(packets)

    def go_on(self, now, count=0):
        self.now = now
        for _, packet in zip(range(count), self._packets, strict=False):
            self.cloud.apply(measure(packet))
        self.live.look(self.cloud)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "page").mkdir()
    return tmp_path / "page"


def test_the_map_grows_with_the_mission_and_ends_as_the_run(folder, packets, tmp_path):
    mapping = Mapping(folder, packets, InlineTask)
    with ShownRun(folder / "live", "x") as shown:
        keyscans = [0]
        for now in range(1, 11):
            mapping.go_on(10.0 * now, len(packets) // 10 + 1)
            mapping.go_on(10.0 * now + 1.0)  # sees that the map is written
            trajectories = viewed_run(shown.run_folder).trajectories.values()
            keyscans.append(sum(len(trajectory.stamps) for trajectory in trajectories))
        assert all(before < after for before, after in pairwise(keyscans))
        assert len(shown.sessions()) == 3
        run = mapping.cloud.run({}, 1, 1.0)
        run.save(tmp_path / "run")
        mapping.live.finish(tmp_path / "run")
        assert shown.run_folder == tmp_path / "run"
        assert shown.packet_counts().arrived == len(packets)


def test_one_map_is_written_at_a_time_and_the_pause_is_as_long_as_the_writing(folder, packets):
    mapping = Mapping(folder, packets, Copy)
    mapping.go_on(0.5, 50)
    assert mapping.copies == [], "a mission of a second needs no page"
    for now in (1.0, 2.0, 5.0):
        mapping.go_on(now)
    (copy,) = mapping.copies
    copy.end()
    for now in (6.0, 10.9):
        mapping.go_on(now)
    assert len(mapping.copies) == 1
    mapping.go_on(11.0)
    assert len(mapping.copies) == 2


def test_the_end_of_the_mapping_ends_what_is_being_written(folder, packets, tmp_path):
    mapping = Mapping(folder, packets, Copy)
    mapping.go_on(1.0, 50)
    mapping.live.finish(tmp_path)
    assert mapping.copies[0].is_ended
    assert (folder / "live").resolve() == tmp_path
