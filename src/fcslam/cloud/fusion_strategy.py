"""How several robots' maps become one: what can be chosen by name. Loads nothing, for the command line's help."""

from enum import StrEnum


class FusionStrategy(StrEnum):
    """Ways to fuse."""

    JOINT = "joint"
    """All robots in one robust pose graph, every closure decided by all evidence."""
    N_POINT = "n_point"
    """Rigid maps, each pair laid on one another by all their matched points, least squares."""
    TWO_POINT = "two_point"
    """Rigid maps, each pair laid on one another by their first two matched points: the paper's, eqs. (5)-(6)."""
