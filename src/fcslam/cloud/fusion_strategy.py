"""The ways to fuse maps, by name. This module imports nothing heavy, for the command line's help."""

from enum import StrEnum


class FusionStrategy(StrEnum):
    """Ways to fuse."""

    JOINT = "joint"
    """All robots in one robust pose graph, every closure decided by all evidence."""
    N_POINT = "n_point"
    """Rigid maps, each pair aligned by all matched points in the least-squares sense."""
    TWO_POINT = "two_point"
    """Rigid maps, each pair aligned by its two most similar matched points: the paper's eqs. (5)-(6)."""
    FIRST_TWO = "first_two"
    """As ``two_point``, but by the two matched points that arrived first."""
