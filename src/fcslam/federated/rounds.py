"""The server's loop: ask robots, screen what they answer, merge it, judge it, keep the best, and remember all of it.

It is a function of the settings, the start and the answers: whose updates arrive first does not matter, and a server
that was killed goes on from its last round as if it had not been.
"""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.flower import Grid, Message, MessageType, RecordDict
from fcslam.federated.history import ROUNDS_FILE, RoundReport, Row, read_rows, write_rows
from fcslam.federated.letters import (
    ARRAYS,
    CONFIG,
    figures_of,
    order_config,
    read_arrays,
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
from fcslam.federated.weights import Weights

SCORE_FIGURES: Final = ("repeatability", "mma_3px")
_CHOICE_SEED: Final = 77

Judge = Callable[[Weights], Mapping[str, float]]


@dataclass(slots=True)
class Answers:
    """What came back in a round."""

    weights: dict[str, dict[str, NDArray[np.float32]]] = field(default_factory=dict)
    losses: dict[str, dict[str, float]] = field(default_factory=dict)
    messages: dict[str, Message] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    bytes_up: int = 0


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
        figures = self._judge(self._start, -1, grid, roster)
        return State(0, self._start, self._start, score_of(figures), 0, {}, {}, self._outside.version(self._start))

    def _round(self, grid: Grid, roster: Roster, state: State) -> tuple[State, RoundReport]:
        began = self._outside.clock()
        asked: list[str] = []
        while True:
            answers, chosen = self._train(grid, roster, state)
            asked += chosen
            if len(answers.weights) >= self._settings.minimum_robots:
                break
            self._wait_or_end(answers.left_out)
        weights = self._merge(answers, state)
        figures = self._judge(weights, state.rounds_done, grid, roster)
        score = score_of(figures)
        released = score >= state.best_score
        # The start is no place to go back to: nothing would be learnt as long as learning costs something at first.
        returned = state.best_round > 0 and score < state.best_score - self._settings.collapse
        following = State(
            rounds_done=state.rounds_done + 1,
            weights=state.best if returned else weights,
            best=weights if released else state.best,
            best_score=score if released else state.best_score,
            best_round=state.rounds_done + 1 if released else state.best_round,
            memory={} if returned else self._merger.memory,
            asked=Counter(state.asked) + Counter(asked),
            origin=state.origin,
        )
        if returned:
            self._merger = Merger(self._settings, {})
        privacy = self._settings.privacy
        report = RoundReport(
            round_number=following.rounds_done,
            version=self._outside.version(weights),
            robots=tuple(sorted(answers.weights)),
            left_out=answers.left_out,
            losses=_means(answers.losses),
            figures=figures,
            score=score,
            released=released,
            returned=returned,
            bytes_down=len(asked) * size_of(write_arrays(state.weights)),
            bytes_up=answers.bytes_up,
            seconds=self._outside.clock() - began,
            epsilon=epsilon(privacy.noise_multiplier, max(following.asked.values()), privacy.delta),
        )
        return following, report

    def _train(self, grid: Grid, roster: Roster, state: State) -> tuple[Answers, list[str]]:
        """Answers that may be merged, and the robots that were asked."""
        present = self._await(roster)
        rng = np.random.default_rng([self._settings.training.seed, state.rounds_done, _CHOICE_SEED])
        chosen = choose(present, self._settings.participation, self._settings.minimum_robots, rng)
        version = self._outside.version(state.weights)
        orders = self._merger.strategy.configure_train(
            state.rounds_done + 1,
            write_arrays(state.weights),
            order_config(version, state.rounds_done, self._run, self._settings),
            _Nodes([present[robot] for robot in chosen]),
        )
        replies = grid.send_and_receive(orders, timeout=self._settings.deadline_s)
        answers = _read(replies, {present[robot]: robot for robot in chosen}, version)
        for robot, reason in screen(answers.weights, state.weights, self._settings.screening).items():
            answers.left_out[robot] = reason
            del answers.weights[robot], answers.losses[robot]
        return answers, chosen

    def _merge(self, answers: Answers, state: State) -> Weights:
        """In the order of the robots' names: sums of floats depend on it."""
        ordered = [(answers.messages[robot], answers.weights[robot]) for robot in sorted(answers.weights)]
        return self._merger.merge(state.rounds_done + 1, ordered, state.weights)

    def _judge(self, weights: Weights, round_number: int, grid: Grid, roster: Roster) -> dict[str, float]:
        if self._outside.judge is not None:
            return dict(self._outside.judge(weights))
        version, present = self._outside.version(weights), self._await(roster)
        config = order_config(version, round_number, self._run, self._settings)
        letter = RecordDict({ARRAYS: write_arrays(weights), CONFIG: config})
        questions = [Message(letter, node, MessageType.EVALUATE) for node in present.values()]
        found = []
        for reply in grid.send_and_receive(questions, timeout=self._settings.deadline_s):
            try:
                if not reply.has_error() and signature(reply.content)[1] == version:
                    found.append(figures_of(reply.content))
            except (ValueError, KeyError, TypeError):
                continue
        return _medians(found)

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


def score_of(figures: Mapping[str, float]) -> float:
    """What versions of the detector are compared by: the mean of repeatability and MMA; -1 where one is not known."""
    values = [figures.get(name, np.nan) for name in SCORE_FIGURES]
    return float(np.mean(values)) if np.isfinite(values).all() else -1.0


def _read(replies: Any, robots: Mapping[int, str], version: str) -> Answers:
    """Answers by robot, with a reason for each robot that gave none."""
    answers = Answers()
    for reply in replies:
        robot = robots.get(reply.metadata.src_node_id)
        if robot is None:
            continue
        if reply.has_error():
            answers.left_out[robot] = reply.error.reason or f"error {reply.error.code}"
            continue
        try:
            name, base = signature(reply.content)
            if (name, base) != (robot, version):
                raise ValueError(f"an answer by {name} about version {base}, not by {robot} about {version}")
            record = reply.content[ARRAYS]
            answers.bytes_up += size_of(record)
            answers.weights[robot] = read_arrays(record)
            answers.losses[robot] = figures_of(reply.content)
            answers.messages[robot] = reply
        except (ValueError, KeyError, TypeError, EOFError) as error:
            answers.left_out[robot] = f"an answer that cannot be read ({error})"
    for robot in robots.values():
        if robot not in answers.weights and robot not in answers.left_out:
            answers.left_out[robot] = "no answer: gone, or later than the deadline"
    return answers


def _means(rows: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for row in rows.values() for name in row)
    return {name: float(np.mean([row[name] for row in rows.values() if name in row])) for name in names}


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    """Medians over robots: one that lies about its images does not decide."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: float(np.nanmedian([row.get(name, np.nan) for row in rows])) for name in names}
