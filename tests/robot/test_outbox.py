"""The outbox forgets what the cloud has, and nothing else, whatever happens to its process."""

import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fcslam.errors import InputError
from fcslam.robot.outbox import Outbox
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS
from fcslam.wire.packets import decode, encode
from tests.robot.fake_cloud import said
from tests.wire.examples import HELLO, KEYSCAN, LIDAR_PLACE

pytestmark = pytest.mark.slow

LIMIT = 10_000_000
BODIES = [HELLO, KEYSCAN, LIDAR_PLACE]


def drain(outbox, packets=MAXIMUM_BATCH_PACKETS):
    """All that waits, by epoch and sequence, as a cloud would store it."""
    stored = {}
    while batch := outbox.batch(MAXIMUM_BATCH_BYTES, packets):
        for number, data in enumerate(batch.packets, start=batch.first):
            assert (decode(data).epoch, decode(data).sequence) == (batch.epoch, number)
            stored[batch.epoch, number] = data
        assert outbox.acknowledge(batch.epoch, number) == len(batch.packets)
    return stored


@contextmanager
def started(path, recording="r", resume=False, limit=LIMIT):
    """The outbox of a robot that reads a recording."""
    with closing(Outbox(path, "alice", limit)) as outbox:
        outbox.begin(recording, resume)
        yield outbox


@pytest.fixture
def path(tmp_path):
    return tmp_path / "outbox.sqlite"


@pytest.fixture
def outbox(path):
    with started(path) as outbox:
        yield outbox


class Deliveries(RuleBasedStateMachine):
    """Against a list of what was said and a set of what the cloud has."""

    @initialize()
    def open(self):
        self.place = tempfile.TemporaryDirectory()
        self.path = Path(self.place.name) / "outbox"
        self.outbox = Outbox(self.path, "alice", LIMIT)
        self.outbox.begin("r", resume=False)
        self.outbox.synchronize({})
        self.said, self.cloud = [], 0

    @rule(body=st.sampled_from(BODIES), count=st.integers(1, 4))
    def put(self, body, count):
        packets = [said(len(self.said) + k, body) for k in range(count)]
        assert self.outbox.put(packets) == 0
        self.said += packets

    @rule(keep=st.integers(0, 5), packets=st.integers(1, 5))
    def deliver(self, keep, packets):
        """The cloud stores some of the next batch; whether the robot hears of it or not, it may come again."""
        batch = self.outbox.batch(MAXIMUM_BATCH_BYTES, packets)
        if batch is not None:
            assert len(batch.packets) <= packets
            self.cloud = max(self.cloud, batch.first + min(keep, len(batch.packets)))
            self.outbox.acknowledge(0, self.cloud - 1)

    @precondition(lambda self: self.cloud < len(self.said))
    @rule()
    def drop(self):
        assert self.outbox.packet(0, self.cloud) == encode(self.said[self.cloud])
        self.outbox.drop(0, self.cloud)
        self.cloud += 1
        self.outbox.acknowledge(0, self.cloud - 1)

    @rule()
    def die_and_resume(self):
        """Without a word of farewell; then the recording is read once more."""
        self.outbox.close()
        self.outbox = Outbox(self.path, "alice", LIMIT)
        assert self.outbox.begin("r", resume=True) == len(self.said)
        self.outbox.synchronize({0: self.cloud} if self.cloud else {})
        self.outbox.acknowledge(0, self.cloud - 1)
        assert self.outbox.put(self.said) == 0

    @invariant()
    def all_is_there(self):
        batch = self.outbox.batch(MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS)
        rest = [encode(packet) for packet in self.said[self.cloud :]]
        assert (list(batch.packets) if batch else []) == rest
        assert batch is None or batch.first == self.cloud
        assert self.outbox.waiting == (len(rest), sum(map(len, rest)))

    def teardown(self):
        self.outbox.close()
        self.place.cleanup()


Deliveries.TestCase.settings = settings(max_examples=25, stateful_step_count=20)
TestDeliveries = Deliveries.TestCase


def test_oldest_first_one_epoch_a_batch_and_within_the_limits(outbox, path):
    outbox.put([said(k) for k in range(5)])
    outbox.close()
    with started(path, "another") as again:
        assert again.epoch == 1
        again.put([said(k, LIDAR_PLACE) for k in range(3)])
        assert again.batch(MAXIMUM_BATCH_BYTES, 100) is None, "whose epochs these are the cloud has not said"
        again.synchronize({})
        first = again.batch(MAXIMUM_BATCH_BYTES, 100)
        assert (first.epoch, first.first, len(first.packets)) == (0, 0, 5)
        size = len(first.packets[1]) + 4
        assert len(again.batch(2 * size + 1, 100).packets) == 2
        assert len(again.batch(1, 100).packets) == 1, "one is better than none"
        assert list(drain(again, 2)) == [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 0), (1, 1), (1, 2)]


