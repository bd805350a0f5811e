"""The only place that converts between weights and Flower's records, in which they are sent."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fcslam.learning.federated.flower import Array, ArrayRecord
from fcslam.learning.federated.weights import Weights


def weights_to_record(weights: Weights) -> ArrayRecord:
    """Serialise weights."""
    return ArrayRecord({name: Array(np.asarray(array, order="C")) for name, array in weights.items()})


def record_to_weights(record: object) -> dict[str, NDArray[np.float32]]:
    """Deserialise weights. Names, shapes, types and values are not checked, see ``weights_error``.

    Raises:
        ValueError: this is not a record of arrays, or one of its arrays cannot be read.
    """
    checked = _array_record(record)
    try:
        arrays = {str(name): array.numpy() for name, array in checked.items()}
    except Exception as error:  # NumPy's parser fails in many ways on bytes that it did not write
        raise ValueError(f"an array that cannot be read: {type(error).__name__}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError("an archive in place of an array")
    return arrays


def record_bytes(record: object) -> int:
    """Size of the serialised arrays of a record [bytes].

    Raises:
        ValueError: this is not a record of arrays.
    """
    return sum(len(array.data) for array in _array_record(record).values())


@dataclass(frozen=True)
class GlobalModel:
    """Weights of the whole fleet, with everything that is derived from them. Each of it is derived once."""

    weights: Weights
    version: str
    """Detector version of the weights."""

    @cached_property
    def record(self) -> ArrayRecord:
        """The serialised weights."""
        return weights_to_record(self.weights)

    @cached_property
    def size_bytes(self) -> int:
        """Size of the serialised weights."""
        return record_bytes(self.record)


def _array_record(record: object) -> ArrayRecord:
    if not isinstance(record, ArrayRecord):
        raise ValueError(f"a {type(record).__name__} in place of a {ArrayRecord.__name__}")
    return record
