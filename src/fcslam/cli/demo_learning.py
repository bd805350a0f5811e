"""The federated stage of the demo: the robots train the detector together on their own images, for a moment."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fcslam.cli.output import print_line
from fcslam.errors import OutputError
from fcslam.records import CameraImage

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.sources import Source

IMAGES = 24
"""Number of images taken from each recording, evenly spaced."""
ROUNDS, STEPS = 2, 6
TRAINING = {"pairs": 4, "side_px": 160, "label_copies": 2}
"""Seconds, not hours: enough to see everything happen, too little to gain much."""
PNG = b"\x89PNG"


def missing_libraries() -> list[str]:
    """The libraries that this stage needs and that are not installed."""
    return [name for name in ("torch", "flwr", "onnx") if find_spec(name) is None]


def learn_together(sources: "Sequence[Source]", folder: Path, seed: int, console: "Console") -> Path | None:
    """Train the bundled detector further, and print a line for each round.

    Args:
        sources: one recording for each robot. The images of each robot go into a folder that only this robot reads.
        folder: output of the training.
        seed: of the training.
        console: for progress and the lines of the rounds.

    Returns:
        The released network; None if no round was as good as the bundled one.

    Raises:
        TrainingError: the recordings have too few images to train on.
        OutputError: something cannot be written.
    """
    from fcslam.cli.federate.rounds import round_line
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.config import parse
    from fcslam.features.detector import BUNDLED_NETWORK
    from fcslam.federated.history import RoundReport
    from fcslam.federated.job import FederatedJob, ProgressCallbacks
    from fcslam.federated.local import federate_locally
    from fcslam.federated.settings import FederatedSettings
    from fcslam.learning.trainer import ExecutionOptions

    given = {"rounds": ROUNDS, "local_steps": STEPS, "judge_every": 1, "normalisation": "frozen"}
    settings = parse(FederatedSettings, given | {"training": TRAINING | {"seed": seed}}, "the demo")
    folders = [_own_images(source, folder / "images" / source.name) for source in sources]
    released = False

    def watch(report: RoundReport) -> None:
        nonlocal released
        released |= report.released
        print_line(console, round_line(report.row(), settings.rounds))
        display.show("rounds", report.round_number, settings.rounds)

    job = FederatedJob(folder, settings, BUNDLED_NETWORK)
    with ProgressDisplay(console) as display:
        display.show("rounds", 0, settings.rounds)
        files = federate_locally(folders, job, ExecutionOptions(), ProgressCallbacks(rounds=watch))
    return files[0] if released else None


def _own_images(source: "Source", home: Path) -> Path:
    """Write some images of a recording into the folder ``home``."""
    images = [record.encoded for record in source.records() if isinstance(record, CameraImage)]
    try:
        home.mkdir(parents=True)
        for number in np.unique(np.linspace(0, len(images) - 1, IMAGES).astype(int)):
            suffix = "png" if images[number].startswith(PNG) else "jpg"
            (home / f"{number:05d}.{suffix}").write_bytes(images[number])
    except OSError as error:
        raise OutputError(f"{home}: cannot be written ({error}); make room or choose another --output") from error
    return home
