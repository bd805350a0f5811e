"""Options of a federated run."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.output import TRAINING, new_folder
from fcslam.cli.training_options import Device, Quick, Start, compute_budget

if TYPE_CHECKING:
    from fcslam.learning.federated.job import FederatedJob
    from fcslam.learning.federated.settings import FederatedSettings
    from fcslam.learning.trainer import ExecutionOptions

QUICK = {"rounds": 3, "local_steps": 6, "judge_every": 1}
QUICK_TRAINING = {"shape_steps": 30, "pairs": 2, "side_px": 96, "label_copies": 2}
"""Settings of ``--quick``: every stage runs, none long enough to learn much."""
_FROM_SETTINGS = "that of the settings"


@dataclass(frozen=True)
class RoundFlags:
    """What the rounds of a run train, from what, and how."""

    config: Annotated[Path | None, typer.Option(help="YAML file of federated settings.")] = None
    start: Start = None
    public: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of public images, on which the server evaluates detectors. Can be repeated."),
    ] = None
    strategy: Annotated[
        str | None,
        typer.Option(
            help="Aggregation: fedavg, fedprox, fedadam, fedmedian, fedtrimmedavg or krum.",
            show_default=_FROM_SETTINGS,
        ),
    ] = None
    rounds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of rounds. More rounds than before continue a finished run.",
            show_default=_FROM_SETTINGS,
        ),
    ] = None
    device: Device = "auto"
    quick: Quick = False

    def settings(self) -> "FederatedSettings":
        """The settings in the file, or the default ones, with the changes of the command line.

        Raises:
            ConfigError: the file cannot be read, or a value is invalid.
        """
        from fcslam.config import load, parse
        from fcslam.learning.federated.settings import FederatedSettings

        content = (FederatedSettings() if self.config is None else load(FederatedSettings, self.config)).model_dump()
        if self.quick:
            content |= QUICK
            content["training"] |= QUICK_TRAINING
        given = {"strategy": self.strategy, "rounds": self.rounds}
        content |= {name: value for name, value in given.items() if value is not None}
        return parse(FederatedSettings, content, "the command line")

    def job(self, output: Path | None, settings: "FederatedSettings") -> "FederatedJob":
        """The run with these settings, in its folder."""
        from fcslam.learning.federated.job import FederatedJob

        return FederatedJob(output or new_folder(TRAINING), settings, self.start, tuple(self.public or ()))

    def compute_budget(self) -> "ExecutionOptions":
        """How to train; raises TrainingError if the device cannot be used."""
        return compute_budget(self.device, self.quick)


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
