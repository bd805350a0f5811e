"""Runs federated training: every round trains on the robots, aggregates, evaluates and decides.

The result is a function of the settings, the initial weights and the replies. The order of arrival does not matter. A
coordinator that was killed continues from its last checkpoint, with the same result.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np

from fcslam.errors import InputError
from fcslam.learning.federated.aggregation import Aggregate, average, next_weights
from fcslam.learning.federated.checkpoint import CHECKPOINT_FILE, CoordinatorState, read_state, run_id, write_state
from fcslam.learning.federated.evaluation import (
    PUBLIC_IMAGES,
    EvaluateFn,
    Metrics,
    VersionComparison,
    combined_score,
    decide,
    valid_metrics,
)
from fcslam.learning.federated.fleets import TrainingFleet
from fcslam.learning.federated.held_out import Judgement, check_judgement
from fcslam.learning.federated.history import ROUNDS_FILE, RoundReport, Row, read_rows, write_rows
from fcslam.learning.federated.messages import (
    PAIRS,
    Lesson,
    RoundReplies,
    TrainingReply,
    TrainingRequest,
    checked_reply,
    collect_updates,
    printable_line,
)
from fcslam.learning.federated.screening import BOUNDS, ScreeningBounds, screen, update_length
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights, interpolate_weights, size_bytes
from fcslam.learning.training_step import learning_rate

_Answer = TypeVar("_Answer")
_SAMPLING_SEED: Final = 77
"""Separates the drawing of robots from other uses of the training seed."""


@dataclass(frozen=True, slots=True)
class RoundRules:
    """What a coordinator does with the updates of a round."""

    aggregate: Aggregate = average
    bounds: ScreeningBounds = BOUNDS
    momentum: float = 0.5
    """Share of Nesterov's momentum kept between rounds, at most 1 - 1/N for N robots."""
    smoothing: float = 0.8
    """Share of earlier rounds in the moving average of which versions are made; it decreases with the learning rate."""
    judge_every: int = 5
    """Rounds between two evaluations; only evaluated versions and the last one can be released."""
    collapse: float = 0.15
    """Drop of the score below the best version at which training returns to that version."""
    fewest_pairs: int | None = None
    """Held-out pairs of the robots by which a release is decided; None if they or the coordinator evaluate on images,
    and every version is released that is not worse. With pairs, robots train on points that they saw again.
    """

    @property
    def lesson(self) -> Lesson:
        """What robots train on."""
        return "images" if self.fewest_pairs is None else "revisits"


RULES: Final = RoundRules()


@dataclass(frozen=True, slots=True)
class CoordinatorHooks:
    """Functions that the coordinator calls outside itself."""

    version: Callable[[Weights], str]
    """Gives the detector version of weights."""
    evaluate_fn: EvaluateFn | None = None
    """Evaluates weights on public images; if None, the robots evaluate on images that they held out."""
    on_round: Callable[[RoundReport], None] = lambda _report: None
    """Called with the report of each round, once its results are on disk."""
    on_release: Callable[[Weights], None] = lambda _weights: None
    """Called with the weights of each released version, before ``on_round``. A start calls it again with the newest
    ones, as the one before may have been killed before it called.
    """
    wait: Callable[[str], None] | None = None
    """Called with the reason when a round cannot be completed; returns when to try again. If None, training fails."""
    clock: Callable[[], float] = time.monotonic
    """Seconds since any fixed moment."""


class Decision(NamedTuple):
    """Decision on the version that a round has made."""

    released: bool
    """It is the best so far and becomes the new detector."""
    returned: bool
    """It is so bad that training returns to the best version."""