def of_part(part, *ordinals):
    return [replace(said(ordinal), epoch=part) for ordinal in ordinals]


def test_a_robot_that_was_lost_goes_on_in_the_next_epoch(outbox, path):
    outbox.synchronize({})
    outbox.put([*of_part(0, 0, 1), *of_part(1, 0)])
    assert (outbox.epoch, outbox.is_synchronized) == (1, False)
    assert list(drain(outbox)) == [(0, 0), (0, 1)], "of the new one the cloud does not know yet"
    outbox.synchronize({0: 2, 1: 5})
    assert (outbox.epoch, outbox.is_synchronized) == (2, True), "another state folder had that one"
    assert [outbox.session_of(epoch) for epoch in (0, 1, 2)] == [0, None, 1]
    assert list(drain(outbox)) == [(2, 0)]
    outbox.close()
    again = Outbox(path, "alice", LIMIT)
    assert again.begin("r", resume=True) == 3
    assert again.epoch == 2
    again.put([*of_part(0, 0, 1), *of_part(1, 0, 1), *of_part(2, 0)])
    again.synchronize({0: 2, 1: 5, 2: 1})
    assert list(drain(again)) == [(2, 1), (3, 0)]
    again.close()
    anew = Outbox(path, "alice", LIMIT)
    assert anew.begin("r", resume=False) == 0
    anew.put(of_part(0, 0))
    assert [anew.session_of(epoch) for epoch in (0, 2, 3, 4)] == [None, None, None, 0]
    with pytest.raises(InputError, match="differs from that of the interrupted run"):
        anew.put([replace(said(0, KEYSCAN), epoch=0)])
    anew.close()


def test_an_epoch_that_the_cloud_knows_from_before_is_not_taken_again(outbox):
    outbox.put([said(0, HELLO), said(1)])
    outbox.synchronize({0: 7, 3: 2})
    assert outbox.epoch == 4
    outbox.put([said(2)])
    outbox.synchronize({0: 7, 3: 2})
    stored = drain(outbox)
    assert list(stored) == [(4, 0), (4, 1), (4, 2)]
    assert decode(stored[4, 0]).body.epoch == 4


def test_epochs_do_not_run_out_silently(outbox):
    """Whoever has the robot's token may have used the last one."""
    with pytest.raises(InputError, match="something else sends under its name"):
        outbox.synchronize({2**31 - 1: 3})


@pytest.mark.parametrize(
    ("starts", "known", "epochs"), [(3, {}, [0, 1, 2]), (3, {0: 1}, [1, 2, 3]), (2, {5: 1}, [6, 7])]
)
def test_starts_that_never_met_the_cloud_keep_their_order(path, starts, known, epochs):
    for start in range(starts):
        with started(path) as outbox:
            outbox.put([replace(said(0), time=2000.0 + start)])
    with closing(Outbox(path, "alice", LIMIT)) as outbox:
        outbox.synchronize(known)
        times = {epoch: decode(data).time for (epoch, _), data in drain(outbox).items()}
    assert times == {epoch: 2000.0 + start for start, epoch in enumerate(epochs)}


def test_a_cloud_that_lost_what_it_confirmed_is_found_out(outbox):
    outbox.put([said(k) for k in range(5)])
    outbox.synchronize({})
    outbox.acknowledge(0, 3)
    outbox.synchronize({0: 4})
    with pytest.raises(InputError, match="has 2 of 4 packets of epoch 0"):
        outbox.synchronize({0: 2})
    assert outbox.waiting.packets == 1


def test_what_an_earlier_start_left_for_another_mission_waits_in_vain(outbox):
    outbox.put([said(k) for k in range(6)])
    outbox.synchronize({})
    outbox.acknowledge(0, 3)
    outbox.begin("r", resume=False)
    outbox.put([said(0)])
    assert outbox.synchronize({}) == [(0, 4), (0, 5)]
    assert outbox.synchronize({0: 4}) == [], "it is the same mission after all"
    assert outbox.synchronize({0: 1}) == [(0, 4), (0, 5)]
    for epoch, sequence in outbox.synchronize({0: 1}):
        outbox.drop(epoch, sequence)
    assert outbox.synchronize({}) == [], "what is over is over"
    assert list(drain(outbox)) == [(1, 0)]


def test_a_full_outbox_leaves_places_out_and_keeps_the_chain(path):
    limit = 20 * len(encode(said(0)))
    with started(path, limit=limit) as outbox:
        assert outbox.put([said(k) for k in range(15)]) == 0
        assert outbox.put([said(15, LIDAR_PLACE), said(16), said(17, LIDAR_PLACE)]) == 2
        assert not outbox.is_full
        outbox.put([said(k) for k in range(18, 23)])
        assert outbox.is_full
    with closing(Outbox(path, "alice", limit)) as outbox:
        assert outbox.begin("r", resume=True) == 23
        outbox.synchronize({})
        stored = drain(outbox)
        assert list(stored) == [(0, number) for number in range(21)], "no gap where places were left out"
        assert not any(decode(data).body == LIDAR_PLACE for data in stored.values())
        assert outbox.put([said(17, LIDAR_PLACE), said(23, LIDAR_PLACE)]) == 0
        assert list(drain(outbox)) == [(0, 21)]


