"""The worker: what it makes of a store is what the mission makes of the recordings, whatever happens on the way."""

import fcntl
import gc
import json
import signal
import subprocess
import sys
import tempfile
import time
from functools import cache, reduce
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fcslam.cloud.host import FleetHost
from fcslam.cloud.replies import NEWS_M
from fcslam.cloud.settings import CloudConfig, FleetConfig
from fcslam.errors import StoreError
from fcslam.geometry import se3
from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.mission.mission_store import MissionStore, StoredPacket
from fcslam.records import ClosureStatus, Constraint, ConstraintKind, FloorLabel, Place, Removal, Undo, Veto
from fcslam.runs import open_run
from fcslam.service.joint_maps import read_joint_maps
from fcslam.service.mission_folder import KEPT, MissionFolder
from fcslam.service.shared.files import RESULT
from fcslam.service.supervisor import PROGRESS
from fcslam.service.worker import (
    AT_ONCE,
    LONGEST_COPY_S,
    MOST_CRASHES,
    QUALITY_EVERY_S,
    SNAPSHOT_EVERY_S,
    CrashLog,
    Worker,
)
from fcslam.sources import open_source
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode, read_label
from tests.cloud.space_fleet import sent as sent_in_space
from tests.scripted import closures, motion, rectangle, stream
from tests.service.inline import InlineTask
from tests.small_fleet import driven, in_order

pytestmark = pytest.mark.slow

POSES = rectangle(29)
SCRIPT = closures(("a", POSES), ("b", POSES), [(0, 0), (8, 8), (16, 16), (24, 24)])


def stored(packet, data=None):
    content = encode(packet) if data is None else data
    label = read_label(content)
    return StoredPacket(packet.robot, packet.epoch, packet.sequence, packet.time, label.kind, label.channel, content)


class Cloud:
    """A store and a worker over it, as often as it is restarted; its clock moves by ``tick`` a look."""

    def __init__(self, path, config=None):
        self.folder = MissionFolder(path)
        path.mkdir()
        self.store = MissionStore(self.folder.store)
        if config:
            self.store.configure(config)
        self.now, self.told, self.tick = 0.0, [], 0.1
        self.restart()

    def restart(self, make_host=FleetHost, share=lambda *_: None):
        told = lambda *event: self.told.append(event)  # noqa: E731
        self.worker = Worker(self.folder, self.store, self.clock, told, InlineTask, share=share, make_host=make_host)

    def clock(self):
        self.now += self.tick
        return self.now

    def put(self, packets):
        self.store.put([stored(packet) for packet in packets], 0.0)

    def work(self, after_s=0.0):
        self.now += after_s
        while self.worker.step():
            pass

    def finalize(self):
        number = self.store.ask_to_finalize()
        self.work()
        asked = self.store.finalization(number)
        assert asked.failure is None
        return open_run(self.folder.run(asked.run))


@pytest.fixture
def cloud(tmp_path, scripted):
    scripted(SCRIPT)
    cloud = Cloud(tmp_path / "mission")
    yield cloud
    cloud.store.close()


def two_robots():
    return in_order([*stream("a", POSES, start_s=0.0), *stream("b", POSES, start_s=500.0)])


@cache
def expected(robots="ab"):
    """What a worker that nothing disturbs makes of these robots, by the script of the fixture ``cloud``."""
    with tempfile.TemporaryDirectory() as folder:
        cloud = Cloud(Path(folder) / "mission")
        cloud.put(packet for packet in two_robots() if packet.robot in robots)
        found = content(cloud.finalize())
        cloud.store.close()
    return found


