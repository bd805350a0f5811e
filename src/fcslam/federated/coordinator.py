"""The server's loop: ask robots, screen what they answer, merge it, judge it, keep the best, and remember all of it.

It is a function of the settings, the start and the answers: whose updates arrive first does not matter, and a server
that was killed goes on from its last round as if it had not been.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from fcslam.errors import TrainingError
from fcslam.federated.checkpoint import CHECKPOINT_FILE, CoordinatorState, read_state, run_id, write_state
from fcslam.federated.evaluation import Metrics, VersionComparison, combined_score, valid_metrics
from fcslam.federated.flower import Grid, Message, MessageType, RecordDict
from fcslam.federated.history import ROUNDS_FILE, RoundReport, Row, read_rows, write_rows
from fcslam.federated.messages import (
    ARRAYS_KEY,
    CONFIG_KEY,
    record_bytes,
    reply_metrics,
    reply_sender,
    request_config,
    weights_to_record,
)
from fcslam.federated.privacy import epsilon
from fcslam.federated.registry import RobotRegistry, sample_robots
from fcslam.federated.replies import RoundReplies, printable_line, read_replies
from fcslam.federated.screening import screen
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.strategies import Aggregator
from fcslam.federated.weights import Weights, interpolate_weights
from fcslam.learning.training_step import learning_rate

PUBLIC: Final = ""
"""Stands for the server where it judges itself, among the names of robots that do."""
_CHOICE_SEED: Final = 77

Evaluator = Callable[[Weights], Metrics]


@dataclass(frozen=True, slots=True)
class CoordinatorHooks:
    """What the loop is given by whoever runs it."""

    version: Callable[[Weights], str]
    """Names weights."""
    judge: Evaluator | None = None
    """Figures of weights on public images; without it the robots judge on images that they held out."""
    watch: Callable[[RoundReport, Weights], None] = lambda _report, _weights: None
    """Is told of every round that is done and kept, and the best weights so far."""
    wait: Callable[[str], None] | None = None
    """Is told why a round cannot be completed, and returns when it should be tried again; None if nobody will come."""
    clock: Callable[[], float] = time.monotonic


class Coordinator:
    """Federated training in a folder."""

    def __init__(self, settings: FederatedSettings, start: Weights, folder: Path, hooks: CoordinatorHooks) -> None:
        self._settings, self._start, self._folder, self._hooks = settings, start, folder, hooks
        self._merger = Aggregator(settings, {})
        self._run = run_id(settings, hooks.version(start))

    def run(self, grid: Grid) -> CoordinatorState:
        """All rounds that are not done yet.

        Raises:
            TrainingError: the folder is another run's, or a round cannot be completed and nobody will come.
            OutputError: something cannot be written; what was written before stays.
        """
        roster = RobotRegistry(grid, self._settings.deadline_s)
        state = read_state(
            self._folder / CHECKPOINT_FILE, self._settings, self._start, self._hooks.version(self._start)
        )
        rows: list[Row] = []
        if state is None:
            state = self._begin(grid, roster)
        else:
            rows = read_rows(self._folder / ROUNDS_FILE, state.rounds_done)
        self._merger = Aggregator(self._settings, state.memory)
        while state.rounds_done < self._settings.rounds:
            state, report = self._round(grid, roster, state)
            rows.append(report.row())
            write_rows(self._folder / ROUNDS_FILE, rows)
            write_state(self._folder / CHECKPOINT_FILE, state, self._settings)
            self._hooks.watch(report, state.best)
        return state

    def _begin(self, grid: Grid, roster: RobotRegistry) -> CoordinatorState:
        """How good the start is: what comes must not be worse."""
        scores = {judge: combined_score(found) for judge, found in self._judge(self._start, -1, grid, roster).items()}
        return CoordinatorState(
            rounds_done=0,
            weights=self._start,
            average=self._start,
            best=self._start,
            best_scores=scores,
            best_round=0,
            memory={},
            asked={},
            origin=self._hooks.version(self._start),
        )

    def _round(
        self, grid: Grid, roster: RobotRegistry, state: CoordinatorState
    ) -> tuple[CoordinatorState, RoundReport]:
        began, sent = self._hooks.clock(), Counter(state.asked)
        answers, state = self._train(grid, roster, state)
        while len(answers.weights) < self._settings.minimum_robots:
            self._wait_or_end(answers.left_out)
            answers, state = self._train(grid, roster, state)
        weights = self._merge(answers, state)
        number = state.rounds_done + 1
        average = interpolate_weights(state.average, weights, self._share(number))
        is_judged = number % self._settings.judge_every == 0 or number == self._settings.rounds
        verdict = (
            self._verdict(average, state, grid, roster, answers)
            if is_judged
            else VersionComparison({}, state.best_scores)
        )
        released = verdict.gain is not None and verdict.gain >= 0.0
        # The start is no place to go back to: nothing would be learnt as long as learning costs something at first.
        collapsed = verdict.gain is not None and verdict.gain < -self._settings.collapse
        returned = state.best_round > 0 and collapsed
        following = CoordinatorState(
            rounds_done=number,
            weights=state.best if returned else weights,
            average=state.best if returned else average,
            best=average if released else state.best,
            best_scores=verdict.scores if released else verdict.best,
            best_round=number if released else state.best_round,
            memory={} if returned else self._merger.memory,
            asked=state.asked,
            origin=state.origin,
        )
        if returned:
            self._merger = Aggregator(self._settings, {})
        privacy = self._settings.privacy
        report = RoundReport(
            round_number=number,
            version=self._hooks.version(average),
            robots=tuple(sorted(answers.weights)),
            left_out=answers.left_out,
            losses=_means(answers.losses),
            figures=verdict.figures,
            score=verdict.score,
            released=released,
            returned=returned,
            bytes_down=(Counter(state.asked) - sent).total() * record_bytes(weights_to_record(state.weights)),
            bytes_up=answers.bytes_up,
            seconds=self._hooks.clock() - began,
            epsilon=epsilon(privacy.noise_multiplier, max(following.asked.values()), privacy.delta),
        )
        return following, report

    def _train(
        self, grid: Grid, roster: RobotRegistry, state: CoordinatorState
    ) -> tuple[RoundReplies, CoordinatorState]:
        """Answers that may be merged, and the state in which robots were asked for them."""
        present = self._await(roster)
        rng = np.random.default_rng([self._settings.training.seed, state.rounds_done, _CHOICE_SEED])
        chosen = sample_robots(present, self._settings.participation, self._settings.minimum_robots, rng)
        # Counted before anybody hears of it: a server that is killed now will not know what left the robots.
        state = replace(state, asked=Counter(state.asked) + Counter(chosen))
        write_state(self._folder / CHECKPOINT_FILE, state, self._settings)
        version = self._hooks.version(state.weights)
        orders = self._merger.strategy.configure_train(
            state.rounds_done + 1,
            weights_to_record(state.weights),
            request_config(version, state.rounds_done, self._run, self._settings),
            _Nodes([present[robot] for robot in chosen]),
        )
        replies = grid.send_and_receive(orders, timeout=self._settings.deadline_s)
        answers = read_replies(replies, {present[robot]: robot for robot in chosen}, version, state.weights)
        frozen = self._settings.normalisation == "frozen"
        for robot, reason in screen(answers.weights, state.weights, self._settings.screening, frozen).items():
            answers.leave_out(robot, reason)
        answers.mention(
            {f"another {robot}": "two of one name are there, one is not asked" for robot in roster.duplicates}
        )
        return answers, state

    def _merge(self, answers: RoundReplies, state: CoordinatorState) -> Weights:
        """In the order of the robots' names: sums of floats depend on it."""
        ordered = [(answers.messages[robot], answers.weights[robot]) for robot in sorted(answers.weights)]
        return self._merger.merge(state.rounds_done + 1, ordered, state.weights)

    def _share(self, number: int) -> float:
        """How much of the mean so far stays in it: the lower the learning rate, the less noise is there to smooth."""
        training = self._settings.client_training()
        rate = learning_rate(training, number * self._settings.local_steps - 1)
        # Early means forget the start, from which everything is still moving away.
        most = min(self._settings.smoothing, number / (number + 9))
        return most * min(rate / training.learning_rate, 1.0)

    def _verdict(
        self, weights: Weights, state: CoordinatorState, grid: Grid, roster: RobotRegistry, answers: RoundReplies
    ) -> VersionComparison:
        """How good weights are beside the best, which those judge now that have not yet."""
        figures = self._judge(weights, state.rounds_done, grid, roster)
        new, late = figures.keys() - state.best_scores, dict[str, Metrics]()
        if new and self._hooks.judge is not None:
            late = {PUBLIC: self._hooks.judge(state.best)}
        elif new:
            nodes = {robot: node for robot, node in roster.present().items() if robot in new}
            late, failed = self._ask_to_judge(state.best, state.rounds_done, grid, nodes)
            answers.mention({f"judging by {robot}": why for robot, why in failed.items()})
        return VersionComparison(
            figures, dict(state.best_scores) | {judge: combined_score(found) for judge, found in late.items()}
        )

    def _judge(self, weights: Weights, round_number: int, grid: Grid, roster: RobotRegistry) -> dict[str, Metrics]:
        """Figures by whoever judges."""
        if self._hooks.judge is not None:
            return {PUBLIC: self._hooks.judge(weights)}
        found, failed = self._ask_to_judge(weights, round_number, grid, self._await(roster))
        while not found:
            self._wait_or_end(failed)
            found, failed = self._ask_to_judge(weights, round_number, grid, self._await(roster))
        return found

    def _ask_to_judge(
        self, weights: Weights, round_number: int, grid: Grid, nodes: Mapping[str, int]
    ) -> tuple[dict[str, Metrics], dict[str, str]]:
        """Figures of these robots, and why others gave none."""
        version = self._hooks.version(weights)
        config = request_config(version, round_number, self._run, self._settings)
        letter = RecordDict({ARRAYS_KEY: weights_to_record(weights), CONFIG_KEY: config})
        questions = [Message(letter, node, MessageType.EVALUATE) for node in nodes.values()]
        names = {node: robot for robot, node in nodes.items()}
        found: dict[str, Metrics] = {}
        failed: dict[str, str] = {}
        for reply in grid.send_and_receive(questions, timeout=self._settings.deadline_s):
            robot = names.get(reply.metadata.src_node_id, "")
            try:
                if reply.has_error():
                    raise ValueError(reply.error.reason or f"error {reply.error.code}")
                figures = (
                    valid_metrics(reply_metrics(reply.content))
                    if reply_sender(reply.content) == (robot, version)
                    else {}
                )
                if not figures:
                    raise ValueError("an answer without figures that could be")
                found[robot] = figures
            except (ValueError, KeyError, TypeError) as error:
                failed[robot] = printable_line(str(error))
        return found, failed

    def _await(self, roster: RobotRegistry) -> dict[str, int]:
        while len(present := roster.present()) < self._settings.minimum_robots:
            self._wait_or_end({"": f"{len(present)} robots are there, {self._settings.minimum_robots} needed"})
        return present

    def _wait_or_end(self, reasons: Mapping[str, str]) -> None:
        why = "; ".join(f"{robot}: {reason}".removeprefix(": ") for robot, reason in sorted(reasons.items()))
        if self._hooks.wait is None:
            raise TrainingError(f"no round can be completed: {why or 'nobody answered'}")
        self._hooks.wait(why or "nobody answered")


class _Nodes:
    """As much of a grid as a strategy looks at: the nodes that it may ask."""

    def __init__(self, nodes: list[int]) -> None:
        self._nodes = nodes

    def get_node_ids(self) -> list[int]:
        return self._nodes


def _means(rows: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for row in rows.values() for name in row)
    return {name: float(np.mean([row[name] for row in rows.values() if name in row])) for name in names}
