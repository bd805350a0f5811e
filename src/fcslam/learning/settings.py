"""How a detector is trained."""

from typing import Literal

from pydantic import Field

from fcslam.config import Settings

Encoder = Literal["light", "vgg"]


class LossSettings(Settings):
    """What training minimises; each weight multiplies a mean."""

    triplet: float = Field(default=1.0, ge=0.0, description="weight of eq. (2), the triplet loss of the binary codes")
    margin: float = Field(default=1.0, ge=0.0, description="its margin at the end, ramped up; 0 is the paper's")
    contrastive: float = Field(default=1.0, ge=0.0, description="weight of InfoNCE on the smooth codes")
    temperature: float = Field(default=0.05, gt=0.0, description="its temperature, for similarities in [-1, 1]")
    distillation: float = Field(default=30.0, ge=0.0, description="weight of the teacher's bits; a quarter at the end")
    balance: float = Field(default=0.1, ge=0.0, description="weight of the bits' balance")
    detector: float = Field(default=1.0, ge=0.0, description="weight of the detector's cross entropy")
    agreement: float = Field(default=1.0, ge=0.0, description="weight of both views' keypoint maps being alike")


class TrainingSettings(Settings):
    """One training run."""

    encoder: Encoder = Field(default="light", description="light, or vgg as in the paper")
    steps: int = Field(default=20_000, ge=1, description="optimiser steps")
    shape_steps: int = Field(default=5_000, ge=1, description="steps on synthetic shapes before, without a teacher")
    label_copies: int = Field(default=16, ge=0, description="warped copies of an image that vote on its labels")
    pairs: int = Field(default=8, ge=1, description="pairs of views a step")
    side_px: int = Field(default=192, ge=64, multiple_of=8, description="side of a view [px]")
    points: int = Field(default=320, ge=16, description="points compared in a pair")
    learning_rate: float = Field(default=2e-3, gt=0.0, description="highest, after the warm-up")
    seed: int = Field(default=1, ge=0, description="another seed trains another detector")
    loss: LossSettings = Field(default_factory=LossSettings, description="what is minimised")
