"""Instances share the missions of a store: one worker each, by leases that the server's clock ends."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import InputError, StoreError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.mission.mission_store import MissionStore
from fcslam.service.audit_log import audit_table
from fcslam.service.intake import AGENT_LEASE_S
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.shared.files import SharedDetectors
from fcslam.service.shared.instance import GRACE_S, Instance, fair_part
from fcslam.service.shared.mission_tables import Lease, MissionTables
from fcslam.service.shared.missions import SharedAgents, SharedMission
from fcslam.service.shared.registry import Registry
from tests.mission.test_mission_store import packet
from tests.waiting import wait_for


class Started:
    """A worker that only knows whether it runs."""

    pid, starts, applied, is_ready = 1, 1, 0, True

    def __init__(self, mission, lease):
        self.mission, self.lease, self.is_stopped = mission, lease, False

    def notify(self):
        pass

    def stop(self):
        self.is_stopped = True


def wanted(registry, postgres, name):
    number = registry.create(name)
    MissionStore(MissionTables(postgres, number)).configure(CloudConfig())
    return number


def instance(postgres, name, room=10, clock=time.monotonic, kind=Registry, follow=lambda: None):
    workers = []

    def launch(mission, lease):
        workers.append(Started(mission, lease))
        return workers[-1]

    registry = kind(postgres, name, f"process of {name}", LONG_S)
    return Instance(registry, name, room, launch, lambda *_: None, follow, clock), workers


LONG_S = 3600.0
"""Leases last until a test ends them, however slow the machine is."""


def end_leases(postgres, name):
    """What the server's clock does to an instance that renews nothing."""
    for table, column in (("missions", "holder"), ("instances", "name")):
        postgres.rows(f"UPDATE {table} SET expires = '-infinity' WHERE {column} = ? RETURNING 1", (name,))


def held(registry):
    return {mission.name: mission.holder for mission in registry.missions() if mission.is_held}


def test_of_two_looks_at_once_the_later_one_counts(registry, postgres):
    """Requests look, too, such as the one that opens a mission."""
    is_read, may_end = threading.Event(), threading.Event()

    class Slow(Registry):
        def missions(self):
            found = super().missions()
            if threading.current_thread() is not threading.main_thread():
                is_read.set()
                may_end.wait(0.5)
            return found

    one, _ = instance(postgres, "one", kind=Slow)
    earlier = threading.Thread(target=one.look)
    earlier.start()
    is_read.wait()
    wanted(registry, postgres, "new")
    one.look()
    may_end.set()
    earlier.join()
    assert list(one.known) == ["new"]


def test_of_two_that_claim_at_once_each_mission_gets_one_worker(registry, postgres):
    for k in range(20):
        wanted(registry, postgres, f"m{k}")
    claimed: list[Lease] = []
    registries = [Registry(postgres, f"i{k}", f"p{k}") for k in range(4)]
    threads = [threading.Thread(target=lambda one=one: claimed.extend(one.claim(20))) for one in registries]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    claimed += registry.claim(20)
    assert len(claimed) == 20 == len({lease.mission for lease in claimed})


def test_a_lease_ends_by_the_servers_clock_and_one_that_is_renewed_does_not(registry, postgres):
    for name in ("kept", "lost"):
        wanted(registry, postgres, name)
    kept, lost = sorted(Registry(postgres, "one", "process of one", 0.3).claim(2))
    assert registry.renew([(kept, True)]) == {kept}
    other = Registry(postgres, "other", "process of other")
    taken = []
    wait_for(lambda: taken.extend(other.claim(9)) or taken)
    assert taken == [Lease(lost.mission, lost.fence + 1)]
    assert registry.renew([(kept, True), (lost, True)]) == {kept}


def test_the_clock_of_an_instance_may_be_wrong_by_minutes(registry, postgres, monkeypatch):
    number = wanted(registry, postgres, "timed")
    (lease,) = registry.claim(1)
    for wrong_s in (-600.0, 600.0):
        now = time.time() + wrong_s
        monkeypatch.setattr(time, "time", lambda now=now: now)
        assert Registry(postgres, "wrong", "process of wrong").claim(9) == []
        assert registry.renew([(lease, True)]) == {lease}
        MissionStore(MissionTables(postgres, number, lease)).progress(1, [])


