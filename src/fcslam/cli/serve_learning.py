"""How `fcslam serve --learn` starts the process in which its robots learn together."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from fcslam.cli.learning_options import LEARNING_FILE
from fcslam.learning.federated.settings import DETECTOR, RELEASE

if TYPE_CHECKING:
    from fcslam.learning.federated.settings import FleetLearningSettings
    from fcslam.service.http.state import ServiceState


class FleetLearningPlan(NamedTuple):
    """How the robots of the service learn."""

    output: Path
    """Folder of the rounds."""
    settings: "FleetLearningSettings"


def learning_plan(learn: bool, data: Path, store: str | None) -> FleetLearningPlan | None:
    """Check all that learning needs, before anything starts; None without --learn.

    Args:
        learn: whether the robots learn.
        data: folder of the missions; it may hold a file of settings, and receives the rounds.
        store: database of the missions; None: they are files.

    Raises:
        ConfigError: the settings cannot be used.
        ServiceError: options do not fit.
        TrainingError: a library is missing.
    """
    from fcslam.cli.training_options import require_training_libraries
    from fcslam.config import load
    from fcslam.errors import ServiceError
    from fcslam.learning.federated.settings import FleetLearningSettings

    if not learn:
        return None
    if store is not None:
        raise ServiceError("--learn works with missions in --data; leave out --store")
    config = data / LEARNING_FILE
    settings = FleetLearningSettings()
    if config.exists():
        settings = load(FleetLearningSettings, config, over=settings)
    if not settings.federated.on_revisits:
        raise ServiceError(f"{config}: a fleet that maps trains on what it saw again; set federated.trained to codes")
    require_training_libraries("flwr", extra="federated")
    return FleetLearningPlan(data / "learning", settings)


@contextmanager
def learning_process(plan: FleetLearningPlan, state: "ServiceState") -> Iterator[Path]:
    """Run the process in which the fleet learns beside the block; robots get what it releases.

    Gives the Unix socket of the process, in a folder that only this user can open.
    """
    import logging
    import sys
    import tempfile
    import time

    from fcslam.errors import FcslamError
    from fcslam.service.supervisor import Supervisor

    log = logging.getLogger("fcslam.service")

    def announce(event: str, _number: int) -> None:
        if event != RELEASE:
            return
        try:
            file = state.missions.detectors.announce((plan.output / DETECTOR).read_bytes())
        except (FcslamError, OSError) as error:
            log.error("a release of learning cannot be announced: %s", error)
        else:
            log.warning("robots are to use detector %s from now on", file.version)

    with tempfile.TemporaryDirectory(prefix="fcslam-") as folder:
        listener = Path(folder) / "learning"
        command = (
            sys.executable,
            "-m",
            "fcslam.learning.federated.fleet_learning",
            "--listener",
            str(listener),
            "--settings",
            plan.settings.model_dump_json(),
            "--output",
            str(plan.output),
        )
        learner = Supervisor(state.missions.root, time.monotonic, announce, command)
        typer.echo(f"robots learn here; rounds are in {plan.output}")
        try:
            yield listener
        finally:
            learner.stop()
