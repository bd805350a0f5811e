"""The order of effect: every packet once, a session's in the order of their numbers, whatever the order of arrival."""

from hypothesis import given
from hypothesis import strategies as st

from fcslam.cloud.packet_log import PacketLog, PacketNumber

NUMBERS = st.builds(PacketNumber, st.sampled_from(["a", "b", "a+1"]), st.integers(0, 8))


def run(events):
    """Add (True) or refuse (False) packets; returns the log and what took effect, in order."""
    log, effects = PacketLog(), []
    for is_added, number in events:
        (log.add(number, float(number.sequence)) if is_added else log.refuse(number))
        effects += log.ready(number.session)
    return log, effects


@given(st.lists(st.tuples(st.booleans(), NUMBERS), max_size=60))
def test_every_packet_takes_effect_once_in_the_order_of_its_session(events):
    log, effects = run(events)
    assert len(set(effects)) == len(effects)
    arrived = {number for _, number in events}
    for session in {number.session for number in arrived}:
        end = next(k for k in range(10) if PacketNumber(session, k) not in arrived)
        assert log.next_sequence(session) == end
        taken = [number.sequence for number in effects if number.session == session]
        assert taken == sorted(taken)
        assert set(taken) <= set(range(end))
        added = {n.sequence for is_added, n in events if is_added and n.session == session}
        refused = {n.sequence for is_added, n in events if not is_added and n.session == session}
        assert added - refused & set(range(end)) >= set(taken) - refused
        assert {k for k in added - refused if k < end} <= set(taken)
    assert log.released == sum(log.next_sequence(session) for session in log.sessions)


@given(st.permutations([PacketNumber(s, k) for s in ("a", "b") for k in range(5)]))
def test_the_canonical_order_is_a_function_of_the_set(numbers):
    log, effects = run([(True, number) for number in numbers])
    order = list(log.canonical((float(number.sequence), number) for number in numbers))
    assert order == [PacketNumber(s, k) for k in range(5) for s in ("a", "b")]
    assert sorted(effects) == sorted(order)
    assert log.is_canonical == (list(numbers) == order)


def test_the_canonical_order_keeps_that_of_a_session_and_leaves_out_what_was_refused():
    log, _ = run([(True, PacketNumber("a", k)) for k in range(5)])
    log.refuse(PacketNumber("a", 3))
    arrived = [(2.0, PacketNumber("a", 0)), (1.0, PacketNumber("a", 1)), *((k, PacketNumber("a", k)) for k in (2, 4))]
    assert [number.sequence for number in log.canonical(arrived)] == [0, 1, 2, 4]


def test_a_packet_that_fails_is_given_again():
    log = PacketLog()
    for k in range(2):
        log.add(PacketNumber("a", k), 0.0)
    first = next(log.ready("a"))  # whoever applies it fails and asks for no other
    assert first.sequence == 0
    assert log.next_sequence("a") == 0
    assert [number.sequence for number in log.ready("a")] == [0, 1]


@given(st.sets(st.integers(0, 9)), st.lists(st.integers(0, 9), max_size=8))
def test_what_would_wait_is_what_waits(arrived, new):
    log, _ = run([(True, PacketNumber("a", k)) for k in sorted(arrived)])
    before = log.next_sequence("a")
    foreseen = {number.sequence for number in log.would_wait(PacketNumber("a", k) for k in new)}
    _, effects = run([(True, PacketNumber("a", k)) for k in [*range(before), *new]])
    assert foreseen == set(new) - {number.sequence for number in effects}