def test_what_is_resumed_must_be_the_same(outbox, path):
    outbox.put([said(0), said(1)])
    outbox.close()
    with pytest.raises(InputError, match="another recording"), started(path, "another", resume=True):
        pass
    differs = pytest.raises(InputError, match="packet 1 differs from that of the interrupted run")
    with started(path, resume=True) as again, differs:
        again.put([said(0), said(1, LIDAR_PLACE)])


def test_a_folder_has_one_robot_and_one_process(outbox, path):
    with pytest.raises(InputError, match="another process runs on it"):
        Outbox(path, "alice", LIMIT)
    agent = outbox.agent
    outbox.close()
    with pytest.raises(InputError, match="belongs to robot 'alice', not 'bob'"):
        Outbox(path, "bob", LIMIT)
    with closing(Outbox(path, "alice", LIMIT)) as again:
        assert again.agent == agent


def test_no_outbox_is_one_line(tmp_path):
    (tmp_path / "outbox").write_bytes(b"noise" * 1000)
    with pytest.raises(InputError, match="file is not a database"):
        Outbox(tmp_path / "outbox", "alice", LIMIT)
    with pytest.raises(InputError, match="unable to open"):
        Outbox(tmp_path / "nowhere" / "outbox", "alice", LIMIT)


WRITER = """
import sys
from dataclasses import replace
from pathlib import Path
from tests.wire.examples import KEYSCAN, packet
from fcslam.robot.outbox import Outbox
outbox = Outbox(Path(sys.argv[1]), "alice", 10**9)
outbox.begin("r", resume=sys.argv[2] == "True")
for k in range(10**6):
    outbox.put([replace(packet(KEYSCAN), epoch=0, sequence=k)])
    print(k, flush=True)
"""


def test_an_outbox_of_another_version_is_told_as_such(path):
    with sqlite3.connect(path) as older:
        older.execute("CREATE TABLE sessions (epoch INTEGER PRIMARY KEY, recording TEXT NOT NULL)")
    older.close()
    with pytest.raises(InputError, match="comes from another version of fcslam; give another --state"):
        Outbox(path, "anna", LIMIT)


def test_a_killed_robot_has_all_that_it_put(path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    most = -1
    for kill_at in (1, 170):
        command = [sys.executable, "-c", WRITER, str(path), str(most >= 0)]
        with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as writer:
            put = next(number for number in map(int, writer.stdout) if number >= kill_at)
            writer.send_signal(signal.SIGKILL)
        most = max(most, put)
        with closing(Outbox(path, "alice", LIMIT)) as outbox:
            outbox.synchronize({})
            (first, *_, last) = (decode(data).sequence for data in outbox.batch(10**9, 10**9).packets)
            assert (first, last + 1) == (0, outbox.waiting.packets)
            assert last >= most


def test_a_damaged_packet_is_told_by_its_number(path):
    """Each waiting packet has its digest."""
    with started(path) as outbox:
        outbox.put(said(k, body) for k, body in enumerate([HELLO, *[KEYSCAN] * 4]))
        outbox.synchronize({})
        outbox.acknowledge(0, 1)
    content = path.read_bytes()
    with closing(sqlite3.connect(path)) as file:
        (data,) = file.execute("SELECT data FROM packets WHERE ordinal = 2").fetchone()
    for at in (0, len(data) // 2, len(data) - 1):
        damaged = bytearray(content)
        damaged[content.index(data) + at] ^= 4
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"packet 2 of epoch 0 is damaged, .*; give another --state") as told:
            Outbox(path, "alice", LIMIT)
        assert "\n" not in str(told.value)


def test_a_cut_outbox_is_told(path):
    with started(path) as outbox:
        outbox.put(said(k, KEYSCAN) for k in range(100))
    content = path.read_bytes()
    for share in (0.01, 0.5, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match=r"cannot be used: .*; give another --state") as told:
            Outbox(path, "alice", LIMIT)
        assert "\n" not in str(told.value)


def test_a_new_start_forgets_what_the_cloud_has(outbox, path):
    outbox.put([said(k) for k in range(5)])
    outbox.synchronize({})
    outbox.acknowledge(0, 2)
    outbox.close()
    with started(path, "another") as again:
        again.synchronize({0: 3})
        assert list(drain(again)) == [(0, 3), (0, 4)]
    with started(path, "a third"):
        pass
    with sqlite3.connect(path) as database:
        assert database.execute("SELECT count(*) FROM packets").fetchall() == [(0,)]