def test_the_service_finds_what_the_mission_finds_in_the_same_recordings(tmp_path, logs):
    config = MissionConfig(seed=3)
    recorded = [open_source(log) for log in logs[:2]]
    packets = in_order(p for log in recorded for p in driven(log.records(), config.robot, log.name)[1])
    expected = run_mission([open_source(log) for log in logs[:2]], config)
    cloud = Cloud(tmp_path / "mission", config.cloud)
    rng = np.random.default_rng(11)
    order = rng.permutation(np.concatenate([np.arange(len(packets)), rng.integers(0, len(packets), 50)]))  # 50 twice
    for batch in np.array_split(order, 9):
        cloud.put(packets[k] for k in batch)
        cloud.worker.step()
    run = cloud.finalize()
    assert run.pose_graph_g2o == expected.pose_graph_g2o
    assert {name: run.map_files[name] for name in run.map_files if not name.endswith("png")} == {
        name: expected.map_files[name] for name in expected.map_files if not name.endswith("png")
    }
    assert [str(c) for c in run.closures if c.status is ClosureStatus.ACCEPTED] != []
    told = [(c.robot_i, c.robot_j, c.status, str(c.reason)) for c in run.closures]
    assert told == [(c.robot_i, c.robot_j, c.status, str(c.reason)) for c in expected.closures]
    for robot, same in zip(
        run.trajectories.values(), sorted(expected.trajectories.values(), key=lambda t: t.robot), strict=True
    ):
        assert robot.robot == same.robot
        assert set(np.round(robot.stamps, 6)) <= set(np.round(same.stamps, 6))
    cloud.store.close()


def test_a_worker_says_nothing_old_while_it_catches_up(cloud):
    packets = two_robots()
    cloud.put(packets)
    cloud.work()
    version, live = cloud.store.correction("b", 0).correction.version, cloud.folder.live.resolve()
    expected = open_run(live).pose_graph_g2o
    cloud.restart()
    while cloud.worker.step():
        assert cloud.store.correction("b", 0).correction.version == version
        assert cloud.store.applied() == len(packets)
    assert cloud.folder.live.resolve() != live, "when it has caught up, it publishes"
    assert open_run(cloud.folder.live).pose_graph_g2o == expected


def hosts(before):
    """Hosts of fleets that call this with each packet before they apply it."""

    class Watched(FleetHost):
        def apply_next(self, number, packet):
            before(packet)
            super().apply_next(number, packet)

    return Watched


def test_a_worker_goes_on_from_its_snapshot_with_the_same_result(cloud):
    packets, whole = two_robots(), expected()
    cut = (AT_ONCE + len(packets)) // 2
    cloud.put(packets[:cut])
    cloud.work()
    cloud.work(after_s=SNAPSHOT_EVERY_S)
    applied = []
    cloud.restart(hosts(lambda packet: applied.append((packet.robot, packet.sequence))))
    cloud.put(packets[cut:])
    cloud.work()
    run = cloud.finalize()
    assert applied == [(packet.robot, packet.sequence) for packet in packets[cut:]], "no packet twice"
    assert content(run) == whole


