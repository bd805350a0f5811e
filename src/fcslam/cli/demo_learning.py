"""The demo's federated phase: the robots train the detector together on what their own cameras saw, for a moment."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fcslam.errors import OutputError
from fcslam.records import CameraImage

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.sources import Source

IMAGES = 24
"""Taken from each robot's recording, evenly."""
ROUNDS, STEPS = 2, 6
TRAINING = {"pairs": 4, "side_px": 160, "label_copies": 2}
"""Seconds, not hours: enough to see everything happen, too little to gain much."""
PNG = b"\x89PNG"


def missing_libraries() -> list[str]:
    """What the phase would need and what is not installed."""
    return [name for name in ("torch", "flwr", "onnx") if find_spec(name) is None]


def learn_together(sources: "Sequence[Source]", folder: Path, seed: int, console: "Console") -> Path | None:
    """Train from the detector that comes with fcslam, a line for each round; what was released, if it is no worse.

    Args:
        sources: one recording a robot. The images go into folders of their own, which only their robot reads.
        folder: for everything that is made.
        seed: of the training.
        console: where rounds are told.

    Returns:
        The network that the fleet takes; None where no round was as good as what it had.

    Raises:
        TrainingError: the robots saw too little to train on.
        OutputError: something cannot be written.
    """
    from fcslam.cli.federate import line_of
    from fcslam.config import parse
    from fcslam.features.detector import BUNDLED_NETWORK
    from fcslam.federated.history import RoundReport
    from fcslam.federated.job import FederatedJob, ProgressCallbacks
    from fcslam.federated.local import federate_locally
    from fcslam.federated.settings import FederatedSettings
    from fcslam.learning.trainer import ExecutionOptions

    given = {"rounds": ROUNDS, "local_steps": STEPS, "judge_every": 1, "normalisation": "frozen"}
    settings = parse(FederatedSettings, given | {"training": TRAINING | {"seed": seed}}, "the demo")
    homes = [_own_images(source, folder / "images" / source.name) for source in sources]
    released = False

    def tell(report: RoundReport) -> None:
        nonlocal released
        released |= report.released
        console.print(line_of(report.row(), settings.rounds), highlight=False, soft_wrap=True)

    files = federate_locally(
        homes, FederatedJob(folder, settings, BUNDLED_NETWORK), ExecutionOptions(), ProgressCallbacks(rounds=tell)
    )
    return files[0] if released else None


def _own_images(source: "Source", home: Path) -> Path:
    """A folder with some images of a recording."""
    images = [record.encoded for record in source.records() if isinstance(record, CameraImage)]
    try:
        home.mkdir(parents=True)
        for number in np.unique(np.linspace(0, len(images) - 1, IMAGES).astype(int)):
            suffix = "png" if images[number].startswith(PNG) else "jpg"
            (home / f"{number:05d}.{suffix}").write_bytes(images[number])
    except OSError as error:
        raise OutputError(f"{home}: cannot be written ({error}); make room or choose another --output") from error
    return home
