"""Public images: the only ones that the server may read. It evaluates detectors on them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch

from fcslam.errors import InputError
from fcslam.features.detector import GreyImage
from fcslam.learning.federated.evaluation import EvaluateFn, Metrics
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.federated.weights import Weights
from fcslam.learning.images import find_images, is_usable, read_image
from fcslam.learning.labels import Labels
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import Encoder
from fcslam.learning.stages import SyntheticShapes
from fcslam.learning.validation import validate, validation_pairs

STATISTICS_IMAGES: Final = 64


def read_public_images(roots: Sequence[Path]) -> list[GreyImage]:
    """Usable images below the folders; none without folders."""
    if not roots:
        return []
    images = [image for file in find_images(roots) if (image := read_image(file.path)) is not None]
    usable = [image for image in images if is_usable(image)]
    if not usable:
        raise InputError(f"{roots[0]}: no image there is large enough and has enough corners to evaluate detectors")
    return usable


def public_evaluation(images: Sequence[GreyImage], encoder: Encoder, device: str) -> EvaluateFn | None:
    """Evaluation of weights on pairs of views of these images, always the same pairs; None without images."""
    if not images:
        return None
    unlabelled = Labels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    pairs = validation_pairs([TrainingExample(image, unlabelled) for image in images])

    def evaluate(weights: Weights) -> Metrics:
        return validate(weights_to_network(weights, encoder).to(device), pairs, torch.device(device))

    return evaluate


def statistics_images(public: Sequence[GreyImage]) -> list[GreyImage]:
    """Images that give batch normalisation its statistics: public ones, or synthetic shapes."""
    if public:
        return list(public[:: max(len(public) // STATISTICS_IMAGES, 1)])[:STATISTICS_IMAGES]
    return [example.image for example in SyntheticShapes(2, STATISTICS_IMAGES)[:]]
