"""State of a robot from round to round: the weights of its first round, and the state of its optimizer.

File names contain a checksum of the run's number and nothing else that a server sends. So no server can make a robot
write outside its folder.
"""

import contextlib
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from fcslam.errors import InputError
from fcslam.learning.arrays import write_arrays
from fcslam.learning.federated.weights import Weights
from fcslam.untrusted import read_arrays


def first_weights(cache: Path, run_id: str, round_number: int, weights: Weights) -> Weights:
    """The weights of the first round of the run in which the robot took part; these ones if it is this round."""
    path = cache / f"former-{_checksum(run_id)}.npz"
    with translate_errors(path, "the weights of the first round cannot be kept"):
        if round_number == 0 or not path.exists():
            write_arrays(path, weights)
        return read_arrays(path)


def load_moments(cache: Path, run_id: str, round_number: int) -> dict[str, Tensor] | None:
    """The optimizer's state after the latest earlier round in which the robot trained; None without such a round."""
    earlier = [each for each in _saved_rounds(cache, run_id) if each < round_number]
    if not earlier:
        return None
    path = _state_path(cache, run_id, max(earlier))
    with translate_errors(path, "the optimizer's state cannot be read"):
        return {name: torch.from_numpy(array) for name, array in read_arrays(path).items()}


def save_moments(cache: Path, run_id: str, round_number: int, moments: Mapping[str, Tensor]) -> None:
    """Save the optimizer's state after a round, and keep that of the round before.

    A server that was killed may repeat the round.
    """
    path = _state_path(cache, run_id, round_number)
    with translate_errors(path, "the optimizer's state cannot be kept"):
        write_arrays(path, {name: value.cpu().numpy() for name, value in moments.items()})
        before = [each for each in _saved_rounds(cache, run_id) if each < round_number]
        for each in _saved_rounds(cache, run_id):
            if each != round_number and each != max(before, default=None):
                _state_path(cache, run_id, each).unlink()


def _saved_rounds(cache: Path, run_id: str) -> list[int]:
    pattern = re.compile(r"moments-[0-9a-f]{8}-(\d+)")
    names = (pattern.fullmatch(file.stem) for file in cache.glob(f"moments-{_checksum(run_id)}-*"))
    return [int(name[1]) for name in names if name]


def _state_path(cache: Path, run_id: str, round_number: int) -> Path:
    return cache / f"moments-{_checksum(run_id)}-{round_number}.npz"


def _checksum(run_id: str) -> str:
    return f"{zlib.crc32(run_id.encode()):08x}"


@contextlib.contextmanager
def translate_errors(path: Path, failure: str) -> Iterator[None]:
    """Raise errors of reading or writing ``path`` as InputError; ``failure`` says what could not be done."""
    try:
        yield
    except (OSError, TypeError, ValueError) as error:  # torch does not support every dtype of NumPy
        raise InputError(f"{path}: {failure} ({error}); free disk space or remove the file") from error
