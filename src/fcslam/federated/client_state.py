"""What a robot keeps from one round to the next: the first weights, and what its optimiser has learnt of gradients.

Files are called by a number of the run's name and by nothing else that a server says, so they are files of the folder.
"""

import contextlib
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from fcslam.errors import TrainingError
from fcslam.federated.weights import Weights
from fcslam.learning.arrays import read_arrays, write_arrays


def legacy_weights(cache: Path, run: str, round_number: int, weights: Weights) -> Weights:
    """The weights that the run began from, or the first that came here of a run that had begun before.

    Raises:
        TrainingError: they cannot be kept.
    """
    path = cache / f"former-{_number(run)}.npz"
    with translate_errors(path, "the first weights cannot be kept there"):
        if round_number == 0 or not path.exists():
            write_arrays(path, weights)
        return read_arrays(path)


def load_optimiser_state(cache: Path, run: str, round_number: int) -> dict[str, Tensor] | None:
    """Those at the end of the last round before this one that the robot trained in; None if it trained in none.

    Raises:
        TrainingError: they cannot be read.
    """
    earlier = [each for each in _rounds(cache, run) if each < round_number]
    if not earlier:
        return None
    path = _moments_path(cache, run, max(earlier))
    with translate_errors(path, "the optimiser's memory cannot be read"):
        return {name: torch.from_numpy(array) for name, array in read_arrays(path).items()}


def save_optimiser_state(cache: Path, run: str, round_number: int, moments: Mapping[str, Tensor]) -> None:
    """Keep them, and those before: a server that was killed may ask for the same round again.

    Raises:
        TrainingError: they cannot be kept.
    """
    path = _moments_path(cache, run, round_number)
    with translate_errors(path, "the optimiser's memory cannot be kept there"):
        write_arrays(path, {name: value.cpu().numpy() for name, value in moments.items()})
        before = [each for each in _rounds(cache, run) if each < round_number]
        for each in _rounds(cache, run):
            if each != round_number and each != max(before, default=None):
                _moments_path(cache, run, each).unlink()


def _rounds(cache: Path, run: str) -> list[int]:
    """Rounds whose end is kept."""
    names = (re.fullmatch(r"moments-[0-9a-f]{8}-(\d+)", file.stem) for file in cache.glob(f"moments-{_number(run)}-*"))
    return [int(name[1]) for name in names if name]


def _moments_path(cache: Path, run: str, round_number: int) -> Path:
    return cache / f"moments-{_number(run)}-{round_number}.npz"


def _number(run: str) -> str:
    return f"{zlib.crc32(run.encode()):08x}"


@contextlib.contextmanager
def translate_errors(path: Path, failure: str) -> Iterator[None]:
    """Raise errors of reading or writing ``path`` as TrainingError; ``failure`` says what could not be done."""
    try:
        yield
    except (OSError, TypeError, ValueError) as error:  # torch does not support every dtype of NumPy
        raise TrainingError(f"{path}: {failure} ({error}); free disk space or remove the file") from error
