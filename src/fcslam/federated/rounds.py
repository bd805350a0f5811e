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
from fcslam.federated.answers import Answers, line_of, read_answers
from fcslam.federated.flower import Grid, Message, MessageType, RecordDict
from fcslam.federated.history import ROUNDS_FILE, RoundReport, Row, read_rows, write_rows
from fcslam.federated.judging import Figures, Verdict, credible, score_of
from fcslam.federated.letters import (
    ARRAYS,
    CONFIG,
    figures_of,
    order_config,
    signature,
    size_of,
    write_arrays,
)
from fcslam.federated.memory import CHECKPOINT_FILE, State, read_state, run_name, write_state
from fcslam.federated.privacy import epsilon
from fcslam.federated.roster import Roster, choose
from fcslam.federated.screening import screen
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.strategies import Merger
from fcslam.federated.weights import Weights, blended
from fcslam.learning.descent import learning_rate

PUBLIC: Final = ""
"""Stands for the server where it judges itself, among the names of robots that do."""
_CHOICE_SEED: Final = 77

Judge = Callable[[Weights], Figures]


@dataclass(frozen=True, slots=True)
class Outside:
    """What the loop is given by whoever runs it."""

    version: Callable[[Weights], str]
    """Names weights."""
    judge: Judge | None = None
    """Figures of weights on public images; without it the robots judge on images that they held out."""
    watch: Callable[[RoundReport, Weights], None] = lambda _report, _weights: None
    """Is told of every round that is done and kept, and the best weights so far."""
    wait: Callable[[str], None] | None = None
    """Is told why a round cannot be completed, and returns when it should be tried again; None if nobody will come."""
    clock: Callable[[], float] = time.monotonic


