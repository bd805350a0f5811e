"""Checkpoints: one `.npz` file without pickle, replaced in one piece, so that the last good one is always there."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fcslam.errors import OutputError, TrainingError

FORMAT = 1
_HEADER = "header"


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Where a training run stands."""

    stage: str
    step: int
    """Steps done."""
    settings: dict[str, Any]
    """Of the run; another run's checkpoint is refused."""
    tensors: dict[str, Tensor]
    """Everything by name: network, average, optimiser."""


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write beside the last checkpoint, then take its place.

    Raises:
        OutputError: it cannot be written, for want of room, say; the last one stays.
    """
    header = {
        "format": FORMAT,
        "stage": checkpoint.stage,
        "step": checkpoint.step,
        "settings": checkpoint.settings,
    }
    arrays: dict[str, Any] = {_HEADER: np.array(json.dumps(header))}
    arrays |= {name: tensor.detach().cpu().numpy() for name, tensor in checkpoint.tensors.items()}
    unfinished = path.with_suffix(".part")
    try:
        with unfinished.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        unfinished.replace(path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise OutputError(f"{path}: cannot be written ({error}); make room and run the same command again") from error


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        TrainingError: the file is no checkpoint, or of another format.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(str(file[_HEADER]))
            tensors = {name: torch.from_numpy(file[name]) for name in file.files if name != _HEADER}
        if header["format"] != FORMAT:
            raise TrainingError(
                f"{path}: has format {header['format']}, expected {FORMAT}; train anew in another folder"
            )
        return Checkpoint(header["stage"], header["step"], header["settings"], tensors)
    except TrainingError:
        raise
    except Exception as error:  # whatever a foreign or broken archive makes numpy, zipfile or json raise
        raise TrainingError(f"{path}: is no checkpoint of a training run ({error}); take it away") from error