def test_in_space_a_restart_changes_no_byte_and_corrections_are_of_the_level_map(tmp_path):
    packets, config = sent_in_space("a", "b"), CloudConfig(fleet=FleetConfig(dimensions=3))
    packets, found = packets[: 3 * len(packets) // 5], []  # the robots have met
    for name, cuts in (("whole", ()), ("restarted", (len(packets) // 3, 2 * len(packets) // 3))):
        cloud = Cloud(tmp_path / name, config)
        cloud.tick = 0.0  # a live map for each part of the packets, not for every few of them
        for first, last in pairwise((0, *cuts, len(packets))):
            cloud.put(packets[first:last])
            cloud.work()
            cloud.work(after_s=SNAPSHOT_EVERY_S)
            cloud.restart()
        found.append(content(cloud.finalize()))
        live, told = open_run(cloud.folder.live), [cloud.store.correction(robot, 0).correction for robot in "ab"]
        for correction in told:
            motions = [
                packet.body.T_i_j
                for packet in packets
                if packet.robot == correction.robot
                and isinstance(packet.body, Constraint)
                and packet.body.kind is ConstraintKind.ODOMETRY
            ]
            newest = reduce(se3.compose, motions, correction.T_map_odom)
            written = np.loadtxt(cloud.folder.live / "trajectories" / f"{correction.robot}.tum")[-1, 1:]
            assert np.abs(se3.log(se3.between(written, newest))).max() < 2 * NEWS_M
        assert {one.map_index for one in live.trajectories.values()} == {0}
        cloud.store.close()
    assert found[0] == found[1]


def test_when_robots_were_heard_survives_a_restart_and_a_replay_is_not_hearing_them(cloud):
    packets = two_robots()
    cloud.put(packets[:-1])
    cloud.work()
    cloud.work(after_s=SNAPSHOT_EVERY_S)
    assert heard(cloud) == {"a": True, "b": True}
    cloud.restart()
    assert heard(cloud) == {"a": True, "b": True}
    cloud.folder.snapshot.unlink()
    cloud.restart()
    assert heard(cloud) == {"a": False, "b": False}
    cloud.put(packets[-1:])
    assert heard(cloud) == {"a": False, "b": False, packets[-1].robot: True}


def heard(cloud):
    """Whether it is known when each robot was heard, as the joint maps say."""
    cloud.work(after_s=60.0)
    return {one.robot: one.heard_s > 0.0 for one in read_joint_maps(cloud.folder.joint_maps).sessions}


@pytest.mark.parametrize("fault", ["damage", "other packets"])
def test_a_snapshot_that_does_not_fit_is_ignored_with_one_line(cloud, tmp_path, caplog, fault):
    packets = two_robots()
    cloud.put(packets)
    expected = cloud.finalize()
    cloud.work(after_s=60.0)
    assert cloud.folder.snapshot.exists()
    if fault == "damage":
        data = bytearray(cloud.folder.snapshot.read_bytes())
        data[len(data) // 2] ^= 4
        cloud.folder.snapshot.write_bytes(data)
    else:
        other = Cloud(tmp_path / "other")
        other.put([*packets[:-2], packets[-1], packets[-2]])
        cloud.folder.snapshot.rename(other.folder.snapshot)
        cloud.store.close()
        cloud.store, cloud.folder = other.store, other.folder
    applied = []
    cloud.restart(hosts(applied.append))
    (line,) = [record.getMessage() for record in caplog.records]
    assert str(cloud.folder.snapshot) in line
    assert "applies all packets again" in line
    assert cloud.finalize().pose_graph_g2o == expected.pose_graph_g2o
    assert len(applied) >= len(packets)


def test_a_worker_that_is_killed_while_it_catches_up_does_not_begin_again(cloud):
    cloud.tick = 1.0
    cloud.put(two_robots())
    while cloud.store.applied() <= AT_ONCE:
        cloud.worker.step()
    assert cloud.store.applied() < len(two_robots())
    applied = []
    cloud.restart(hosts(applied.append))
    cloud.work()
    assert len(applied) <= len(two_robots()) - AT_ONCE


def test_a_packet_that_does_not_fit_is_refused_with_its_reason_and_the_session_goes_on(cloud):
    packets = stream("a", POSES, start_s=0.0)
    wrong = packets[1]
    shifted = [*packets[:5], type(wrong)("a", 0, 5, packets[4].time, wrong.body)]
    shifted += [type(p)("a", 0, p.sequence + 1, p.time, p.body) for p in packets[5:]]
    cloud.put(shifted)
    run = cloud.finalize()
    assert [(epoch, number) for epoch, number, _ in cloud.store.refusals("a")] == [(0, 5)]
    assert "keyscan 0 where" in cloud.store.refusals("a")[0][2]
    assert len(run.trajectories["a"].stamps) == len(POSES)
    cloud.restart()
    assert cloud.finalize().pose_graph_g2o == run.pose_graph_g2o


def test_a_packet_that_breaks_the_worker_breaks_only_the_first_one(cloud):
    packets = stream("a", POSES, start_s=0.0)
    cloud.put(packets)

    def fragile(packet):
        if encode(packet) == encode(packets[-1]):
            raise ZeroDivisionError("oh")

    cloud.restart(hosts(fragile))
    with pytest.raises(ZeroDivisionError):
        cloud.work()
    cloud.restart()
    run = cloud.finalize()
    assert len(run.trajectories) == 1
    assert "ZeroDivisionError" in cloud.store.refusals("a")[0][2]


def test_corrections_leave_while_there_is_still_a_queue(cloud):
    cloud.tick = 1.0
    cloud.put(two_robots())
    waiting = []
    while cloud.store.applied() < len(cloud.store.envelopes()):
        cloud.worker.step()
        if cloud.store.correction("a", 0) is not None:
            waiting.append(len(cloud.store.envelopes()) - cloud.store.applied())
    each = list(dict.fromkeys(waiting))  # a snapshot and a map are steps as well
    assert each[0] > len(two_robots()) // 2, "most packets wait when the first correction is there"
    assert each == list(range(waiting[0], -1, -1)), "a packet takes longer than a look here: each is a step"


def test_a_packet_that_ends_worker_after_worker_is_refused_and_the_mission_goes_on(cloud, tmp_path):
    packets = two_robots()
    bad = next(k for k, packet in enumerate(packets) if k > 70 and isinstance(packet.body, Place))
    reference = Cloud(tmp_path / "reference")
    reference.put(packets)
    reference.store.refuse([(packets[bad].robot, 0, packets[bad].sequence, "beforehand")])
    expected = content(reference.finalize())
    reference.store.close()

    def hungry(packet):
        if packet.sequence == packets[bad].sequence and packet.robot == packets[bad].robot:
            raise MemoryError

    cloud.put(packets)
    for _ in range(MOST_CRASHES):
        cloud.restart(hosts(hungry))
        with pytest.raises(MemoryError):
            cloud.work()
        assert cloud.store.refusals(packets[bad].robot) == [], "there may be memory for it later"
    cloud.restart()
    run = cloud.finalize()
    ((_, sequence, reason),) = cloud.store.refusals(packets[bad].robot)
    assert (sequence, reason) == (packets[bad].sequence, "3 workers in a row ended while they applied it")
    assert content(run) == expected


def test_workers_that_end_elsewhere_refuse_nothing(cloud):
    """Killed at a packet, then at another one, and so on: no packet is to blame."""
    cloud.put(two_robots())
    for left in (20, 30, 20, 30, 40):
        applied = []

        def fragile(packet, applied=applied, left=left):
            applied.append(packet)
            if len(applied) == left:
                raise MemoryError

        cloud.restart(hosts(fragile))
        with pytest.raises(MemoryError):
            cloud.work()
    cloud.restart()
    cloud.work()
    assert [cloud.store.refusals(robot) for robot in "ab"] == [[], []]
    assert cloud.store.applied() == len(two_robots())


def test_a_result_that_ends_worker_after_worker_fails_and_the_mission_goes_on(cloud):
    class Killed(BaseException):
        """As by the kernel, which needs the memory."""

    class Killing(FleetHost):
        def conclude(self, _):
            raise Killed

    cloud.put(two_robots())
    cloud.work()
    number = cloud.store.ask_to_finalize()
    for _ in range(MOST_CRASHES):
        cloud.restart(Killing)
        with pytest.raises(Killed):
            cloud.work()
    cloud.restart(Killing)
    cloud.work()
    assert "3 workers in a row" in cloud.store.finalization(number).failure
    cloud.restart()
    assert len(cloud.finalize().trajectories) == 2


def test_a_packet_refused_while_it_waits_is_not_applied_after_a_restart(cloud):
    packets = stream("a", POSES, start_s=0.0)
    cloud.put([*packets[:-2], packets[-1]])
    cloud.work()
    cloud.work(after_s=60.0)
    cloud.store.refuse([("a", 0, packets[-1].sequence, "by hand")])
    applied = []
    cloud.restart(hosts(applied.append))
    cloud.put(packets[-2:-1])
    cloud.work()
    assert cloud.store.applied() == len(packets)
    assert [packet.sequence for packet in applied] == [packets[-2].sequence]


def told(process, event):
    """Read until a worker says this; how far it has come, and what that cost, may be said before."""
    while (said := json.loads(process.stdout.readline())["event"]) != event:
        assert said == PROGRESS


def test_a_worker_waits_until_the_one_before_is_gone_and_ends_with_one_line_when_its_service_was_killed(cloud):
    command = [sys.executable, "-m", "fcslam.service.worker"]
    cloud.put(stream("a", POSES, start_s=0.0))
    pipe = subprocess.PIPE
    with cloud.folder.worker_lock.open("w") as before:
        fcntl.flock(before, fcntl.LOCK_EX)
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
            process.stdin.write(json.dumps({"folder": str(cloud.folder.path)}) + "\n")
            process.stdin.flush()
            time.sleep(1.0)
            assert cloud.store.applied() == 0
            fcntl.flock(before, fcntl.LOCK_UN)
            told(process, "ready")
            told(process, "live")
            process.terminate()  # once it works, this does not stop it
            process.stdout.close()
            cloud.put(stream("b", POSES, start_s=500.0))
            process.stdin.write("look\n")
            process.stdin.flush()
            assert process.wait(60) == 0
            said = process.stderr.read()
    assert "its service is gone" in said
    assert "Traceback" not in said
    assert "BrokenPipe" not in said


def test_a_worker_that_is_told_to_stop_while_it_compiles_does_so_at_once(cloud):
    command = [sys.executable, "-m", "fcslam.service.worker"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.terminate()
        assert process.wait(60) == -signal.SIGTERM


def content(run):
    """The contents of a run about robots and maps, without its traffic."""
    poses = {name: (robot.map_index, robot.T_map_base.tobytes()) for name, robot in run.trajectories.items()}
    local = {name: (own.T_local_base.tobytes(), own.pgm) for name, own in run.local_maps.items()}
    return poses, local, run.map_files, run.pose_graph_g2o, [str(closure) for closure in run.closures]


@pytest.mark.parametrize(
    ("change", "restarts"),
    [(Removal("b"), True), (Veto("a", "b"), False), (FloorLabel("b", "2"), True)],
    ids=str,
)
def test_an_edit_and_its_undo_leave_what_would_have_been_without_them(cloud, change, restarts):
    packets = two_robots()
    cloud.put(packets[:60])
    cloud.finalize()
    edit = cloud.store.edit(change, "boss", 0.0)
    cloud.work()
    if restarts:
        cloud.work(after_s=60.0)
        cloud.restart()
    cloud.put(packets[60:])
    run = cloud.finalize()
    cloud.work(after_s=1000.0)
    if isinstance(change, Removal):
        assert set(open_run(cloud.folder.live).trajectories) == {"a"}
        assert content(run) == expected("a")
    elif isinstance(change, FloorLabel):  # the script of matches does not heed floors
        assert {name: robot.floor for name, robot in run.trajectories.items()} == {"a": "", "b": "2"}
    else:
        assert {t.map_index for t in run.trajectories.values()} == {0, 1}
    cloud.store.edit(Undo(edit.number), "boss", 0.0)
    if restarts:
        cloud.restart()
    run = cloud.finalize()
    assert content(run) == expected()
    assert {robot.floor for robot in run.trajectories.values()} == {""}
    cloud.work(after_s=1000.0)
    live = open_run(cloud.folder.live)
    assert {name: t.map_index for name, t in live.trajectories.items()} == {"a": 0, "b": 0}
    assert cloud.store.correction("b", 0) is not None
    assert cloud.store.applied() == len(packets)


def test_a_result_waits_for_the_packets_that_were_there_when_it_was_asked_for(cloud):
    packets = two_robots()
    cloud.put(packets)
    number = cloud.store.ask_to_finalize()
    assert cloud.worker.step()
    assert cloud.store.finalization(number).run is None
    cloud.work()
    run = open_run(cloud.folder.run(cloud.store.finalization(number).run))
    assert sum(len(t.stamps) for t in run.trajectories.values()) == 2 * len(POSES)
    assert ("finalized", number) in cloud.told


def test_a_mission_keeps_its_newest_results(cloud):
    cloud.put(two_robots()[:20])
    for _ in range(KEPT + 2):
        cloud.finalize()
    assert {path.name for path in cloud.folder.run("1").parent.iterdir()} == {str(k + 3) for k in range(KEPT)}


def test_a_copy_that_hangs_is_ended_and_its_output_comes_later(cloud):
    class Hanging:
        exitcode = None

        def terminate(self):
            self.exitcode = -signal.SIGTERM

    copies = []

    def start(task, niceness):
        copies.append(Hanging() if len(copies) < 2 else InlineTask(task, niceness))
        return copies[-1]

    cloud.worker = Worker(cloud.folder, cloud.store, cloud.clock, lambda *_: None, start)
    cloud.put(two_robots())
    for _ in range(3):
        cloud.work()
        cloud.now += LONGEST_COPY_S
    assert len(copies) >= 4
    assert open_run(cloud.folder.live).trajectories.keys() == {"a", "b"}


def test_a_map_is_drawn_while_packets_wait(cloud):
    cloud.put(two_robots())
    drawn = set()
    while cloud.store.applied() < len(two_robots()):
        cloud.worker.step()
        if cloud.folder.live.exists():
            drawn.add(open_run(cloud.folder.live).metrics["turns"].value)
    assert len(drawn) > 5


def test_the_live_run_follows_and_its_certificate_is_computed_seldom_or_when_maps_join(cloud):
    packets, certificates, seen = two_robots(), [], []
    cloud.tick = 0.001
    for part in np.array_split(np.arange(len(packets)), len(packets) // 4):
        cloud.put([packets[k] for k in part])
        for pause_s in (7.0, 1.0):
            cloud.work(after_s=pause_s)
        live = open_run(cloud.folder.live)
        seen.append(sum(len(t.stamps) for t in live.trajectories.values()))
        if seen[-1]:
            certificates.append((cloud.now, live.quality))
    computed = [at for (at, one), (_, before) in zip(certificates[1:], certificates, strict=False) if one != before]
    assert 2 <= len(computed) < len(certificates) / 2
    assert sum(np.diff(computed) < QUALITY_EVERY_S - 8.0) <= 4, "b begins, and the maps join; none between"
    cloud.work(after_s=QUALITY_EVERY_S)
    live = open_run(cloud.folder.live)
    assert set(json.loads(live.quality)) == {"0"}
    assert seen == sorted(seen)
    assert seen[-1] == 2 * len(POSES)
    assert len(list((cloud.folder.path / "snapshots").iterdir())) <= KEPT


def test_a_live_map_that_cannot_be_written_stops_nothing_and_comes_later(cloud):
    packets = two_robots()
    cloud.put(packets[:20])
    cloud.work()
    shown = int(cloud.folder.live.resolve().name)
    blocked = cloud.folder.path / "snapshots" / str(shown + 1)
    blocked.write_text("in the way")
    cloud.put(packets[20:])
    cloud.work(after_s=1000.0)
    assert cloud.store.applied() == len(packets)
    assert cloud.folder.live.resolve().name == str(shown)
    blocked.unlink()
    cloud.work(after_s=1000.0)
    assert sum(len(t.stamps) for t in open_run(cloud.folder.live).trajectories.values()) == 2 * len(POSES)


def test_nothing_of_the_packets_stays_in_the_workers_memory(cloud):
    """The worker reads from the store again what it replays in the end."""

    def in_memory():
        gc.collect()
        return sum(type(each) is Packet for each in gc.get_objects())

    cloud.put(two_robots())
    before = in_memory()
    first = cloud.finalize()
    assert in_memory() == before
    assert cloud.finalize().pose_graph_g2o == first.pose_graph_g2o
    assert in_memory() == before


@pytest.mark.parametrize("step_m", [1e6, 25.0])
def test_motions_out_of_all_bounds_are_refused_and_the_map_is_drawn_all_the_same(cloud, step_m):
    far = np.cumsum(np.full((13, 3), (step_m, 0.0, 0.0)), axis=0)
    cloud.put(stream("c", far, start_s=0.0))
    run = cloud.finalize()
    assert "m long, at most 20 m" in cloud.store.refusals("c")[0][2]
    assert {t.robot: len(t.stamps) for t in run.trajectories.values()} == {"c": 1}
    assert cloud.folder.live.exists()


def test_corrections_number_maps_as_the_live_run_does(cloud):
    alone = stream("c", POSES, start_s=-500.0)
    cloud.put(in_order([*alone, *two_robots()]))
    run = cloud.finalize()
    assert {t.robot: t.map_index for t in run.trajectories.values()} == {"a": 0, "b": 0, "c": 1}
    cloud.restart()
    cloud.work()
    cloud.put(stream("d", POSES, start_s=2000.0))
    cloud.work()
    told = {robot: cloud.store.correction(robot, 0).correction.map_index for robot in "abcd"}
    assert told == {"a": 0, "b": 0, "c": 1, "d": 2}


def test_a_result_that_fails_stops_nothing(cloud):
    class Broken(FleetHost):
        def conclude(self, _):
            raise ValueError("a pose is not finite")

    cloud.restart(Broken)
    cloud.put(two_robots())
    number = cloud.store.ask_to_finalize()
    cloud.work()
    assert cloud.store.finalization(number).failure == "a pose is not finite"

    def share(name, _):
        if name.startswith(RESULT):
            raise StoreError("over 1 GB")

    cloud.restart(share=share)
    number = cloud.store.ask_to_finalize()
    cloud.work()
    assert cloud.store.finalization(number).failure == "over 1 GB"
    cloud.restart()
    assert len(cloud.finalize().trajectories) == 2
    assert cloud.folder.live.exists()


def flood(robot, count, start_s):
    """A robot of which all but the first packets are constraints of keyscans that do not exist."""
    first = stream(robot, POSES[:2], start_s)
    wrong = [motion(robot, 10**6 + k, 10**6 + k + 1, POSES[1]) for k in range(count)]
    return [*first, *(Packet(robot, 0, len(first) + k, start_s + 9.0, body) for k, body in enumerate(wrong))]


def test_a_robot_that_floods_delays_no_other_and_the_result_is_the_same(cloud):
    cloud.put(flood("c", 9 * AT_ONCE, start_s=-500.0))
    cloud.put(stream("a", POSES[:5], start_s=0.0))
    applied = []
    cloud.restart(hosts(lambda packet: applied.append(packet.robot)))
    cloud.tick = 0.0
    cloud.worker.step()
    assert applied == ["c"] * AT_ONCE + ["a"] * len(stream("a", POSES[:5], 0.0)), "in one step, behind a part of c's"
    applied_count, waiting = cloud.store.backlog()
    assert waiting == {"c": len(flood("c", 9 * AT_ONCE, 0.0)) - AT_ONCE}
    assert applied_count == len(applied)
    live = content(cloud.finalize())
    cloud.restart()
    assert content(cloud.finalize()) == live, "in the order of time"


def test_refusals_are_stored_together_and_outlive_the_worker(cloud):
    cloud.put(flood("c", 2 * AT_ONCE, start_s=0.0))
    cloud.tick = 0.0
    cloud.worker.step()
    stored = cloud.store.refused("c").count
    assert stored > AT_ONCE // 2, "with how far the worker is, in one transaction"
    cloud.tick = 1.0
    cloud.restart()
    cloud.work()
    assert cloud.store.refused("c").count == 2 * AT_ONCE
    assert len(cloud.store.refusals("c")) == 100, "the last ones, however many there are"


def test_a_task_that_a_worker_survived_is_no_longer_suspect(tmp_path):
    for _ in range(MOST_CRASHES - 1):
        CrashLog(tmp_path / "task").begin("packet 1 of a")
    log = CrashLog(tmp_path / "task")
    for task in ("packet 1 of a", "packet 2 of a", "packet 1 of a"):  # an edit lets packets be applied again
        log.begin(task)
    assert not CrashLog(tmp_path / "task").is_fatal("packet 1 of a")