class Server:
    """Federated training in a folder."""

    def __init__(self, settings: FederatedSettings, start: Weights, folder: Path, outside: Outside) -> None:
        self._settings, self._start, self._folder, self._outside = settings, start, folder, outside
        self._merger = Merger(settings, {})
        self._run = run_name(settings, outside.version(start))

    def run(self, grid: Grid) -> State:
        """All rounds that are not done yet.

        Raises:
            TrainingError: the folder is another run's, or a round cannot be completed and nobody will come.
            OutputError: something cannot be written; what was written before stays.
        """
        roster = Roster(grid, self._settings.deadline_s)
        state = read_state(
            self._folder / CHECKPOINT_FILE, self._settings, self._start, self._outside.version(self._start)
        )
        rows: list[Row] = []
        if state is None:
            state = self._begin(grid, roster)
        else:
            rows = read_rows(self._folder / ROUNDS_FILE, state.rounds_done)
        self._merger = Merger(self._settings, state.memory)
        while state.rounds_done < self._settings.rounds:
            state, report = self._round(grid, roster, state)
            rows.append(report.row())
            write_rows(self._folder / ROUNDS_FILE, rows)
            write_state(self._folder / CHECKPOINT_FILE, state, self._settings)
            self._outside.watch(report, state.best)
        return state

    def _begin(self, grid: Grid, roster: Roster) -> State:
        """How good the start is: what comes must not be worse."""
        scores = {judge: score_of(found) for judge, found in self._judge(self._start, -1, grid, roster).items()}
        return State(
            rounds_done=0,
            weights=self._start,
            average=self._start,
            best=self._start,
            best_scores=scores,
            best_round=0,
            memory={},
            asked={},
            origin=self._outside.version(self._start),
        )

    def _round(self, grid: Grid, roster: Roster, state: State) -> tuple[State, RoundReport]:
        began, sent = self._outside.clock(), Counter(state.asked)
        answers, state = self._train(grid, roster, state)
        while len(answers.weights) < self._settings.minimum_robots:
            self._wait_or_end(answers.left_out)
            answers, state = self._train(grid, roster, state)
        weights = self._merge(answers, state)
        number = state.rounds_done + 1
        average = blended(state.average, weights, self._share(number))
        is_judged = number % self._settings.judge_every == 0 or number == self._settings.rounds
        verdict = self._verdict(average, state, grid, roster, answers) if is_judged else Verdict({}, state.best_scores)
        released = verdict.gain is not None and verdict.gain >= 0.0
        # The start is no place to go back to: nothing would be learnt as long as learning costs something at first.
        collapsed = verdict.gain is not None and verdict.gain < -self._settings.collapse
        returned = state.best_round > 0 and collapsed
        following = State(
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
            self._merger = Merger(self._settings, {})
        privacy = self._settings.privacy
        report = RoundReport(
            round_number=number,
            version=self._outside.version(average),
            robots=tuple(sorted(answers.weights)),
            left_out=answers.left_out,
            losses=_means(answers.losses),
            figures=verdict.figures,
            score=verdict.score,
            released=released,
            returned=returned,
            bytes_down=(Counter(state.asked) - sent).total() * size_of(write_arrays(state.weights)),
            bytes_up=answers.bytes_up,
            seconds=self._outside.clock() - began,
            epsilon=epsilon(privacy.noise_multiplier, max(following.asked.values()), privacy.delta),
        )
        return following, report

    def _train(self, grid: Grid, roster: Roster, state: State) -> tuple[Answers, State]:
        """Answers that may be merged, and the state in which robots were asked for them."""
        present = self._await(roster)
        rng = np.random.default_rng([self._settings.training.seed, state.rounds_done, _CHOICE_SEED])
        chosen = choose(present, self._settings.participation, self._settings.minimum_robots, rng)
        # Counted before anybody hears of it: a server that is killed now will not know what left the robots.
        state = replace(state, asked=Counter(state.asked) + Counter(chosen))
        write_state(self._folder / CHECKPOINT_FILE, state, self._settings)
        version = self._outside.version(state.weights)
        orders = self._merger.strategy.configure_train(
            state.rounds_done + 1,
            write_arrays(state.weights),
            order_config(version, state.rounds_done, self._run, self._settings),
            _Nodes([present[robot] for robot in chosen]),
        )
        replies = grid.send_and_receive(orders, timeout=self._settings.deadline_s)
        answers = read_answers(replies, {present[robot]: robot for robot in chosen}, version, state.weights)
        frozen = self._settings.normalisation == "frozen"
        for robot, reason in screen(answers.weights, state.weights, self._settings.screening, frozen).items():
            answers.leave_out(robot, reason)
        answers.mention({f"another {robot}": "two of one name are there, one is not asked" for robot in roster.doubles})
        return answers, state

    def _merge(self, answers: Answers, state: State) -> Weights:
        """In the order of the robots' names: sums of floats depend on it."""
        ordered = [(answers.messages[robot], answers.weights[robot]) for robot in sorted(answers.weights)]
        return self._merger.merge(state.rounds_done + 1, ordered, state.weights)

    def _share(self, number: int) -> float:
        """How much of the mean so far stays in it: the lower the learning rate, the less noise is there to smooth."""
        training = self._settings.of_robots()
        rate = learning_rate(training, number * self._settings.local_steps - 1)
        # Early means forget the start, from which everything is still moving away.
        most = min(self._settings.smoothing, number / (number + 9))
        return most * min(rate / training.learning_rate, 1.0)

    def _verdict(self, weights: Weights, state: State, grid: Grid, roster: Roster, answers: Answers) -> Verdict:
        """How good weights are beside the best, which those judge now that have not yet."""
        figures = self._judge(weights, state.rounds_done, grid, roster)
        new, late = figures.keys() - state.best_scores, dict[str, Figures]()
        if new and self._outside.judge is not None:
            late = {PUBLIC: self._outside.judge(state.best)}
        elif new:
            nodes = {robot: node for robot, node in roster.present().items() if robot in new}
            late, failed = self._ask_to_judge(state.best, state.rounds_done, grid, nodes)
            answers.mention({f"judging by {robot}": why for robot, why in failed.items()})
        return Verdict(figures, dict(state.best_scores) | {judge: score_of(found) for judge, found in late.items()})

    def _judge(self, weights: Weights, round_number: int, grid: Grid, roster: Roster) -> dict[str, Figures]:
        """Figures by whoever judges."""
        if self._outside.judge is not None:
            return {PUBLIC: self._outside.judge(weights)}
        found, failed = self._ask_to_judge(weights, round_number, grid, self._await(roster))
        while not found:
            self._wait_or_end(failed)
            found, failed = self._ask_to_judge(weights, round_number, grid, self._await(roster))
        return found

    def _ask_to_judge(
        self, weights: Weights, round_number: int, grid: Grid, nodes: Mapping[str, int]
    ) -> tuple[dict[str, Figures], dict[str, str]]:
        """Figures of these robots, and why others gave none."""
        version = self._outside.version(weights)
        config = order_config(version, round_number, self._run, self._settings)
        letter = RecordDict({ARRAYS: write_arrays(weights), CONFIG: config})
        questions = [Message(letter, node, MessageType.EVALUATE) for node in nodes.values()]
        names = {node: robot for robot, node in nodes.items()}
        found: dict[str, Figures] = {}
        failed: dict[str, str] = {}
        for reply in grid.send_and_receive(questions, timeout=self._settings.deadline_s):
            robot = names.get(reply.metadata.src_node_id, "")
            try:
                if reply.has_error():
                    raise ValueError(reply.error.reason or f"error {reply.error.code}")
                figures = credible(figures_of(reply.content)) if signature(reply.content) == (robot, version) else {}
                if not figures:
                    raise ValueError("an answer without figures that could be")
                found[robot] = figures
            except (ValueError, KeyError, TypeError) as error:
                failed[robot] = line_of(str(error))
        return found, failed

    def _await(self, roster: Roster) -> dict[str, int]:
        while len(present := roster.present()) < self._settings.minimum_robots:
            self._wait_or_end({"": f"{len(present)} robots are there, {self._settings.minimum_robots} needed"})
        return present

    def _wait_or_end(self, reasons: Mapping[str, str]) -> None:
        why = "; ".join(f"{robot}: {reason}".removeprefix(": ") for robot, reason in sorted(reasons.items()))
        if self._outside.wait is None:
            raise TrainingError(f"no round can be completed: {why or 'nobody answered'}")
        self._outside.wait(why or "nobody answered")


class _Nodes:
    """As much of a grid as a strategy looks at: the nodes that it may ask."""

    def __init__(self, nodes: list[int]) -> None:
        self._nodes = nodes

    def get_node_ids(self) -> list[int]:
        return self._nodes


def _means(rows: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for row in rows.values() for name in row)
    return {name: float(np.mean([row[name] for row in rows.values() if name in row])) for name in names}
