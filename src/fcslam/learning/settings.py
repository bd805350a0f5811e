"""Settings of the training of a detector."""

from typing import Final, Literal

from pydantic import Field

from fcslam.config import Settings

DETECTOR: Final = "detector.onnx"
"""File of the trained detector in the output folder."""

Encoder = Literal["light", "vgg"]
Losses = Literal["default", "paper"]


class TrainingSettings(Settings):
    """Settings of a training run."""

    encoder: Encoder = Field(default="light", description="encoder of the network: light, or vgg as in the paper")
    steps: int = Field(default=20_000, ge=1, description="optimizer steps of the joint training on images")
    label_copies: int = Field(
        default=16, ge=0, description="warped copies of an image over which its keypoint labels are averaged"
    )
    pairs: int = Field(default=8, ge=1, description="pairs of views in a batch")
    side_px: int = Field(default=192, ge=64, multiple_of=8, description="width and height of a view [px]")
    learning_rate: float = Field(default=2e-3, gt=0.0, description="learning rate after the warm-up, its highest value")
    seed: int = Field(default=1, ge=0, description="seed of all random draws; another seed trains another detector")
    losses: Losses = Field(
        default="default",
        description="losses of the descriptors: default, or paper for eqs. (1)-(3) alone, without a margin",
    )
