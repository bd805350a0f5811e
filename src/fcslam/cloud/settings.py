"""The settings of the cloud; a mission stores them, so that its result can be computed again from its packets."""

from enum import StrEnum
from typing import Self

from pydantic import Field, PositiveFloat, model_validator

from fcslam.cloud.claims import ClaimLimits
from fcslam.config import Settings
from fcslam.geometry.groups import SE2, SE3, Group
from fcslam.graph.evidence import ConsistencySettings
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.places.matcher import MatchDecision, MatcherConfig


class FusionStrategy(StrEnum):
    """Ways to fuse maps."""

    JOINT = "joint"
    """All robots in one robust pose graph, every closure decided by all evidence."""
    TWO_POINT = "two_point"
    """Rigid maps, aligned by their two most similar matched points (eqs. (5)-(6) of the paper) and what agrees."""


class FleetConfig(Settings):
    """Settings of the fleet."""

    join_maps: bool = Field(
        default=True, description="join maps of robots that saw the same places; false keeps one map for each robot"
    )
    fusion: FusionStrategy = Field(
        default=FusionStrategy.JOINT,
        description="how maps are fused: joint (one robust graph), or two_point (rigid maps, as in the paper)",
    )
    dimensions: int = Field(
        default=2, ge=2, le=3, description="3: poses in space, for robots with 3D LiDARs (--3d); 2: in the plane"
    )
    solve_every: int = Field(
        default=40,
        gt=0,
        description="new closures after which their maps are solved again; 5 % of all closures if that is more",
    )
    submaps_kept: int = Field(
        default=1000,
        gt=1,
        description="number of submaps in the cache, 0.05 MB each; those beyond it are rebuilt from their keyscans",
    )
    starts: dict[str, tuple[float, float, float]] = Field(
        default={},
        description="where robots started, by their names: x and y [m] and theta [rad], in one frame. Closures that "
        "agree with the starts of both robots pass the loose gate with a third of its points",
    )
    start_sigma: tuple[PositiveFloat, PositiveFloat] = Field(
        default=(0.3, 0.1), description="standard deviations of the starts, [m] in x and y and [rad] in theta"
    )
    claims: ClaimLimits = Field(default=ClaimLimits(), description="bounds on what a robot may claim")
    matcher: MatcherConfig = Field(default=MatcherConfig(), description="place recognition")
    consistency: ConsistencySettings = Field(
        default=ConsistencySettings(), description="pairwise consistency of closures, and the rule for joining maps"
    )

    @model_validator(mode="after")
    def _words_measure_no_transform(self) -> Self:
        if self.matcher.decision is MatchDecision.SIMILARITY and self.fusion is FusionStrategy.JOINT:
            raise ValueError(
                "matcher.decision similarity measures no transform, which the joint graph needs; "
                "set fusion to two_point"
            )
        if self.dimensions == 3 and self.fusion is not FusionStrategy.JOINT:
            raise ValueError("fusion two_point aligns maps in the plane; set dimensions to 2")
        return self

    @property
    def group(self) -> Group:
        """Group of the poses: SE(2) or SE(3)."""
        return SE2 if self.dimensions == 2 else SE3


class CloudConfig(Settings):
    """Settings of the cloud: the part of a configuration that a mission stores."""

    seed: int = Field(default=0, ge=0, description="seed of the random generator; the same seed gives the same run")
    fleet: FleetConfig = Field(default=FleetConfig(), description="settings of the fleet")
    map: OccupancyConfig = Field(default=OccupancyConfig(), description="the occupancy grid")
