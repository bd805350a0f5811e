"""Options of a federated run."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.mission_options import SettingsFiles, chosen_settings
from fcslam.cli.output import TRAINING, new_folder
from fcslam.cli.training_options import Quick, Start, compute_budget

if TYPE_CHECKING:
    from fcslam.learning.federated.job import FederatedJob
    from fcslam.learning.federated.settings import FederatedSettings
    from fcslam.learning.trainer import ExecutionOptions

QUICK: dict[str, object] = {"rounds": 3, "local_steps": 6, "judge_every": 1}
QUICK_TRAINING = {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Settings of ``--quick``: every stage runs, none long enough to learn much."""


@dataclass(frozen=True)
class RoundFlags:
    """What the rounds of a run train, from what, and how."""

    config: SettingsFiles = None
    start: Start = None
    public: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of public images, on which the server evaluates detectors. Can be repeated."),
    ] = None
    quick: Quick = False

    def settings(self) -> "FederatedSettings":
        """The settings that the command line chooses.

        Raises:
            ConfigError: a file cannot be read, or a value is invalid.
        """
        from fcslam.config import changed
        from fcslam.learning.federated.settings import FederatedSettings

        base = FederatedSettings()
        if self.quick:
            base = changed(base, QUICK | {"training": QUICK_TRAINING}, "--quick")
        return chosen_settings(base, self.config)

    def job(self, output: Path | None, settings: "FederatedSettings") -> "FederatedJob":
        """The run with these settings, in its folder."""
        from fcslam.learning.federated.job import FederatedJob

        return FederatedJob(output or new_folder(TRAINING), settings, self.start, tuple(self.public or ()))

    def compute_budget(self) -> "ExecutionOptions":
        """How to train."""
        return compute_budget(self.quick)


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``; brackets around an IPv6 address are removed.

    Raises:
        TrainingError: it is none.
    """
    from fcslam.errors import TrainingError

    host, colon, port = text.rpartition(":")
    if not (colon and host.strip("[]") and port.isdecimal() and 0 < int(port) < 65536):
        raise TrainingError(f"{text}: is not a HOST:PORT")
    return host.strip("[]"), int(port)
