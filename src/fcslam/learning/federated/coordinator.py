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

from fcslam.errors import TrainingError
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
from fcslam.learning.federated.flower import Message, MessageType, NodeSelection, RecordDict, RobotGrid
from fcslam.learning.federated.held_out import Judgement, check_judgement
from fcslam.learning.federated.history import ROUNDS_FILE, RoundReport, Row, read_rows, write_rows
from fcslam.learning.federated.messages import (
    ARRAYS_KEY,
    CONFIG_KEY,
    PAIRS_KEY,
    GlobalModel,
    RoundReplies,
    printable_line,
    read_replies,
    record_to_weights,
    reply_metrics,
    reply_sender,
    request_config,
)
from fcslam.learning.federated.screening import screen, update_length
from fcslam.learning.federated.settings import FederatedSettings, GateSettings
from fcslam.learning.federated.strategies import Aggregator, StrategyFactory
from fcslam.learning.federated.weights import Weights, check_private, interpolate_weights, shared_weights
from fcslam.learning.training_step import learning_rate

_Answer = TypeVar("_Answer")
_SAMPLING_SEED: Final = 77
"""Separates the drawing of robots from other uses of the training seed."""


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
    gate: GateSettings | None = None
    """Decides on releases, by pairs that robots hold out; None: every version that is not worse is released."""
    strategy: StrategyFactory | None = None
    """Makes the strategy; None: the one that the settings name."""
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
        self, grid: RobotGrid, settings: FederatedSettings, initial: Weights, folder: Path, hooks: CoordinatorHooks
    ) -> None:
        check_private(initial, settings.private)
        self._grid, self._settings, self._folder, self._hooks = grid, settings, folder, hooks
        self._initial = self._model(initial)
        self._run_id = run_id(settings, self._initial.version)
        self._aggregator = Aggregator(settings, {}, hooks.strategy)

    def run(self) -> CoordinatorState:
        """Do all rounds that are not done yet.

        Raises:
            TrainingError: the folder belongs to another run, or a round cannot be completed and there is no ``wait``.
            OutputError: a file cannot be written; everything written before stays.
        """
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
        initial = self._initial
        state = read_state(self._folder / CHECKPOINT_FILE, self._settings, initial.weights, initial.version)
        if state is None:
            # A version must be at least as good to be released. A gate measures both versions when it decides.
            metrics = {} if self._hooks.gate is not None else self._measure(initial, 0)
            scores = {evaluator: combined_score(found) for evaluator, found in metrics.items()}
            return CoordinatorState.at_start(initial.weights, initial.version, scores), []
        self._aggregator = Aggregator(self._settings, state.strategy_state, self._hooks.strategy)
        return state, read_rows(self._folder / ROUNDS_FILE, state.rounds_done)

    def _round(self, state: CoordinatorState) -> tuple[CoordinatorState, RoundReport]:
        """One round."""
        started, sent = self._hooks.clock(), self._model(state.weights)

        replies, trained = self._train(sent, state)
        weights = self._aggregate(replies, state)
        candidate = self._model(self._average(weights, state))
        comparison = self._evaluate(candidate, state, replies)
        decision = self._decide(comparison, state)

        number = state.rounds_done + 1
        if decision.returned:
            self._aggregator = Aggregator(self._settings, {}, self._hooks.strategy)
        following = CoordinatorState(
            rounds_done=number,
            weights=trained.best if decision.returned else weights,
            average=trained.best if decision.returned else candidate.weights,
            best=candidate.weights if decision.released else trained.best,
            best_scores=comparison.scores if decision.released else comparison.best,
            best_round=number if decision.released else trained.best_round,
            strategy_state=self._aggregator.state,
            times_asked=trained.times_asked,
            origin=trained.origin,
            update_length=update_length(replies.weights, self._shared(sent.weights)),
        )
        report = RoundReport(
            round_number=number,
            version=candidate.version,
            robots=tuple(sorted(replies.weights)),
            left_out=replies.left_out,
            losses=_means(replies.losses),
            metrics=comparison.metrics,
            score=comparison.score,
            released=decision.released,
            returned=decision.returned,
            reason="" if comparison.gate is None else comparison.gate.reason,
            bytes_down=(Counter(trained.times_asked) - Counter(state.times_asked)).total() * sent.size_bytes,
            bytes_up=replies.bytes_up,
            seconds=self._hooks.clock() - started,
        )
        return following, report

    def _train(self, model: GlobalModel, state: CoordinatorState) -> tuple[RoundReplies, CoordinatorState]:
        """Have robots train from the model until enough of their updates have passed screening."""
        replies, state = self._train_once(model, state)
        while len(replies.weights) < self._settings.minimum_robots:
            self._wait_or_fail(_joined(replies.left_out))
            replies, state = self._train_once(model, state)
        return replies, state

    def _train_once(self, model: GlobalModel, state: CoordinatorState) -> tuple[RoundReplies, CoordinatorState]:
        """One request to a sample of the robots. The state counts the robots that were asked."""
        connected = self._connected()
        rng = np.random.default_rng([self._settings.training.seed, state.rounds_done, _SAMPLING_SEED])
        chosen = _sample(connected, self._settings.participation, self._settings.minimum_robots, rng)
        # Counted before the request leaves: after a crash nobody could say which updates have left the robots.
        state = replace(state, times_asked=Counter(state.times_asked) + Counter(chosen))
        write_state(self._folder / CHECKPOINT_FILE, state, self._settings)
        requests = self._aggregator.strategy.configure_train(
            state.rounds_done + 1,
            model.record,
            request_config(model.version, state.rounds_done, self._run_id, self._settings),
            NodeSelection([connected[robot] for robot in chosen]),
        )
        messages = self._grid.send_and_receive(requests, timeout=self._settings.deadline_s)
        replies = read_replies(messages, {connected[robot]: robot for robot in chosen}, model)
        frozen = self._settings.normalisation == "frozen"
        sent = self._shared(model.weights)
        refused = screen(replies.weights, sent, self._settings.screening, frozen, state.update_length)
        for robot, reason in refused.items():
            replies.leave_out(robot, reason)
        return replies, state

    def _aggregate(self, replies: RoundReplies, state: CoordinatorState) -> Weights:
        """The next weights. Updates are added in the order of the robots' names, as sums of floats depend on it."""
        updates = [(replies.messages[robot], replies.weights[robot]) for robot in sorted(replies.weights)]
        shared = self._aggregator.aggregate(state.rounds_done + 1, updates, self._shared(state.weights))
        return {**state.weights, **shared}

    def _shared(self, weights: Weights) -> Weights:
        """The weights that robots send back."""
        return shared_weights(weights, self._settings.private)

    def _average(self, weights: Weights, state: CoordinatorState) -> Weights:
        """The moving average of the rounds' weights, which is evaluated and released.

        It smooths the noise of training. The lower the learning rate, the less noise there is, so the less is kept of
        the earlier average. Early averages forget the initial weights, which training leaves behind quickly.
        """
        number, training = state.rounds_done + 1, self._settings.client_training()
        rate = learning_rate(training, number * self._settings.local_steps - 1)
        kept = min(self._settings.smoothing, number / (number + 9)) * min(rate / training.learning_rate, 1.0)
        return interpolate_weights(state.average, weights, kept)

    def _evaluate(self, model: GlobalModel, state: CoordinatorState, replies: RoundReplies) -> VersionComparison:
        """Compare the model with the best one. Evaluators that have not measured the best one do so now."""
        number = state.rounds_done + 1
        if number % self._settings.judge_every != 0 and number != self._settings.rounds:
            return VersionComparison({}, state.best_scores)
        if self._hooks.gate is not None:
            return self._ask_gate(self._hooks.gate, model, state, replies)
        metrics = self._measure(model, state.rounds_done)
        newcomers = metrics.keys() - state.best_scores.keys()
        best: Mapping[str, Metrics] = {}
        if newcomers and self._hooks.evaluate_fn is not None:
            best = {PUBLIC_IMAGES: self._hooks.evaluate_fn(state.best)}
        elif newcomers:
            nodes = {robot: node for robot, node in self._present().items() if robot in newcomers}
            best, failed = self._ask(nodes, self._model(state.best), state.rounds_done, _metrics)
            replies.add_notes({f"judging by {robot}": reason for robot, reason in failed.items()})
        scores = {evaluator: combined_score(found) for evaluator, found in best.items()}
        return VersionComparison(metrics, {**state.best_scores, **scores})

    def _ask_gate(
        self, gate: GateSettings, model: GlobalModel, state: CoordinatorState, replies: RoundReplies
    ) -> VersionComparison:
        """Have all robots that are there judge the model and the best one on the pairs that they hold out."""
        connected, reports = self._present(), []
        for judged in (model, self._model(state.best)):
            found, failed = self._ask(connected, judged, state.rounds_done, _judgement)
            replies.add_notes({f"judging by {robot}": reason for robot, reason in failed.items()})
            reports.append(found)
        decision = decide(reports[0], reports[1], gate, self._settings.training.seed)
        return VersionComparison({}, state.best_scores, decision)

    def _decide(self, comparison: VersionComparison, state: CoordinatorState) -> Decision:
        """Release a version that is at least as good as the best one; return to the best one after a collapse."""
        gain = comparison.gain
        if gain is None:
            return Decision(released=False, returned=False)
        if comparison.gate is not None:
            is_collapse = comparison.gate.pairs > 0 and gain < -self._settings.collapse
            return Decision(comparison.gate.released, state.best_round > 0 and is_collapse)
        # Never back to the initial weights: as long as training costs something at first, nothing would be learnt.
        return Decision(released=gain >= 0.0, returned=state.best_round > 0 and gain < -self._settings.collapse)

    def _measure(self, model: GlobalModel, round_number: int) -> Mapping[str, Metrics]:
        """Metrics of the model on public images, or else by all robots that can give them, at least one."""
        if self._hooks.evaluate_fn is not None:
            return {PUBLIC_IMAGES: self._hooks.evaluate_fn(model.weights)}
        found, failed = self._ask(self._connected(), model, round_number, _metrics)
        while not found:
            self._wait_or_fail(_joined(failed))
            found, failed = self._ask(self._connected(), model, round_number, _metrics)
        return found

    def _ask(
        self, nodes: Mapping[str, int], model: GlobalModel, round_number: int, read: Callable[[RecordDict], _Answer]
    ) -> tuple[dict[str, _Answer], dict[str, str]]:
        """The answers of these robots about the model, and the reasons why some gave none that can be read."""
        config = request_config(model.version, round_number, self._run_id, self._settings)
        content = RecordDict({ARRAYS_KEY: model.record, CONFIG_KEY: config})
        requests = [Message(content, node, MessageType.EVALUATE) for node in nodes.values()]
        names = {node: robot for robot, node in nodes.items()}
        found: dict[str, _Answer] = {}
        failed: dict[str, str] = {}
        for reply in self._grid.send_and_receive(requests, timeout=self._settings.deadline_s):
            robot = names.get(reply.metadata.src_node_id)
            if robot is None:
                continue
            try:
                if reply.has_error():
                    raise ValueError(reply.error.reason or f"error {reply.error.code}")
                if reply_sender(reply.content) != (robot, model.version):
                    raise ValueError("an answer to another request")
                found[robot] = read(reply.content)
            except (ValueError, KeyError, TypeError) as error:
                failed[robot] = printable_line(str(error))
        return found, failed

    def _present(self) -> dict[str, int]:
        """Node numbers by robot, in the order of the names."""
        return dict(sorted(self._grid.nodes().items()))

    def _connected(self) -> dict[str, int]:
        """Node numbers by robot, as soon as enough robots are connected."""
        while len(connected := self._present()) < self._settings.minimum_robots:
            self._wait_or_fail(f"{len(connected)} robots are there, {self._settings.minimum_robots} needed")
        return connected

    def _wait_or_fail(self, reason: str) -> None:
        if self._hooks.wait is None:
            raise TrainingError(f"no round can be completed: {reason}")
        self._hooks.wait(reason)

    def _model(self, weights: Weights) -> GlobalModel:
        return GlobalModel(weights, self._hooks.version(weights))


