"""Checkpoints of training: `.npz` files without pickle, written atomically, so the last good one always stays."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fcslam.errors import InputError, writing
from fcslam.learning.arrays import write_arrays
from fcslam.untrusted import read_arrays

FORMAT = 1
"""Version of the file format."""
_HEADER = "header"


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The state of a training run."""

    stage: str
    step: int
    """Steps done."""
    settings: dict[str, Any]
    """Settings of the run; a run with other settings does not continue from this checkpoint."""
    tensors: dict[str, Tensor]
    """All tensors of network, averaged network and optimizer, by name."""
    examples: int = 0
    """Checksum of what is trained on; a run on something else does not continue from this checkpoint."""

    def part(self, prefix: str) -> dict[str, Tensor]:
        """The tensors whose names begin with ``prefix``, by the rest of their names."""
        return {name.removeprefix(prefix): each for name, each in self.tensors.items() if name.startswith(prefix)}


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint atomically."""
    header = {
        "format": FORMAT,
        "stage": checkpoint.stage,
        "step": checkpoint.step,
        "settings": checkpoint.settings,
        "examples": checkpoint.examples,
    }
    arrays: dict[str, Any] = {_HEADER: np.array(json.dumps(header))}
    arrays |= {name: tensor.detach().cpu().numpy() for name, tensor in checkpoint.tensors.items()}
    with writing(path):
        write_arrays(path, arrays)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint."""
    try:
        arrays = read_arrays(path)
        header = json.loads(str(arrays.pop(_HEADER)))
        if header["format"] == FORMAT:
            tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
            return Checkpoint(header["stage"], header["step"], header["settings"], tensors, header.get("examples", 0))
        found = header["format"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: is not a checkpoint of a training run ({error}); remove it") from error
    raise InputError(f"{path}: has format {found}, expected {FORMAT}; start again in another folder")
