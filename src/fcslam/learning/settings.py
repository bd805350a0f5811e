"""Settings of the training of a detector."""

from typing import Literal

from pydantic import Field

from fcslam.config import Settings

Encoder = Literal["light", "vgg"]
Negatives = Literal["hardest", "all"]


class LossSettings(Settings):
    """The objective of training: a sum of losses, each of them a mean with a weight."""

    triplet: float = Field(
        default=1.0, ge=0.0, description="weight of the triplet loss of the binary descriptors, eq. (2) of the paper"
    )
    margin: float = Field(
        default=1.0,
        ge=0.0,
        description="margin of the triplet loss at the end of training, to which it rises; 0 as in the paper",
    )
    negatives: Negatives = Field(
        default="hardest",
        description="negatives of the triplet loss: the hardest one of a pair, or all; the paper does not say",
    )
    rounding: float = Field(
        default=0.01,
        gt=0.0,
        description="added under the root of eq. (3), whose gradient is infinite where two codes are equal; the paper "
        "has 0",
    )
    contrastive: float = Field(
        default=1.0, ge=0.0, description="weight of the InfoNCE loss of the descriptors before they become binary"
    )
    temperature: float = Field(
        default=0.05, gt=0.0, description="temperature of the InfoNCE loss, for similarities in [-1, 1]"
    )
    distillation: float = Field(
        default=30.0,
        ge=0.0,
        description="weight of the distillation of a teacher's descriptors; falls to a quarter during training",
    )
    balance: float = Field(
        default=0.1, ge=0.0, description="weight of the loss that makes every bit 0 and 1 equally often"
    )
    detector: float = Field(default=1.0, ge=0.0, description="weight of the cross entropy of the keypoint maps")
    agreement: float = Field(
        default=1.0, ge=0.0, description="weight of the loss that makes the keypoint maps of both views agree"
    )
    keypoints: float = Field(
        default=100.0,
        ge=0.0,
        description="weight of the loss that leaves keypoints where they are while the layers of the codes are trained",
    )


class TrainingSettings(Settings):
    """Settings of a training run."""

    encoder: Encoder = Field(default="light", description="encoder of the network: light, or vgg as in the paper")
    steps: int = Field(default=20_000, ge=1, description="optimizer steps of the joint training on images")
    shape_steps: int = Field(
        default=5_000, ge=1, description="optimizer steps on synthetic shapes before; not used with a teacher"
    )
    label_copies: int = Field(
        default=16, ge=0, description="warped copies of an image over which its keypoint labels are averaged"
    )
    pairs: int = Field(default=8, ge=1, description="pairs of views in a batch")
    side_px: int = Field(default=192, ge=64, multiple_of=8, description="width and height of a view [px]")
    points: int = Field(default=320, ge=16, description="points of a pair whose descriptors are compared")
    learning_rate: float = Field(default=2e-3, gt=0.0, description="learning rate after the warm-up, its highest value")
    seed: int = Field(default=1, ge=0, description="seed of all random draws; another seed trains another detector")
    loss: LossSettings = Field(default_factory=LossSettings, description="weights of the losses")
