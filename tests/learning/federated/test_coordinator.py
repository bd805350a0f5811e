"""The server's loop in one process: what it merges, whom it leaves out, how it goes on after a kill."""

import contextlib
import csv

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.learning.federated.aggregation import average
from fcslam.learning.federated.checkpoint import read_checkpoint
from fcslam.learning.federated.client import InProcessFleet
from fcslam.learning.federated.rounds import ROUNDS_FILE
from fcslam.learning.trainer import CHECKPOINT_FILE
from tests.learning.federated.fakes import START, Fake, rules, run, settings, shifted, version

pytestmark = pytest.mark.slow


def same(first, second):
    return first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)


def ragged(seed):
    """A robot whose update is another one in each coordinate and round."""

    def answer(weights, round_number):
        rng = np.random.default_rng([seed, round_number])
        return {name: (array + 0.1 * rng.random(array.shape)).astype(np.float32) for name, array in weights.items()}

    return answer


def by_hand(name, answers, before):
    """The result that a strategy should give for the answers, by an independent implementation."""
    merge = np.median if name == "fedmedian" else np.mean
    return {name: merge(np.stack([answer[name].astype(np.float64) for answer in answers]), axis=0) for name in before}


def aggregates():
    """Ways to aggregate by name; Flower's are not there without it."""
    found = {"average": average}
    with contextlib.suppress(ModuleNotFoundError):
        from fcslam.learning.federated.flower import flower_aggregate

        found |= {name: flower_aggregate(name) for name in ("fedavg", "fedmedian")}
    return found


@pytest.mark.parametrize(("name", "aggregate"), aggregates().items())
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_round_merges_as_a_hand_would(name, aggregate, share, tmp_path):
    robots = [Fake(f"r{seed}", answer=ragged(seed)) for seed in range(5)]
    state, _ = run(robots, tmp_path, settings(rounds=3), rules=rules(aggregate=aggregate, momentum=share))
    weights, momentum = START, dict.fromkeys(START, 0.0)
    for round_number in range(3):
        answers = [robot.answer(weights, round_number) for robot in robots]
        merged = by_hand(name, answers, weights)
        for array in [array for array in momentum if array != "a.running_var"]:
            momentum[array] = merged[array] - weights[array] + share * momentum[array]
            merged[array] = merged[array] + share * momentum[array]
        weights = {array: np.asarray(value, np.float32) for array, value in merged.items()}
    for array, value in weights.items():
        assert state.weights[array] == pytest.approx(value, rel=1e-6, abs=1e-6)
    assert not same(state.weights, START)


def test_a_strategy_of_your_own_sees_every_update():
    strategy = pytest.importorskip("flwr.serverapp.strategy", reason="needs fcslam[federated]")
    from fcslam.learning.federated.flower import flower_aggregate

    class First(strategy.FedAvg):
        def aggregate_train(self, server_round, replies):
            seen.append((server_round, len(replies)))
            return super().aggregate_train(server_round, replies[:1])

    seen, updates = [], [ragged(seed)(START, 0) for seed in range(5)]
    assert same(flower_aggregate(First)(3, updates), updates[0])
    assert seen == [(3, 5)]


@pytest.mark.parametrize(("robots", "most"), [(1, 0.0), (2, 0.5), (4, 0.75)])
def test_momentum_goes_no_further_than_all_robots_one_after_another(robots, most, tmp_path):
    def end(share):
        fleet = [Fake(f"r{seed}", answer=ragged(seed)) for seed in range(robots)]
        return run(fleet, tmp_path / str(share), settings(rounds=3), rules=rules(momentum=share))[0].weights

    assert same(end(0.9), end(most))
    assert same(end(0.9), end(0.2)) is (robots == 1)


