"""Options and checks of all commands that train detectors, and of robots that learn with their fleet."""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.errors import InputError

if TYPE_CHECKING:
    from fcslam.learning.federated.learning_process import RobotLearningPlan
    from fcslam.learning.trainer import ExecutionOptions
    from fcslam.robot.frontend import RobotConfig
    from fcslam.wire.keys import Server

TRAINING_OUTPUT = "Folder for everything that training writes. If it holds an unfinished run, training continues it."

Start = Annotated[
    Path | None,
    typer.Option(
        help="Weights to start from: a checkpoint.state, a detector.onnx, or vgg, which comes with fcslam.",
        show_default="the bundled network; with a teacher, none",
    ),
]
LEARNING_FILE = "learning.yaml"
"""Settings of learning, in a robot's state folder or a service's data folder; each key has a default."""

Learn = Annotated[
    bool,
    typer.Option(
        "--learn",
        rich_help_panel="Learning",
        help="Train the detector with the fleet on places that the camera saw again: after a recording, and while a "
        "live robot stands still. No image leaves. Settings: learning.yaml in --state.",
    ),
]


def require_training_libraries(*others: str, extra: str = "train") -> None:
    """Raise InputError if a library that training needs, or one of ``others``, is missing."""
    missing = [name for name in ("torch", "onnx", "onnxruntime", "matplotlib", *others) if find_spec(name) is None]
    if missing:
        raise InputError(f"training needs {', '.join(missing)}; install it with: pip install 'fcslam[{extra}]'")


def compute_budget() -> "ExecutionOptions":
    """How to train here: on a GPU if CUDA shows one, and the threads."""
    import torch

    from fcslam.learning.trainer import ExecutionOptions

    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=device)
    except RuntimeError as error:
        raise InputError(
            f"the GPU that CUDA names cannot be used ({error}); set CUDA_VISIBLE_DEVICES to nothing to train without"
        ) from error
    threads = 1 if device == "cpu" else max((os.cpu_count() or 2) - 1, 1)
    return ExecutionOptions(device=device, threads=threads)


def learning_plan(
    settings: "RobotConfig", server: "Server | None", credentials: Path | None, state: Path | None
) -> "RobotLearningPlan":
    """Where and how a robot learns with this service; ``state`` is its state folder."""
    from fcslam.config import load
    from fcslam.features.detector_kinds import DetectorKind
    from fcslam.learning.federated.learning_process import RobotLearningPlan
    from fcslam.learning.federated.settings import RobotLearningSettings
    from fcslam.records import Channel
    from fcslam.wire.http_transport import addresses

    if server is None or state is None:
        raise InputError(
            "a robot learns with the fleet of a service, from keyframes on its disk: give --server and --state"
        )
    if Channel.CAMERA not in settings.channels or settings.views.detector is not DetectorKind.ONNX:
        raise InputError("--learn trains the camera's network; robot.channels or robot.views.detector leave it out")
    file = state / LEARNING_FILE
    chosen = load(RobotLearningSettings, file) if file.exists() else RobotLearningSettings()
    require_training_libraries()
    return RobotLearningPlan(addresses(server.url)[0], chosen, state, credentials)
