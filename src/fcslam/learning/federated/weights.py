"""Weights of a network as float32 arrays by name, and arithmetic on them."""

from collections.abc import Collection, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

Weights = Mapping[str, NDArray[np.float32]]
"""Arrays by their names in the network, in the network's order; integer counters are left out."""
FloatVector = NDArray[np.float64]
BATCH_NORM_EPSILON: Final = 1e-5
"""Added to variances by batch normalisation."""

MEAN, VARIANCE = "running_mean", "running_var"
STATISTICS = (MEAN, VARIANCE)
"""Suffixes of the names of batch normalisation's statistics."""


def parameter_names(weights: Weights) -> list[str]:
    """Names of the arrays that are no batch statistics."""
    return [name for name in weights if not name.endswith(STATISTICS)]


def update_vector(new: Weights, old: Weights, names: Collection[str]) -> FloatVector:
    """The differences ``new`` - ``old`` of the named arrays, concatenated in the order of the names, shape (N,)."""
    parts = [(new[name].astype(np.float64) - old[name]).ravel() for name in names]
    return np.concatenate(parts) if parts else np.zeros(0)


def interpolate_weights(old: Weights, new: Weights, share: float) -> dict[str, NDArray[np.float32]]:
    """The weighted mean ``share`` * ``old`` + (1 - ``share``) * ``new``."""
    # Computed as a difference and not as a sum of products, so that equal values stay equal to the last bit.
    return {name: np.asarray(new[name] + share * (old[name] - new[name]), np.float32) for name in old}


def size_bytes(weights: Weights) -> int:
    """Size of the arrays."""
    return sum(array.nbytes for array in weights.values())


def weights_error(new: Weights, old: Weights) -> str | None:
    """The reason why ``new`` cannot be weights of the same network as ``old``; None if it can."""
    if new.keys() != old.keys():
        odd = sorted(new.keys() ^ old.keys())
        return f"other arrays than asked for ({odd[0]}{', ...' if len(odd) > 1 else ''})"
    for name, array in old.items():
        if new[name].shape != array.shape:
            return f"{name} has shape {new[name].shape}, not {array.shape}"
        if new[name].dtype != np.float32:
            return f"{name} is {new[name].dtype}, not float32"
        if not np.isfinite(new[name]).all():
            return f"{name} holds numbers that are not finite"
        if name.endswith(VARIANCE) and (new[name] < 0.0).any():
            return f"{name} holds negative variances"
    return None
