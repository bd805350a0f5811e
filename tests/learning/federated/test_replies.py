"""Answers that no robot of ours would give: left out in a line, and the server goes on."""

import io

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.errors import TrainingError
from fcslam.learning.federated.flower import Array, ArrayRecord, Error, Message, MessageType, MetricRecord
from fcslam.learning.federated.history import ROUNDS_FILE, read_rows
from fcslam.learning.federated.messages import (
    ARRAYS_KEY,
    MAX_REASON_LENGTH,
    RoundReplies,
    record_to_weights,
    weights_to_record,
)
from tests.learning.federated.fakes import START, Fake, grid_of, run, settings, shifted


def array_of(data):
    return Array(dtype="float32", shape=(1,), stype="numpy.ndarray", data=data)


def archive():
    content = io.BytesIO()
    np.savez(content, **START)
    return content.getvalue()


def boundless():
    """The header of an array that is larger than any memory."""
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": "<f4", "fortran_order": False, "shape": (2**50,)})
    return content.getvalue()


def header(text):
    """Of an array, as somebody else might write it."""
    line = text.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line


def without_metrics(content):
    del content["metrics"]


def metrics_for_arrays(content):
    content["arrays"] = MetricRecord({"a.weight": 1.0})


def arrays_for_metrics(content):
    content["metrics"] = content["arrays"]


def with_data(data):
    def change(content):
        content["arrays"] = ArrayRecord({name: array_of(data) for name in START})

    return change


def with_figures(figures):
    def change(content):
        content["metrics"] = MetricRecord(figures)

    return change


ODD = {
    "no metrics": without_metrics,
    "metrics for arrays": metrics_for_arrays,
    "arrays for metrics": arrays_for_metrics,
    "an archive": with_data(archive()),
    "boundless": with_data(boundless()),
    "noise": with_data(b"noise"),
    "a broken archive": with_data(b"PK\x03\x04junk"),
    "an endless number": with_data(header(f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({2**70},)}}")),
    "an open bracket": with_data(header("{'descr': '<f4', ")),
    "bad indentation": with_data(header("{'descr': '<f4'}\n  x\n y")),
    "no type": with_data(header("{'descr': (), 'fortran_order': False, 'shape': (1,)}")),
    "large": with_data(bytes(100_000)),
    "odd names": with_figures({"x\ny": 1.0}),
    "long names": with_figures({"x" * 1000: 1.0}),
    "NaN": with_figures({"detector": float("nan")}),
    "infinity": with_figures({"detector": float("-inf")}),
    "beyond measure": with_figures({"detector": 1e300}),
    "many": with_figures({f"x{number}": 1.0 for number in range(1000)}),
}


def twisted_grid(robots, kind, change):
    """The first robot's answers of this kind are changed on their way."""
    grid = grid_of(robots)
    ask = grid._ask

    def twisted(message):
        reply = ask(message)
        if message.metadata.message_type == kind and message.metadata.dst_node_id == 2:
            change(reply.content)
        return reply

    grid._ask = twisted
    return grid


@pytest.mark.parametrize("odd", ODD)
def test_an_odd_answer_leaves_the_others_their_round(odd, tmp_path):
    robots = [Fake("bad"), Fake("good", 0.25)]
    state, reports = run(robots, tmp_path, grid=twisted_grid(robots, MessageType.TRAIN, ODD[odd]))
    assert [report.robots for report in reports] == [("good",)] * 2
    assert all(report.left_out["bad"] for report in reports)
    assert np.array_equal(state.weights["a.weight"], shifted(START, 0.5)["a.weight"])
    assert len(read_rows(tmp_path / ROUNDS_FILE, 9)) == 2


@pytest.mark.attack
def test_a_reply_of_another_round_does_not_count(tmp_path):
    """A robot answers every round as it did the first one."""
    first = {}

    def again(content):
        for part in content:
            content[part] = first.setdefault(part, content[part])

    robots = [Fake("bad"), Fake("good", 0.25)]
    _, reports = run(robots, tmp_path, grid=twisted_grid(robots, MessageType.TRAIN, again))
    assert [report.robots for report in reports] == [("bad", "good"), ("good",)]
    assert "an answer by bad about version" in reports[1].left_out["bad"]