def _metrics(content: RecordDict) -> Metrics:
    """The metrics of a robot's answer; ValueError: it has none that could be."""
    metrics = valid_metrics(reply_metrics(content))
    if not metrics:
        raise ValueError("an answer with impossible metrics")
    return metrics


def _judgement(content: RecordDict) -> Judgement:
    """A robot's report on the pairs that it holds out; ValueError if it cannot be read as one."""
    return check_judgement(record_to_weights(content[ARRAYS_KEY]).get(PAIRS_KEY))


def _joined(reasons: Mapping[str, str]) -> str:
    """Reasons by robot as one text."""
    return "; ".join(f"{robot}: {reason}" for robot, reason in sorted(reasons.items())) or "nobody answered"


def _means(rows: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Mean of each loss over the robots."""
    names = dict.fromkeys(name for row in rows.values() for name in row)
    return {name: float(np.mean([row[name] for row in rows.values() if name in row])) for name in names}


def _sample(names: Iterable[str], fraction: float, minimum: int, rng: np.random.Generator) -> list[str]:
    """Draw robots for a round.

    Returns names in alphabetical order; ``minimum`` robots at least, if enough are connected.
    """
    everyone = sorted(names)
    count = min(max(int(np.ceil(fraction * len(everyone))), minimum), len(everyone))
    return [everyone[index] for index in sorted(rng.choice(len(everyone), count, replace=False))]
