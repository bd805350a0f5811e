"""Answers that no robot of ours would give: left out in a line, and the server goes on."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fcslam.config import LONGEST_QUOTE
from fcslam.errors import InputError
from fcslam.learning.federated.client import InProcessFleet
from fcslam.learning.federated.messages import (
    TrainingReply,
    TrainingRequest,
    read_reply,
    read_request,
    write_reply,
    write_request,
)
from tests.learning.federated.fakes import START, Fake, rules, run, settings, shifted

REPLY = TrainingReply("rover", "light-1", START, {"detector": 0.5})


def figures(**found):
    return lambda reply: replace(reply, figures=found)


ODD = {
    "odd names": lambda reply: replace(reply, figures={"x\ny": 1.0}),
    "long names": figures(**{"x" * 1000: 1.0}),
    "NaN": figures(detector=float("nan")),
    "infinity": figures(detector=float("-inf")),
    "beyond measure": figures(detector=1e300),
    "many": figures(**{f"x{number}": 1.0 for number in range(1000)}),
    "no arrays": lambda reply: replace(reply, arrays={}),
    "large": lambda reply: replace(reply, arrays=reply.arrays | {"a.weight": np.zeros(100_000, np.float32)}),
}


class TwistedFleet(InProcessFleet):
    """Answers of the robot `bad` are changed on their way."""

    def __init__(self, robots, change):
        super().__init__({robot.name: robot for robot in robots})
        self._change = change

    def ask(self, robots, request, deadline_s):
        replies = super().ask(robots, request, deadline_s)
        return {name: self._change(reply) if name == "bad" else reply for name, reply in replies.items()}


def fleet():
    return [Fake("bad"), Fake("good", 0.25)]


@pytest.mark.parametrize("odd", ODD)
def test_an_odd_answer_leaves_the_others_their_round(odd, tmp_path):
    state, reports = run(fleet(), tmp_path, fleet=TwistedFleet(fleet(), ODD[odd]))
    assert [report.robots for report in reports] == [("good",)] * 2
    assert all(report.left_out["bad"] for report in reports)
    assert np.array_equal(state.weights["a.weight"], shifted(START, 0.5)["a.weight"])
    assert len(state.rows) == 2


@pytest.mark.attack
def test_a_reply_of_another_round_does_not_count(tmp_path):
    """A robot answers every round as it did the first one."""
    first = []

    def again(reply):
        first.append(reply)
        return first[0]

    _, reports = run(fleet(), tmp_path, fleet=TwistedFleet(fleet(), again))
    assert [report.robots for report in reports] == [("bad", "good"), ("good",)]
    assert "an answer by bad about version" in reports[1].left_out["bad"]


@pytest.mark.attack
def test_a_reply_cannot_name_its_sender(tmp_path):
    fleets = TwistedFleet(fleet(), lambda reply: replace(reply, robot="good"))
    _, reports = run(fleet(), tmp_path, fleet=fleets)
    assert [report.robots for report in reports] == [("good",), ("good",)]
    assert "an answer by good" in reports[0].left_out["bad"]


def test_reasons_are_short_lines(tmp_path):
    def shout(reply):
        return replace(reply, error="\x1b[2J\n" + "a" * 200_000)

    _, reports = run(fleet(), tmp_path, fleet=TwistedFleet(fleet(), shout))
    assert {len(report.left_out["bad"]) for report in reports} == {LONGEST_QUOTE}
    assert all(report.left_out["bad"].isprintable() for report in reports)


def test_statistics_that_were_to_stay_are_refused_where_they_moved(tmp_path):
    def moves(weights, _round):
        return weights | {"a.running_var": weights["a.running_var"] + np.float32(0.1)}

    def stays(weights, _round):
        return weights | {"b.weight": weights["b.weight"] + np.float32(1.0)}

    def judge(_weights):
        return np.zeros((0, 2), np.float32)

    robots = [Fake("bad", answer=moves, judge=judge), Fake("good", answer=stays, judge=judge)]
    state, reports = run(robots, tmp_path, rules=rules(fewest_pairs=1))
    assert all("were to stay" in report.left_out["bad"] for report in reports)
    assert np.array_equal(state.weights["a.running_var"], START["a.running_var"])


# ---- as bytes ----


@given(
    st.dictionaries(
        st.text(max_size=9),
        arrays.arrays(
            np.float32, arrays.array_shapes(min_dims=0, min_side=0, max_side=4), elements=st.floats(width=32)
        ),
        max_size=4,
    )
)
def test_a_reply_and_a_request_arrive_as_they_were_sent(given_arrays):
    found = read_reply(write_reply(replace(REPLY, arrays=given_arrays)))
    assert found.arrays.keys() == given_arrays.keys()
    assert all(np.array_equal(found.arrays[name], array, equal_nan=True) for name, array in given_arrays.items())
    assert (found.robot, found.version, found.figures, found.error) == ("rover", "light-1", {"detector": 0.5}, "")
    sent = TrainingRequest(True, given_arrays, "light-1", 3, "run", settings(rounds=7))
    request = read_request(write_request(sent))
    assert (request.is_training, request.round_number, request.run_id) == (True, 3, "run")
    assert request.settings == settings(rounds=7)
    assert request.weights.keys() == given_arrays.keys()


def with_header(text):
    return len(text).to_bytes(4, "little") + text


def rewritten(before, after):
    data = write_reply(REPLY)
    size = int.from_bytes(data[:4], "little")
    header = data[4 : 4 + size].replace(before, after)
    assert header != data[4 : 4 + size]
    return with_header(header) + data[4 + size :]


BROKEN = {
    "nothing": b"",
    "noise": bytes(range(200)),
    "no JSON": with_header(b"{"),
    "a list": with_header(b"[]"),
    "null": with_header(b"null"),
    "a text": with_header(b'"x"'),
    "a list of arrays": with_header(b'{"arrays": []}'),
    "deeply nested": with_header(b"[" * 100_000),
    "no arrays": with_header(b"{}"),
    "cut off": write_reply(REPLY)[:-1],
    "more behind": write_reply(REPLY) + b"x",
    "an endless array": rewritten(b"[2, 3]", b"[%d]" % 2**70),
    "endless and empty": rewritten(b"[2, 3]", b"[0, %d]" % 2**70),
    "a negative side": rewritten(b"[2, 3]", b"[-2, -3]"),
    "a side of text": rewritten(b"[2, 3]", b'["2"]'),
    "a shape of text": rewritten(b"[2, 3]", b'"23"'),
    "no shape": rewritten(b"[2, 3]", b"null"),
    "figures of text": rewritten(b"0.5", b'"half"'),
}


@pytest.mark.parametrize("data", BROKEN.values(), ids=BROKEN)
def test_bytes_that_are_no_message_are_refused(data):
    with pytest.raises(ValueError, match=r"."):
        read_reply(data)
    with pytest.raises(InputError, match="cannot be read"):
        read_request(data)
