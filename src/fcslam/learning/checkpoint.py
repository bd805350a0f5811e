"""Checkpoints: one `.npz` file without pickle, replaced in one piece, so that the last good one is always there."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fcslam.errors import OutputError, TrainingError
from fcslam.learning.arrays import read_arrays, write_arrays

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

    def part(self, prefix: str) -> dict[str, Tensor]:
        """The tensors whose names begin with ``prefix``, by what follows it."""
        return {name.removeprefix(prefix): each for name, each in self.tensors.items() if name.startswith(prefix)}


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
    try:
        write_arrays(path, arrays)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error}); make room and run the same command again") from error


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        TrainingError: the file is no checkpoint, or of another format.
    """
    try:
        arrays = read_arrays(path)
        header = json.loads(str(arrays.pop(_HEADER)))
        if header["format"] == FORMAT:
            tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
            return Checkpoint(header["stage"], header["step"], header["settings"], tensors)
        found = header["format"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"{path}: is no checkpoint of a training run ({error}); take it away") from error
    raise TrainingError(f"{path}: has format {found}, expected {FORMAT}; train anew in another folder")
