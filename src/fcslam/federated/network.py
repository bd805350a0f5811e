"""Weights as arrays, and as a network."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.weights import Weights, malformed
from fcslam.learning.export import version_of
from fcslam.learning.leg import network_with
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.settings import Encoder


def weights_of(network: KeypointNetwork) -> dict[str, NDArray[np.float32]]:
    """Everything in a network that is no counter."""
    return {
        name: tensor.detach().cpu().contiguous().numpy().copy()
        for name, tensor in network.state_dict().items()
        if tensor.is_floating_point()
    }


def network_of(weights: Weights, encoder: Encoder) -> KeypointNetwork:
    """A network of these weights, in evaluation mode.

    Raises:
        TrainingError: they are of another network, or not finite.
    """
    empty = KeypointNetwork(encoder)
    reason = malformed(weights, weights_of(empty))
    if reason is not None:
        raise TrainingError(f"no weights of a {encoder} network: {reason}")
    floats = {name: torch.from_numpy(np.asarray(array, order="C")) for name, array in weights.items()}
    return network_with(encoder, empty.state_dict() | floats)


def version_maker(encoder: Encoder) -> Callable[[Weights], str]:
    """What names the weights of such networks."""
    return lambda weights: version_of(network_of(weights, encoder))
