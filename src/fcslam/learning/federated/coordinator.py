"""Runs federated training: every round trains on the robots, aggregates, evaluates and decides.

The result is a function of the settings, the initial weights and the replies. The order of arrival does not matter. A
coordinator that was killed continues from its last checkpoint, with the same result.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from fcslam.config import one_line
from fcslam.errors import InputError
from fcslam.learning.federated.aggregation import Aggregate, average, next_weights
from fcslam.learning.federated.checkpoint import CoordinatorState, read_checkpoint, run_id, write_checkpoint
from fcslam.learning.federated.client import InProcessFleet
from fcslam.learning.federated.evaluation import EvaluateFn, combined_score, compare, gate
from fcslam.learning.federated.fleet_grid import FleetGrid
from fcslam.learning.federated.held_out import Judgement, check_judgement
from fcslam.learning.federated.messages import (
    PAIRS,
    RoundReplies,
    TrainingRequest,
    checked_reply,
    collect_updates,
)
from fcslam.learning.federated.rounds import ROUNDS_FILE, Evaluation, RoundReport, write_rows
from fcslam.learning.federated.screening import BOUNDS, ScreeningBounds, clip, screen, update_length
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights, interpolate_weights, size_bytes
from fcslam.learning.training_loop import learning_rate

TrainingFleet = InProcessFleet | FleetGrid
"""The robots that a coordinator trains with."""


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
    """Held-out pairs that decide a release, of clients that train on points seen again; None: evaluated on images."""


RULES: Final = RoundRules()


@dataclass(frozen=True, slots=True)
class CoordinatorHooks:
    """Functions that the coordinator calls outside itself."""

    version: Callable[[Weights], str]
    """Gives the detector version of weights."""
    evaluate_fn: EvaluateFn = lambda _weights: {}
    """Evaluates weights on images; without a result, no version is released. Not called where pairs decide."""
    on_round: Callable[[RoundReport], None] = lambda _report: None
    """Called with the report of each round, once its results are on disk."""
    on_release: Callable[[Weights], None] = lambda _weights: None
    """Called with the weights of each released version, before ``on_round``. A start calls it again with the newest
    ones, as the one before may have been killed before it called.
    """
    wait: Callable[[str], None] | None = None
    """Called with the reason when a round cannot be completed; returns when to try again. If None, training fails."""


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
        origin = hooks.version(initial)
        self._run_id = run_id(settings, origin)
        self._state = read_checkpoint(folder, settings, initial, origin) or CoordinatorState(
            initial, initial, initial, origin
        )
        self._best_scores: Mapping[str, float] = {}

    def run(self) -> CoordinatorState:
        """Do all rounds that are not done yet."""
        state, folder = self._state, self._folder
        if state.best_round > 0:
            self._hooks.on_release(state.best)
        if self._rules.fewest_pairs is None and state.rounds_done < self._settings.rounds:
            best = self._hooks.evaluate_fn(state.best)
            self._best_scores = {evaluator: combined_score(metrics) for evaluator, metrics in best.items()}
        while state.rounds_done < self._settings.rounds:
            state, report = self._round(state)
            write_rows(folder / ROUNDS_FILE, state.rows)
            write_checkpoint(folder, state, self._settings)
            if report.released:
                self._hooks.on_release(state.best)
            self._hooks.on_round(report)
        return state

    def _round(self, state: CoordinatorState) -> tuple[CoordinatorState, RoundReport]:
        started, number = time.monotonic(), state.rounds_done + 1

        replies, trained = self._train(state)
        # Updates are added in the order of the robots' names, as sums of floats depend on it.
        updates = [replies.weights[robot] for robot in sorted(replies.weights)]
        weights, momentum = next_weights(
            self._rules.aggregate, number, updates, state.weights, state.momentum, self._rules.momentum
        )
        candidate = self._average(weights, state)
        evaluation = self._evaluate(candidate, state, replies)
        if evaluation.released:
            self._best_scores = evaluation.scores
        # Never back to the initial weights: as long as training costs something at first, nothing would be learnt.
        returned = state.best_round > 0 and evaluation.gain < -self._rules.collapse

        report = RoundReport(
            round_number=number,
            version=self._hooks.version(candidate),
            robots=tuple(sorted(replies.weights)),
            left_out=replies.left_out,
            losses=_means(replies.losses),
            evaluation=evaluation,
            returned=returned,
            bytes_down=(Counter(trained.times_asked) - Counter(state.times_asked)).total() * size_bytes(state.weights),
            bytes_up=replies.bytes_up,
            seconds=time.monotonic() - started,
        )
        following = replace(
            trained,
            rounds_done=number,
            weights=trained.best if returned else weights,
            average=trained.best if returned else candidate,
            best=candidate if report.released else trained.best,
            best_round=number if report.released else trained.best_round,
            momentum={} if returned else momentum,
            update_length=update_length(replies.weights, state.weights),
            rows=[*trained.rows, report.row()],
        )
        return following, report

    def _train(self, state: CoordinatorState) -> tuple[RoundReplies, CoordinatorState]:
        """Have robots train until enough of their updates have passed screening."""
        replies, state = self._train_once(state)
        while len(replies.weights) < self._settings.minimum_robots:
            reasons = (f"{robot}: {reason}" for robot, reason in sorted(replies.left_out.items()))
            self._wait_or_fail("; ".join(reasons) or "nobody answered")
            replies, state = self._train_once(state)
        return replies, state

    def _train_once(self, state: CoordinatorState) -> tuple[RoundReplies, CoordinatorState]:
        """One request to a sample of the robots. The state counts the robots that were asked."""
        settings, least = self._settings, self._settings.minimum_robots
        while len(connected := self._fleet.robots()) < least:
            self._wait_or_fail(f"{len(connected)} robots are there, {least} needed")
        rng = np.random.default_rng([settings.training.seed, state.rounds_done, 77])
        chosen = _sample(connected, settings.participation, least, rng)
        # Counted before the request leaves: after a crash nobody could say which updates have left the robots.
        state = replace(state, times_asked=Counter(state.times_asked) + Counter(chosen))
        write_checkpoint(self._folder, state, settings)
        request = self._request(state.weights, state.rounds_done, is_training=True)
        replies = collect_updates(self._fleet.ask(chosen, request, settings.deadline_s), chosen, request.version)
        frozen = self._rules.fewest_pairs is not None
        refused = screen(replies.weights, state.weights, self._rules.bounds, frozen, state.update_length)
        for robot, reason in refused.items():
            replies.leave_out(robot, reason)
        replies.weights = clip(replies.weights, state.weights, self._rules.bounds)
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

    def _evaluate(self, weights: Weights, state: CoordinatorState, replies: RoundReplies) -> Evaluation:
        """Compare weights with the released ones: on images, or by all robots on the pairs that they hold out."""
        number, fewest_pairs = state.rounds_done + 1, self._rules.fewest_pairs
        if number % self._rules.judge_every != 0 and number != self._settings.rounds:
            return Evaluation()
        if fewest_pairs is None:
            return compare(self._hooks.evaluate_fn(weights), self._best_scores)
        present = self._fleet.robots()
        candidate, released = (
            self._judgements(present, each, state.rounds_done, replies) for each in (weights, state.best)
        )
        return gate(candidate, released, fewest_pairs, self._settings.training.seed)

    def _judgements(
        self, robots: list[str], weights: Weights, round_number: int, replies: RoundReplies
    ) -> dict[str, Judgement]:
        """The robots' reports on the weights; the reasons why some cannot be read go to the other ones of the round."""
        request = self._request(weights, round_number, is_training=False)
        found: dict[str, Judgement] = {}
        for robot, reply in self._fleet.ask(robots, request, self._settings.deadline_s).items():
            try:
                found[robot] = check_judgement(checked_reply(reply, robot, request.version).arrays.get(PAIRS))
            except ValueError as error:
                replies.left_out.setdefault(f"judging by {robot}", one_line(str(error)))
        return found

    def _wait_or_fail(self, reason: str) -> None:
        if self._hooks.wait is None:
            raise InputError(f"no round can be completed: {reason}")
        self._hooks.wait(reason)

    def _request(self, weights: Weights, round_number: int, *, is_training: bool) -> TrainingRequest:
        version = self._hooks.version(weights)
        return TrainingRequest(is_training, weights, version, round_number, self._run_id, self._settings)


def _means(rows: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for row in rows.values() for name in row)
    return {name: float(np.mean([row[name] for row in rows.values() if name in row])) for name in names}


def _sample(names: Iterable[str], fraction: float, minimum: int, rng: np.random.Generator) -> list[str]:
    """Draw robots for a round: names in alphabetical order; ``minimum`` at least, if enough are connected."""
    everyone = sorted(names)
    count = min(max(int(np.ceil(fraction * len(everyone))), minimum), len(everyone))
    return [everyone[index] for index in sorted(rng.choice(len(everyone), count, replace=False))]
