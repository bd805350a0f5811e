"""How a fleet trains together."""

from typing import Literal, Self

from pydantic import Field, model_validator

from fcslam.config import Settings
from fcslam.learning.settings import TrainingSettings

StrategyName = Literal["fedavg", "fedprox", "fedadam", "fedmedian", "fedtrimmedavg", "krum"]
Normalisation = Literal["averaged", "frozen"]


class ScreeningSettings(Settings):
    """Which updates are refused, beside those that are malformed or not finite."""

    largest_change: float | None = Field(
        default=1.0, gt=0.0, description="an update's length, in lengths of the weights; null for any"
    )
    longest: float | None = Field(
        default=3.0, gt=1.0, description="its length, in medians of the round's lengths; null for any"
    )
    least_agreement: float | None = Field(
        default=-0.03, ge=-1.0, le=1.0, description="its cosine with the median of the others; null for any"
    )
    quorum: int = Field(default=4, ge=3, description="updates from which on they are compared with one another")


class PrivacySettings(Settings):
    """Noise that a robot adds to its update before it leaves."""

    clip_norm: float = Field(default=1.0, gt=0.0, description="updates longer than this are shortened to it")
    noise_multiplier: float = Field(default=0.0, ge=0.0, description="standard deviation in clip norms; 0 is neither")
    delta: float = Field(default=1e-5, gt=0.0, lt=1.0, description="chance that epsilon does not hold")


class FederatedSettings(Settings):
    """One federated training run."""

    rounds: int = Field(default=200, ge=1, description="rounds of local training and aggregation")
    local_steps: int = Field(default=10, ge=1, description="optimiser steps of a robot in a round")
    judge_every: int = Field(
        default=5, ge=1, description="rounds from one judged version to the next; these and the last may be released"
    )
    strategy: StrategyName = Field(default="fedavg", description="how updates become one, by Flower's class")
    participation: float = Field(default=1.0, gt=0.0, le=1.0, description="share of the robots asked in a round")
    minimum_robots: int = Field(default=1, ge=1, description="updates without which a round does not count")
    deadline_s: float = Field(default=3600.0, gt=0.0, description="robots that answer later are left out of a round")
    proximal: float = Field(default=0.01, ge=0.0, description="strength of FedProx's pull to the global weights")
    compatible: float = Field(
        default=0.0, ge=0.0, description="how strongly codes are kept to those of the first weights; 0 is not at all"
    )
    server_momentum: float = Field(
        default=0.5,
        ge=0.0,
        lt=1.0,
        description="Nesterov's, between rounds; 1 - 1/N of N robots at most; 0 is none; not for fedadam, krum",
    )
    smoothing: float = Field(
        default=0.8,
        ge=0.0,
        lt=1.0,
        description="share of the mean of earlier rounds in what is judged and released; falls with the learning rate",
    )
    server_rate: float = Field(default=0.003, gt=0.0, description="learning rate of FedAdam")
    trimmed: float = Field(default=0.2, ge=0.0, lt=0.5, description="share that FedTrimmedAvg cuts at either end")
    malicious: int = Field(default=1, ge=0, description="poisoned robots that Krum reckons with")
    normalisation: Normalisation = Field(
        default="averaged", description="batch statistics: averaged like weights, or frozen as they were at the start"
    )
    collapse: float = Field(
        default=0.15, gt=0.0, le=1.0, description="drop of the score below the best that takes the fleet back to it"
    )
    screening: ScreeningSettings = Field(default_factory=ScreeningSettings, description="which updates are refused")
    privacy: PrivacySettings = Field(default_factory=PrivacySettings, description="noise on what leaves a robot")
    training: TrainingSettings = Field(
        default_factory=TrainingSettings, description="of a robot; its steps are rounds times local_steps"
    )

    @model_validator(mode="after")
    def _variances_stay_positive(self) -> Self:
        if self.normalisation == "averaged" and (self.strategy == "fedadam" or self.privacy.noise_multiplier > 0.0):
            raise ValueError("FedAdam and noise may turn variances negative: they need normalisation: frozen")
        return self

    def client_training(self) -> TrainingSettings:
        """The training settings with the steps of the whole run."""
        return self.training.model_copy(update={"steps": self.rounds * self.local_steps})