@pytest.mark.parametrize("odd", ["no metrics", "odd names", "long names", "many", "NaN", "infinity", "beyond measure"])
def test_who_judges_oddly_does_not_judge(odd, tmp_path):
    robots = [Fake("bad"), Fake("good", 0.25)]
    state, _ = run(robots, tmp_path, grid=twisted_grid(robots, MessageType.EVALUATE, ODD[odd]), evaluate_fn=None)
    assert state.best_scores == {"good": 0.5}


def test_reasons_are_short_lines(tmp_path):
    robots = [Fake("bad"), Fake("good")]
    grid = grid_of(robots)
    ask = grid._ask

    def shouting(message):
        if message.metadata.dst_node_id == 2 and message.metadata.message_type == MessageType.TRAIN:
            return Message(Error(7, "\x1b[2J\n" + "a" * 200_000), reply_to=message)
        return ask(message)

    grid._ask = shouting
    _, reports = run(robots, tmp_path, grid=grid)
    assert {len(report.left_out["bad"]) for report in reports} == {MAX_REASON_LENGTH}
    assert all(report.left_out["bad"].isprintable() for report in reports)
    assert len(read_rows(tmp_path / ROUNDS_FILE, 9)) == 2


def test_who_is_left_out_counts_for_nothing():
    answers = RoundReplies({"a": {}}, {"a": {}}, {"a": None})
    answers.leave_out("a", "late\nagain")
    assert (answers.weights, answers.losses, answers.messages) == ({}, {}, {})
    assert answers.left_out == {"a": "late again"}


def test_statistics_that_were_to_stay_are_refused_where_they_moved(tmp_path):
    def moves(weights, _round):
        return weights | {"a.running_var": weights["a.running_var"] + np.float32(0.1)}

    def stays(weights, _round):
        return weights | {"b.weight": weights["b.weight"] + np.float32(1.0)}

    robots = [Fake("bad", answer=moves), Fake("good", answer=stays)]
    state, reports = run(robots, tmp_path, settings(normalisation="frozen"))
    assert all("were to stay" in report.left_out["bad"] for report in reports)
    assert np.array_equal(state.weights["a.running_var"], START["a.running_var"])


def test_private_layers_are_in_no_reply_and_stay_as_they_are_on_the_server(tmp_path):
    sent = []
    grid = twisted_grid(
        robots := [Fake("a"), Fake("b", 0.3), Fake("c", 0.2)],
        MessageType.TRAIN,
        lambda content: sent.append(record_to_weights(content[ARRAYS_KEY])),
    )
    state, reports = run(robots, tmp_path, settings(private=["b"]), grid)
    assert [set(arrays) for arrays in sent] == [{"a.weight", "a.running_var"}] * 2
    assert list(state.weights) == list(START)
    assert np.array_equal(state.weights["b.weight"], START["b.weight"])
    assert np.allclose(state.weights["a.weight"], shifted(START, 0.4)["a.weight"])
    shared = sum(START[name].nbytes for name in ("a.weight", "a.running_var"))
    _, whole = run(robots, tmp_path / "all")
    assert [report.bytes_up < other.bytes_up for report, other in zip(reports, whole, strict=True)] == [True] * 2
    assert reports[0].bytes_up >= 3 * shared


def test_a_reply_with_private_layers_is_refused(tmp_path):
    def add(content):
        content[ARRAYS_KEY] = weights_to_record(START)

    robots = [Fake("bad"), Fake("good")]
    grid = twisted_grid(robots, MessageType.TRAIN, add)
    _, reports = run(robots, tmp_path, settings(private=["b"]), grid)
    assert all("other arrays than asked for (b.weight)" in report.left_out["bad"] for report in reports)


@pytest.mark.parametrize(("private", "said"), [(["c"], "no layer c; it has a"), (["a", "b"], "no layer is left")])
def test_private_layers_must_be_some_of_the_network(private, said, tmp_path):
    with pytest.raises(TrainingError, match=said):
        run([Fake("a")], tmp_path, settings(private=private))
