"""The federated stage of the demo: the robots train the detector together on what each saw again in its own map."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fcslam.cli.output import print_line

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.learning.federated.client import RobotClient
    from fcslam.mission.mission import MissionConfig
    from fcslam.sources import Source

ROUNDS, STEPS, JUDGED = 6, 50, 2
"""Rounds, steps of each robot in a round, and rounds between two decisions: about two minutes of one processor."""
HELD_OUT = 3
"""One in this many squares of each robot's map is held out: of one in four, short drives have fewer than 200 pairs."""


def learn_together(
    sources: "Sequence[Source]", config: "MissionConfig", folder: Path, console: "Console"
) -> Path | None:
    """Train the bundled detector further, and print a line for each round.

    Args:
        sources: one recording for each robot. The keyframes of each robot go into a folder that only this robot reads.
        config: of the mission.
        folder: output of the training.
        console: for progress and the lines of the rounds.

    Returns:
        The released network; None if no round passed the gate.

    Raises:
        TrainingError: no robot saw anything again.
        OutputError: something cannot be written.
    """
    from fcslam.cli.federate.rounds import round_line
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.config import parse
    from fcslam.features.detector import BUNDLED_NETWORK
    from fcslam.learning.federated.client_app import in_process_grid
    from fcslam.learning.federated.history import RoundReport
    from fcslam.learning.federated.job import FederatedJob, ProgressCallbacks, run_job
    from fcslam.learning.federated.live_settings import GateSettings, LiveRounds
    from fcslam.learning.trainer import ExecutionOptions

    given = {"rounds": ROUNDS, "local_steps": STEPS, "judge_every": JUDGED, "minimum_robots": 1}
    settings = parse(LiveRounds, given, "the demo")
    training = settings.training.model_copy(update={"seed": config.seed})
    settings = settings.model_copy(update={"training": training})
    reports: list[RoundReport] = []

    def watch(report: RoundReport) -> None:
        reports.append(report)
        print_line(console, round_line(report.row(), settings.rounds))
        display.show("rounds", report.round_number, settings.rounds)

    with ProgressDisplay(console) as display:
        clients = []
        for number, source in enumerate(sources):
            display.show("looking for what was seen again", number, len(sources))
            clients.append(_learner(source, config, folder / "robots" / source.name))
        display.show("looking for what was seen again", len(sources), len(sources))
        job = FederatedJob(folder, settings, BUNDLED_NETWORK, gate=GateSettings())
        files = run_job(job, ExecutionOptions(), ProgressCallbacks(rounds=watch), in_process_grid(clients))
    best = next((report for report in reversed(reports) if report.released), None)
    if best is None:
        print_line(console, f"the fleet keeps the bundled detector: {reports[-1].reason}")
        return None
    gain, pairs = best.metrics["revisit_recall_gain"], int(best.metrics["pairs"])
    print_line(
        console,
        f"the fleet takes round {best.round_number}: of the points that two images share, {best.score:.1%} match, "
        f"{100.0 * gain:+.1f} points, on {pairs} pairs that no robot trained on",
    )
    return files[0]


def _learner(source: "Source", config: "MissionConfig", folder: Path) -> "RobotClient":
    """A robot that drove its recording, with what it saw again."""
    from fcslam.learning.federated.client import RobotClient
    from fcslam.learning.federated.live_settings import HeldOutSettings, RobotLearningSettings
    from fcslam.learning.federated.own_examples import own_examples
    from fcslam.robot.backend import RobotBackend
    from fcslam.robot.backend_runner import InlineBackend
    from fcslam.robot.frontend import RobotFrontend

    keyframes = folder / "keyframes"
    backend = RobotBackend(source.name, config.robot, keyframes)
    robot = RobotFrontend(source.name, config.robot, InlineBackend(backend))
    for record in source.records():
        robot.process(record)
    robot.finish()
    settings = RobotLearningSettings(held_out=HeldOutSettings(every=HELD_OUT))
    examples = own_examples(keyframes, settings)
    return RobotClient(source.name, keyframes, folder / "cache", revisits=examples.revisits, held_out=examples.held_out)
