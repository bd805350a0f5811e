"""Converts between networks and weights, float32 arrays by name, on which aggregation and screening work."""

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.errors import InputError
from fcslam.learning.export import detector_version
from fcslam.learning.federated.weights import Weights, weights_error
from fcslam.learning.network import KeypointNetwork, network_from_state
from fcslam.learning.settings import Encoder


def network_to_weights(network: KeypointNetwork) -> dict[str, NDArray[np.float32]]:
    """Copies of all arrays of a network except its integer counters."""
    return {
        name: tensor.detach().cpu().contiguous().numpy().copy()
        for name, tensor in network.state_dict().items()
        if tensor.is_floating_point()
    }


def weights_to_network(weights: Weights, encoder: Encoder) -> KeypointNetwork:
    """A network with these weights, in evaluation mode."""
    empty = KeypointNetwork(encoder)
    reason = weights_error(weights, network_to_weights(empty))
    if reason is not None:
        raise InputError(f"no weights of a {encoder} network: {reason}")
    tensors = {name: torch.from_numpy(np.asarray(array, order="C")) for name, array in weights.items()}
    return network_from_state(encoder, empty.state_dict() | tensors)


def weights_version(weights: Weights, encoder: Encoder) -> str:
    """The detector version that a network with these weights gets, such as `light-0a1b2c3d4e5f`."""
    return detector_version(weights_to_network(weights, encoder))
