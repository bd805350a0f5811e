"""From two places' descriptors to the rigid motions that their keypoints propose, each with what it is worth.

LiDAR keypoints are points of the plane. Keypoints of images stand at a height as well: matching ones must be level,
since robots roll on one floor; then the motion is one of the plane, too.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.features.codes import Matches, mutual_matches
from fcslam.geometry import se2
from fcslam.places.hypotheses import Hypothesis, HypothesisConfig, propose
from fcslam.records import Channel, FloatArray, Place

INDEPENDENT: Final = 10
"""Keypoints of one image err together (the scan under them, the robot's pose): many fix a motion no better."""


class MotionConfig(Settings):
    """Matching the keypoints of two places."""

    hamming_limit: int = Field(default=60, gt=0, le=256, description="most different bits of matching descriptors")
    inliers: int = Field(default=8, ge=4, description="keypoints that must agree before geometry is asked")
    level_m: float = Field(default=0.1, gt=0.0, description="matching keypoints of images are level to this [m]")
    keypoint_sigma_m: float = Field(default=0.1, gt=0.0, description="error of an image's keypoint in place [m]")
    hypotheses: HypothesisConfig = Field(default=HypothesisConfig(), description="rigid motions from keypoints")


@dataclass(frozen=True, slots=True)
class Motion:
    """How two places may lie to each other."""

    T_a_b: FloatArray
    information: FloatArray
    """Of (x, y, theta) in a's coordinates, shape (3, 3): what images say where walls say nothing. Zeros for LiDAR: its
    keypoints are those walls."""
    share: float
    """Matching descriptors in the smaller of the two places."""


def motions(a: Place, b: Place, config: MotionConfig) -> list[Motion]:
    """Motions on which enough keypoints agree, the best first.

    Args:
        a: one place.
        b: another of the same detector version.
        config: the matching.
    """
    matches = mutual_matches(a.descriptors, b.descriptors, config.hamming_limit)
    if a.channel is Channel.CAMERA:
        matches = _level(a, b, matches, config.level_m)
    proposed = propose(a.keypoints[:, :2], b.keypoints[:, :2], matches, config.hypotheses)
    share = len(matches.pairs) / max(1, min(len(a.descriptors), len(b.descriptors)))
    return [
        Motion(h.T_a_b, _information(b, h, matches, config), share)
        for h in proposed
        if h.inlier_count >= config.inliers
    ]


def _level(a: Place, b: Place, matches: Matches, level_m: float) -> Matches:
    """The matches at one height."""
    heights_a, heights_b = a.keypoints[matches.pairs[:, 0], 2], b.keypoints[matches.pairs[:, 1], 2]
    level = np.abs(heights_a - heights_b) <= level_m
    return Matches(matches.pairs[level], matches.distances[level])


def _information(b: Place, hypothesis: Hypothesis, matches: Matches, config: MotionConfig) -> FloatArray:
    """Of the motion, from where its inliers are."""
    if b.channel is not Channel.CAMERA:
        return np.zeros((3, 3))
    inliers = b.keypoints[matches.pairs[hypothesis.inliers, 1], :2].astype(np.float64)
    turned = se2.transform((0.0, 0.0, hypothesis.T_a_b[2]), inliers)
    jacobian = np.zeros((len(turned), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -turned[:, 1], turned[:, 0]
    total = np.einsum("kij,kil->jl", jacobian, jacobian)
    return np.asarray(total * min(1.0, INDEPENDENT / len(inliers)) / config.keypoint_sigma_m**2)