def test_after_the_store_was_gone_the_others_may_renew_before_anybody_claims(registry, postgres):
    wanted(registry, postgres, "m")
    (lease,) = registry.claim(1)
    now, seen, is_gone = [0.0], [], threading.Event()

    class Failing(Registry):
        def register(self, room):
            seen.append(is_gone.is_set())
            if is_gone.is_set():
                raise StoreError("gone")
            return super().register(room)

    other, workers = instance(postgres, "other", clock=lambda: now[0], kind=Failing)
    is_gone.set()
    other.start()
    wait_for(lambda: True in seen)
    end_leases(postgres, "one")
    is_gone.clear()
    wait_for(lambda: seen.count(False) > 2)
    assert not workers
    assert registry.renew([(lease, True)]) == {lease}
    end_leases(postgres, "one")
    now[0] += GRACE_S
    wait_for(lambda: workers)
    other.close()


def test_two_instances_of_one_name_are_refused_until_the_first_is_gone(registry, postgres):
    one, _ = instance(postgres, "same")
    again = Registry(postgres, "same", "another process", 0.3)
    nothing = lambda *_: None  # noqa: E731
    with pytest.raises(InputError, match="is called 'same'; stop it, or give this one another --port"):
        Instance(again, "same", 1, nothing, nothing, nothing)
    one.close()
    Instance(again, "same", 1, nothing, nothing, nothing).close()


@pytest.mark.slow
def test_missions_are_spread_and_those_of_an_instance_that_ends_are_taken_over(registry, postgres):
    for k in range(6):
        wanted(registry, postgres, f"m{k}")
    one, of_one = instance(postgres, "one")
    one.start()
    wait_for(lambda: len(held(registry)) == 6)
    two, of_two = instance(postgres, "two")
    two.start()
    wait_for(lambda: sorted(held(registry).values()).count("two") == 3 and len(held(registry)) == 6)
    assert sum(not worker.is_stopped for worker in of_one) == 3
    two.close()
    assert all(worker.is_stopped for worker in of_two)
    wait_for(lambda: list(held(registry).values()) == ["one"] * 6)
    one.close()
    three, of_three = instance(postgres, "three")
    three.start()
    wait_for(lambda: list(held(registry).values()) == ["three"] * 6 and len(of_three) == 6)
    assert {worker.lease.fence for worker in of_three} >= {2}
    three.close()


def test_an_instance_takes_no_more_missions_than_it_has_room_for(registry, postgres):
    for k in range(5):
        wanted(registry, postgres, f"m{k}")
    small, of_small = instance(postgres, "small", room=2)
    for _ in range(3):
        small.step()
        assert len(held(registry)) == len(of_small) == 2
    small.close()


def test_an_instance_that_cannot_take_over_a_detector_takes_missions(registry, postgres):
    wanted(registry, postgres, "m")
    one, _ = instance(postgres, "one", follow=lambda: int("no network"))
    with pytest.raises(ValueError, match="no network"):
        one.step()
    assert held(registry) == {"m": "one"}
    one.close()


def test_the_open_mission_has_a_worker_before_others(registry, postgres):
    numbers = {name: wanted(registry, postgres, name) for name in ("old", "open", "new")}
    registry.open(numbers["open"])
    registry.leave()
    one, _ = instance(postgres, "one", room=1)
    one.step()
    assert held(registry) == {"open": "one"}
    registry.open(numbers["new"])
    for _ in range(4):
        one.step()
        wait_for(lambda: len(held(registry)) == 0 or "new" in held(registry))
    assert held(registry) == {"new": "one"}, "another one makes room for it"
    one.close()