def test_what_is_judged_and_released_is_a_mean_of_rounds(tmp_path):
    judged = []

    def judge(weights):
        judged.append(float(weights["b.weight"]))
        return 0.5

    chosen = settings(rounds=10, local_steps=100)
    fleet = [Fake("a", 0.1), Fake("b", 0.1)]
    state, reports = run(fleet, tmp_path, chosen, score=judge, rules=rules(smoothing=0.8))
    weight, mean, expected = 0.5, 0.5, [0.5]
    for number in range(1, 11):
        weight += 0.1
        rate = max(min((1000 - (100 * number - 1)) / 300, 1.0), 1e-5 / 2e-3)
        share = min(0.8, number / (number + 9)) * rate
        mean = share * mean + (1.0 - share) * weight
        expected.append(mean)
    assert judged == pytest.approx(expected)
    assert state.weights["b.weight"] == pytest.approx(1.5), "training goes on from the weights themselves"
    assert state.best["b.weight"] == state.average["b.weight"] == pytest.approx(mean)
    assert reports[-1].version == version(state.best)


@pytest.mark.parametrize("moment", ["in training", "after a round"])
def test_a_killed_server_ends_as_if_it_had_not_been(moment, tmp_path):
    chosen, own = settings(rounds=4), rules(momentum=0.5, smoothing=0.8)
    fleet = [Fake("a", answer=ragged(1)), Fake("b", answer=ragged(2))]
    whole, rows = run(fleet, tmp_path / "whole", chosen, rules=own)

    def killed(weights, round_number):
        if round_number == 2:
            raise KeyboardInterrupt
        return ragged(2)(weights, round_number)

    def watch(weights):
        if len(judged := judgements) == 3 and moment == "after a round":
            raise KeyboardInterrupt
        judged.append(weights)
        return 0.5

    judgements = []
    second = Fake("b", answer=killed if moment == "in training" else ragged(2))
    with pytest.raises(KeyboardInterrupt):
        run([Fake("a", answer=ragged(1)), second], tmp_path / "torn", chosen, rules=own, score=watch)
    fleet = [Fake("a", answer=ragged(1)), Fake("b", answer=ragged(2))]
    resumed, late = run(fleet, tmp_path / "torn", chosen, rules=own)
    assert same(whole.weights, resumed.weights)
    assert [report.round_number for report in late] == [3, 4]
    assert [report.version for report in rows[2:]] == [report.version for report in late]
    with (tmp_path / "torn" / ROUNDS_FILE).open() as file:
        assert [row["round"] for row in csv.DictReader(file)] == ["1", "2", "3", "4"]


def test_a_kill_between_table_and_checkpoint_repeats_the_round(tmp_path):
    robots = [Fake("a")]
    run(robots, tmp_path, settings(rounds=1))
    checkpoint = (tmp_path / CHECKPOINT_FILE).read_bytes()
    run(robots, tmp_path, settings(rounds=2))
    (tmp_path / CHECKPOINT_FILE).write_bytes(checkpoint)
    run(robots, tmp_path, settings(rounds=3))
    with (tmp_path / ROUNDS_FILE).open() as file:
        assert [row["round"] for row in csv.DictReader(file)] == ["1", "2", "3"]


def refuses(*_args):
    raise InputError("no images here")


def breaks(*_args):
    raise RuntimeError("out of memory")


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (refuses, "no images here"),
        (breaks, "RuntimeError: out of memory"),
        (lambda weights, _round: shifted(weights, np.nan), "not finite"),
        (lambda weights, _round: {"a.weight": weights["a.weight"]}, "other arrays"),
        (lambda weights, _round: weights | {"c": weights["b.weight"]}, "other arrays"),
        (lambda weights, _round: weights | {"b.weight": np.zeros(2, np.float32)}, "shape (2,)"),
        (lambda weights, _round: weights | {"b.weight": np.zeros(())}, "float64"),
        (lambda weights, _round: weights | {"a.running_var": np.full(2, -1, np.float32)}, "negative variances"),
    ],
)
def test_a_robot_that_fails_is_left_out_with_a_reason(answer, reason, tmp_path):
    state, reports = run([Fake("good", 0.25), Fake("bad", answer=answer)], tmp_path)
    assert all(reason in report.left_out["bad"] for report in reports)
    assert [report.robots for report in reports] == [("good",), ("good",)]
    assert same(state.weights, shifted(START, 0.5))


def test_stragglers_are_left_out_and_asked_again(tmp_path):
    now = [0.0]

    def slowly(weights, round_number):
        now[0] += 100.0 if round_number == 0 else 1.0
        return shifted(weights, 1.0)

    robots = [Fake("fast", 0.0), Fake("slow", answer=slowly)]
    fleet = InProcessFleet({robot.name: robot for robot in robots}, lambda: now[0])
    state, reports = run(robots, tmp_path, settings(deadline_s=10.0), fleet)
    assert reports[0].left_out == {"slow": "no answer: gone, or later than the deadline"}
    assert reports[1].robots == ("fast", "slow")
    assert same(state.weights, shifted(START, 0.5))