class Coordinator:
    """Federated training in a folder."""

    def __init__(
        self,
        fleet: TrainingFleet,
        settings: FederatedSettings,
        initial: Weights,
        folder: Path,
        hooks: CoordinatorHooks,
        rules: RoundRules = RULES,
    ) -> None:
        self._fleet, self._settings, self._folder, self._hooks, self._rules = fleet, settings, folder, hooks, rules
        self._initial, self._origin = initial, hooks.version(initial)
        self._run_id = run_id(settings, self._origin)

    def run(self) -> CoordinatorState:
        """Do all rounds that are not done yet."""
        state, rows = self._resume()
        if state.best_round > 0:
            self._hooks.on_release(state.best)
        while state.rounds_done < self._settings.rounds:
            state, report = self._round(state)
            rows.append(report.row())
            write_rows(self._folder / ROUNDS_FILE, rows)
            write_state(self._folder / CHECKPOINT_FILE, state, self._settings)
            if report.released:
                self._hooks.on_release(state.best)
            self._hooks.on_round(report)
        return state

    def _resume(self) -> tuple[CoordinatorState, list[Row]]:
        """The state and the table of rounds in the folder, or those of a new run."""
        state = read_state(self._folder / CHECKPOINT_FILE, self._settings, self._initial, self._origin)
        if state is not None:
            return state, read_rows(self._folder / ROUNDS_FILE, state.rounds_done)
        # A version must be at least as good to be released. Held-out pairs are judged with both versions each time.
        metrics = {} if self._rules.fewest_pairs is not None else self._measure(self._initial, 0)
        scores = {evaluator: combined_score(found) for evaluator, found in metrics.items()}
        return CoordinatorState.at_start(self._initial, self._origin, scores), []

    def _round(self, state: CoordinatorState) -> tuple[CoordinatorState, RoundReport]:
        started, number = self._hooks.clock(), state.rounds_done + 1

        replies, trained = self._train(state)
        # Updates are added in the order of the robots' names, as sums of floats depend on it.
        updates = [replies.weights[robot] for robot in sorted(replies.weights)]
        weights, momentum = next_weights(
            self._rules.aggregate, number, updates, state.weights, state.momentum, self._rules.momentum
        )
        candidate = self._average(weights, state)
        comparison = self._evaluate(candidate, state, replies)
        decision = self._decide(comparison, state)

        following = CoordinatorState(
            rounds_done=number,
            weights=trained.best if decision.returned else weights,
            average=trained.best if decision.returned else candidate,
            best=candidate if decision.released else trained.best,
            best_scores=comparison.scores if decision.released else comparison.best,
            best_round=number if decision.released else trained.best_round,
            momentum={} if decision.returned else momentum,
            times_asked=trained.times_asked,
            origin=trained.origin,
            update_length=update_length(replies.weights, state.weights),
        )
        report = RoundReport(
            round_number=number,
            version=self._hooks.version(candidate),
            robots=tuple(sorted(replies.weights)),
            left_out=replies.left_out,
            losses=_means(replies.losses),
            metrics=comparison.metrics,
            score=comparison.score,
            released=decision.released,
            returned=decision.returned,
            reason="" if comparison.gate is None else comparison.gate.reason,
            bytes_down=(Counter(trained.times_asked) - Counter(state.times_asked)).total() * size_bytes(state.weights),
            bytes_up=replies.bytes_up,
            seconds=self._hooks.clock() - started,
        )
        return following, report

    def _train(self, state: CoordinatorState) -> tuple[RoundReplies, CoordinatorState]:
        """Have robots train until enough of their updates have passed screening."""
        replies, state = self._train_once(state)
        while len(replies.weights) < self._settings.minimum_robots:
            self._wait_or_fail(_joined(replies.left_out))
            replies, state = self._train_once(state)
        return replies, state

    def _train_once(self, state: CoordinatorState) -> tuple[RoundReplies, CoordinatorState]:
        """One request to a sample of the robots. The state counts the robots that were asked."""
        rng = np.random.default_rng([self._settings.training.seed, state.rounds_done, _SAMPLING_SEED])
        chosen = _sample(self._connected(), self._settings.participation, self._settings.minimum_robots, rng)
        # Counted before the request leaves: after a crash nobody could say which updates have left the robots.
        state = replace(state, times_asked=Counter(state.times_asked) + Counter(chosen))
        write_state(self._folder / CHECKPOINT_FILE, state, self._settings)
        request = self._request(state.weights, state.rounds_done, is_training=True)
        replies = collect_updates(self._fleet.ask(chosen, request, self._settings.deadline_s), chosen, request.version)
        frozen = self._rules.lesson == "revisits"
        refused = screen(replies.weights, state.weights, self._rules.bounds, frozen, state.update_length)
        for robot, reason in refused.items():
            replies.leave_out(robot, reason)
        return replies, state

    def _average(self, weights: Weights, state: CoordinatorState) -> Weights:
        """The moving average of the rounds' weights, which is evaluated and released.

        It smooths the noise of training. The lower the learning rate, the less noise there is, so the less is kept of
        the earlier average. Early averages forget the initial weights, which training leaves behind quickly.
        """
        number, training = state.rounds_done + 1, self._settings.client_training()
        rate = learning_rate(training, number * self._settings.local_steps - 1)
        kept = min(self._rules.smoothing, number / (number + 9)) * min(rate / training.learning_rate, 1.0)
        return interpolate_weights(state.average, weights, kept)

    def _evaluate(self, weights: Weights, state: CoordinatorState, replies: RoundReplies) -> VersionComparison:
        """Compare weights with the best ones. Evaluators that have not measured the best ones do so now."""
        number = state.rounds_done + 1
        if number % self._rules.judge_every != 0 and number != self._settings.rounds:
            return VersionComparison({}, state.best_scores)
        if self._rules.fewest_pairs is not None:
            return self._ask_gate(self._rules.fewest_pairs, weights, state, replies)
        metrics = self._measure(weights, state.rounds_done)
        newcomers = metrics.keys() - state.best_scores.keys()
        best: Mapping[str, Metrics] = {}
        if newcomers and self._hooks.evaluate_fn is not None:
            best = {PUBLIC_IMAGES: self._hooks.evaluate_fn(state.best)}
        elif newcomers:
            present = [robot for robot in self._fleet.robots() if robot in newcomers]
            best, failed = self._ask(present, state.best, state.rounds_done, _metrics)
            replies.add_notes({f"judging by {robot}": reason for robot, reason in failed.items()})
        scores = {evaluator: combined_score(found) for evaluator, found in best.items()}
        return VersionComparison(metrics, {**state.best_scores, **scores})

    def _ask_gate(
        self, fewest_pairs: int, weights: Weights, state: CoordinatorState, replies: RoundReplies
    ) -> VersionComparison:
        """Have all robots that are there judge the weights and the best ones on the pairs that they hold out."""
        present, reports = self._fleet.robots(), []
        for judged in (weights, state.best):
            found, failed = self._ask(present, judged, state.rounds_done, _judgement)
            replies.add_notes({f"judging by {robot}": reason for robot, reason in failed.items()})
            reports.append(found)
        decision = decide(reports[0], reports[1], fewest_pairs, self._settings.training.seed)
        return VersionComparison({}, state.best_scores, decision)

    def _decide(self, comparison: VersionComparison, state: CoordinatorState) -> Decision:
        """Release a version that is at least as good as the best one; return to the best one after a collapse."""
        gain, gate = comparison.gain, comparison.gate
        if gain is None:
            return Decision(released=False, returned=False)
        # Never back to the initial weights: as long as training costs something at first, nothing would be learnt.
        is_collapse = state.best_round > 0 and gain < -self._rules.collapse
        if gate is not None:
            return Decision(gate.released, is_collapse and gate.pairs > 0)
        return Decision(gain >= 0.0, is_collapse)

    def _measure(self, weights: Weights, round_number: int) -> Mapping[str, Metrics]:
        """Metrics of the weights on public images, or else by all robots that can give them, at least one."""
        if self._hooks.evaluate_fn is not None:
            return {PUBLIC_IMAGES: self._hooks.evaluate_fn(weights)}
        found, failed = self._ask(self._connected(), weights, round_number, _metrics)
        while not found:
            self._wait_or_fail(_joined(failed))
            found, failed = self._ask(self._connected(), weights, round_number, _metrics)
        return found

    def _ask(
        self, robots: list[str], weights: Weights, round_number: int, read: Callable[[TrainingReply], _Answer]
    ) -> tuple[dict[str, _Answer], dict[str, str]]:
        """The answers of these robots about the weights, and the reasons why some gave none that can be read."""
        request = self._request(weights, round_number, is_training=False)
        found: dict[str, _Answer] = {}
        failed: dict[str, str] = {}
        for robot, reply in self._fleet.ask(robots, request, self._settings.deadline_s).items():
            try:
                found[robot] = read(checked_reply(reply, robot, request.version))
            except ValueError as error:
                failed[robot] = printable_line(str(error))
        return found, failed

    def _connected(self) -> list[str]:
        """The robots that are there, as soon as they are enough."""
        while len(connected := self._fleet.robots()) < self._settings.minimum_robots:
            self._wait_or_fail(f"{len(connected)} robots are there, {self._settings.minimum_robots} needed")
        return connected

    def _wait_or_fail(self, reason: str) -> None:
        if self._hooks.wait is None:
            raise InputError(f"no round can be completed: {reason}")
        self._hooks.wait(reason)

    def _request(self, weights: Weights, round_number: int, *, is_training: bool) -> TrainingRequest:
        version = self._hooks.version(weights)
        return TrainingRequest(
            is_training, weights, version, round_number, self._run_id, self._rules.lesson, self._settings
        )


def _metrics(reply: TrainingReply) -> Metrics:
    metrics = valid_metrics(reply.figures)
    if not metrics:
        raise ValueError("an answer with impossible metrics")
    return metrics


def _judgement(reply: TrainingReply) -> Judgement:
    return check_judgement(reply.arrays.get(PAIRS))


def _joined(reasons: Mapping[str, str]) -> str:
    """Reasons by robot as one text."""
    return "; ".join(f"{robot}: {reason}" for robot, reason in sorted(reasons.items())) or "nobody answered"


def _means(rows: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Mean of each loss over the robots."""
    names = dict.fromkeys(name for row in rows.values() for name in row)
    return {name: float(np.mean([row[name] for row in rows.values() if name in row])) for name in names}


def _sample(names: Iterable[str], fraction: float, minimum: int, rng: np.random.Generator) -> list[str]:
    """Draw robots for a round: names in alphabetical order; ``minimum`` at least, if enough are connected."""
    everyone = sorted(names)
    count = min(max(int(np.ceil(fraction * len(everyone))), minimum), len(everyone))
    return [everyone[index] for index in sorted(rng.choice(len(everyone), count, replace=False))]
