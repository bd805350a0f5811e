"""Weights as arrays, and as a network."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import TrainingError
from fcslam.federated.weights import Weights, weights_error
from fcslam.learning.export import detector_version
from fcslam.learning.local_training import network_from_state
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.settings import Encoder


def network_to_weights(network: KeypointNetwork) -> dict[str, NDArray[np.float32]]:
    """Everything in a network that is no counter."""
    return {
        name: tensor.detach().cpu().contiguous().numpy().copy()
        for name, tensor in network.state_dict().items()
        if tensor.is_floating_point()
    }


def weights_to_network(weights: Weights, encoder: Encoder) -> KeypointNetwork:
    """A network of these weights, in evaluation mode.

    Raises:
        TrainingError: they are of another network, or not finite.
    """
    empty = KeypointNetwork(encoder)
    reason = weights_error(weights, network_to_weights(empty))
    if reason is not None:
        raise TrainingError(f"no weights of a {encoder} network: {reason}")
    floats = {name: torch.from_numpy(np.asarray(array, order="C")) for name, array in weights.items()}
    return network_from_state(encoder, empty.state_dict() | floats)


def version_maker(encoder: Encoder) -> Callable[[Weights], str]:
    """What names the weights of such networks."""
    return lambda weights: detector_version(weights_to_network(weights, encoder))