def test_who_only_reads_a_mission_wakes_it_not(registry, postgres):
    store = MissionStore(MissionTables(postgres, wanted(registry, postgres, "old")))
    postgres.rows("UPDATE missions SET is_wanted = false RETURNING 1")
    store.configure(CloudConfig())
    assert (store.envelopes(), store.applied(), store.edits(), store.refusals("a")) == ([], 0, [], [])
    assert [mission.is_wanted for mission in registry.missions()] == [False]
    store.put([packet()], 0.0)
    assert [mission.is_wanted for mission in registry.missions()] == [True]


def test_a_mission_in_which_nothing_happens_rests_until_its_next_packet(registry, postgres):
    number = wanted(registry, postgres, "quiet")
    one, workers = instance(postgres, "one")
    store = MissionStore(MissionTables(postgres, number))

    def after(minutes):
        postgres.rows(f"UPDATE missions SET touched = touched - interval '{minutes} minutes' RETURNING 1")

    one.step()
    after(29)
    store.put([packet()], 0.0)
    after(29)
    one.step()
    assert held(registry) == {"quiet": "one"}
    after(2)
    one.step()
    wait_for(lambda: held(registry) == {})
    assert workers[0].is_stopped
    store.put([packet(sequence=1)], 0.0)
    one.step()
    assert held(registry) == {"quiet": "one"}
    assert workers[1].lease.fence == 2
    one.close()


@given(wanted=st.integers(0, 60), rooms=st.lists(st.integers(0, 30), min_size=1, max_size=6))
def test_parts_hold_all_missions_if_there_is_room_and_differ_only_where_there_is_none(wanted, rooms):
    parts = [fair_part(wanted, rooms, room) for room in rooms]
    assert all(part <= room for part, room in zip(parts, rooms, strict=True))
    assert sum(parts) >= min(wanted, sum(rooms))
    assert all(part == max(parts) for part, room in zip(parts, rooms, strict=True) if part < room)
    assert max(parts) == 0 or sum(min(room, max(parts) - 1) for room in rooms) < wanted


def test_another_agent_is_refused_by_every_instance(registry, postgres):
    number = wanted(registry, postgres, "robots")
    now = [0.0]
    here, there = (SharedAgents(postgres, number, lambda: now[0]) for _ in range(2))
    here.hold("a", "x")
    there.hold("b", "y")
    with pytest.raises(InputError, match="another process sends as this robot"):
        there.hold("a", "z")
    there.hold("a", "x")  # a robot may change the instance
    now[0] += AGENT_LEASE_S
    here.hold("a", "x")
    assert there.silent_s("a") < 5.0
    assert there.silent_s("c") is None
    here.end("a")
    there.hold("a", "z")
    with pytest.raises(InputError, match="another process sends as this robot"):
        here.hold("a", "x")


def test_joint_maps_that_nobody_shared_are_not_looked_for_at_each_request(registry, postgres, tmp_path):
    asked, (one, _) = [], instance(postgres, "one")

    class Empty:
        def rows(self, *query):
            asked.append(query)
            return []

    mission = SharedMission(7, MissionFolder(tmp_path), Empty(), None, None, one)
    assert not any(mission.joint_maps.exists() for _ in range(20))
    assert len(asked) < 20
    one.close()


def test_the_audit_log_has_the_lines_of_all_instances(registry, postgres):
    with ThreadPoolExecutor(1) as writer:
        logs = [audit_table(postgres, name, writer) for name in ("one", "two")]
        for k in range(4):
            logs[k % 2].record("boss", "", "POST /x", 200, {"number": k})
    assert [entry.content["number"] for entry in logs[1].newest(3)] == [1, 2, 3]


def test_other_instances_announce_a_detector_and_have_its_file(registry, postgres, tmp_path):
    one, other = (SharedDetectors(tmp_path / name, postgres) for name in ("one", "other"))
    file = one.announce(BUNDLED_NETWORK.read_bytes())
    assert file.channel not in other.announced()
    nothing = lambda *_: None  # noqa: E731
    following = Instance(registry, "one", 0, nothing, nothing, other.follow)
    following.step()
    following.close()
    assert other.announced() == {file.channel: file}
    assert other.path(file.channel, file.version).read_bytes() == BUNDLED_NETWORK.read_bytes()