def test_only_a_share_takes_part_and_all_in_turn(tmp_path):
    robots = [Fake(f"r{index}") for index in range(6)]
    _, reports = run(robots, tmp_path, settings(rounds=12, participation=0.5))
    assert {len(report.robots) for report in reports} == {3}
    assert all(robot.asked for robot in robots)
    assert len({report.robots for report in reports}) > 1


def test_without_anybody_the_server_says_so_or_waits(tmp_path):
    robots = [Fake("a", answer=refuses)]
    with pytest.raises(InputError, match="no round can be completed: a: no images here"):
        run(robots, tmp_path)
    waited = []

    def wait(reason):
        waited.append(reason)
        robots[0].answer = None

    state, _ = run(robots, tmp_path, wait=wait)
    assert waited == ["a: no images here"]
    assert state.rounds_done == 2


def test_a_worse_detector_is_not_released_and_a_collapsed_one_is_undone(tmp_path):
    scores = iter([0.5, 0.6, 0.55, 0.2, 0.6])
    robots = [Fake("a", answer=ragged(1))]
    state, reports = run(robots, tmp_path, settings(rounds=4), score=lambda _: next(scores))
    assert [report.released for report in reports] == [True, False, False, True]
    assert [report.returned for report in reports] == [False, False, True, False]
    first = ragged(1)(START, 0)
    assert same(state.weights, ragged(1)(first, 3))
    assert state.best_round == 4


def test_what_does_not_change_stays_to_the_last_bit_in_the_mean(tmp_path):
    frozen = {"a.running_var": START["a.running_var"] / 3}
    robot = Fake("a", answer=lambda weights, _round: shifted(weights, 0.1) | frozen)
    state, _ = run([robot], tmp_path, settings(rounds=12), start=START | frozen, rules=rules(smoothing=0.7))
    assert np.array_equal(state.average["a.running_var"], frozen["a.running_var"])
    assert all(isinstance(array, np.ndarray) for array in state.average.values())


def test_a_start_that_beats_what_follows_is_no_place_to_go_back_to(tmp_path):
    scores = iter([0.9, 0.1, 0.3])
    state, reports = run([Fake("a", 0.5)], tmp_path, score=lambda _: next(scores))
    assert [report.returned for report in reports] == [False, False]
    assert same(state.weights, shifted(START, 1.0))


def test_robots_that_were_asked_before_a_kill_are_counted(tmp_path):
    def kills(_weights, _round):
        raise KeyboardInterrupt

    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            run([Fake("a"), Fake("b", answer=kills)], tmp_path)
    state = read_checkpoint(tmp_path, settings(), START, version(START))
    assert (state.rounds_done, state.times_asked) == (0, {"a": 3, "b": 3})
    _, reports = run([Fake("a"), Fake("b")], tmp_path)
    size = reports[0].bytes_up
    assert [report.bytes_down for report in reports] == [size, size], "what is sent in this round"


def test_a_checkpoint_of_another_run_is_refused_but_more_rounds_are_not(tmp_path):
    run([Fake("a")], tmp_path)
    with pytest.raises(InputError, match=r"other settings \(local_steps\)"):
        run([Fake("a")], tmp_path, settings(local_steps=2))
    with pytest.raises(InputError, match="began from"):
        run([Fake("a")], tmp_path, start=shifted(START, 1.0))
    with pytest.raises(InputError, match="its weights do not fit"):
        run([Fake("a")], tmp_path, start={"other": np.zeros(3, np.float32)})
    state, reports = run([Fake("a")], tmp_path, settings(rounds=3))
    assert (state.rounds_done, len(reports)) == (3, 1)


def test_a_broken_checkpoint_is_told_as_such(tmp_path):
    run([Fake("a")], tmp_path)
    (tmp_path / CHECKPOINT_FILE).write_bytes(b"nonsense")
    with pytest.raises(InputError, match="is damaged"):
        run([Fake("a")], tmp_path)
