"""Options and checks of all commands that train detectors."""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.errors import TrainingError

if TYPE_CHECKING:
    from fcslam.learning.trainer import ExecutionOptions

TRAINING_OUTPUT = "Folder for everything that training writes. If it holds an unfinished run, training continues it."

Start = Annotated[
    Path | None,
    typer.Option(
        help="Weights to start from: a checkpoint.npz, a detector.onnx, or vgg, which comes with fcslam.",
        show_default="training on synthetic shapes",
    ),
]
Quick = Annotated[bool, typer.Option("--quick", help="Train for about a minute, only to check that everything works.")]

QUICK_IMAGES = 4
"""Images of a robot: labelling one takes vgg some seconds."""
QUICK_VALIDATION_PAIRS = 2
"""A validation of vgg on all pairs takes half a minute."""


def require_training_libraries(*others: str, extra: str = "train") -> None:
    """Raise TrainingError if a library that training needs, or one of ``others``, is missing."""
    missing = [name for name in ("torch", "onnx", "onnxruntime", *others) if find_spec(name) is None]
    if missing:
        raise TrainingError(f"training needs {', '.join(missing)}; install it with: pip install 'fcslam[{extra}]'")


def compute_budget(quick: bool = False) -> "ExecutionOptions":
    """How to train here: on a GPU if CUDA shows one, the threads, and how often to validate and log."""
    import torch

    from fcslam.learning.trainer import ExecutionOptions

    device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=device)
    except RuntimeError as error:
        raise TrainingError(
            f"the GPU that CUDA names cannot be used ({error}); set CUDA_VISIBLE_DEVICES to nothing to train without"
        ) from error
    threads = 1 if device == "cpu" else max((os.cpu_count() or 2) - 1, 1)
    if quick:
        return ExecutionOptions(
            device=device, threads=threads, validate_every=20, validation_pairs=QUICK_VALIDATION_PAIRS, log_every=20
        )
    return ExecutionOptions(device=device, threads=threads)
