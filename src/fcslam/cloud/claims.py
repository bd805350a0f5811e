"""Limits of the data of a robot. No robot with a 2D LiDAR exceeds them, so no robot can exhaust or bend a mission."""

import math
from dataclasses import replace

import numpy as np
from pydantic import Field

from fcslam.config import Settings
from fcslam.errors import PacketError
from fcslam.geometry.groups import SE3, group_of
from fcslam.lidar.frontend import least_sigmas
from fcslam.lidar.verification import CLOSURE_SIGMA_M, CLOSURE_SIGMA_RAD
from fcslam.records import Constraint, ConstraintKind, FloatArray, Place, TagSighting, VoxelMap, frozen

_ROUNDING = 1.01
"""Information is sent in single precision, and standard deviations are compared by its diagonal."""
LONGEST_MOTION_M = 20.0
"""Largest motion between two consecutive keyscans, metres."""
LONGEST_CLOSURE_M = 50.0
"""Largest distance between two keyscans that a robot's own closure connects, metres."""
WIDEST_SUBMAP_M = 2.0 * LONGEST_CLOSURE_M
"""Largest distance of a keyscan from the anchor of its submap, metres."""
MOST_SUBMAP_KEYSCANS = 2000
"""Largest number of keyscans in a submap."""
HIGHEST_BASE_M = 10.0
"""Largest distance of a base from the floor below it, metres."""
FARTHEST_TAG_M = LONGEST_CLOSURE_M
"""Largest distance at which a camera reads a tag, metres."""
LEAST_SIGMA_M = 0.001
"""Least standard deviation of a position that a robot measures, metres."""
LEAST_SIGMA_RAD = 0.0002
"""Least standard deviation of a heading that a robot measures, radians."""


class ClaimLimits(Settings):
    """Bounds on the packets of a robot; a packet beyond one is refused with the reason."""

    distance_m: float = Field(
        default=20_000.0, gt=0, description="largest distance of a robot from its start, by its motions [m]"
    )
    packets_per_s: float = Field(
        default=1000.0,
        gt=0,
        description="packets per second that a service takes from a robot on average, twenty times as many at once",
    )
    sessions_per_hour: float = Field(
        default=60.0,
        ge=1,
        description="sessions per hour that a service takes from a robot on average, and as many at once",
    )


def check_constraint(constraint: Constraint, largest_m: float) -> None:
    """Check a constraint, whose length is at most ``largest_m``."""
    name = f"{constraint.robot}: constraint {constraint.i} to {constraint.j}"
    group = group_of(constraint.T_i_j)
    length_m = float(group.shift_m(constraint.T_i_j))
    if not length_m <= largest_m:
        raise PacketError(f"{name} is {length_m:.4g} m long, at most {largest_m:g} m")
    claimed = (constraint.information.diagonal() / _ROUNDING).tolist()
    position, turn = max(claimed[: group.axes]), max(claimed[group.axes :])
    if position > LEAST_SIGMA_M**-2 or turn > LEAST_SIGMA_RAD**-2:
        raise PacketError(
            f"{name} claims a standard deviation of {position**-0.5:.3g} m and {turn**-0.5:.3g} rad, at least "
            f"{LEAST_SIGMA_M:g} m and {LEAST_SIGMA_RAD:g} rad"
        )


def with_least_noise(constraint: Constraint) -> Constraint:
    """The constraint with the precision that scan matching has at best.

    More points do not reduce the errors of matching that neighbouring points share, nor those of the scanner's
    calibration (``least_sigmas``, ``CLOSURE_SIGMA_M``). Robots with 2D LiDARs state no more, those with 3D LiDARs do.
    """
    group, sigma_m, sigma_rad = group_of(constraint.T_i_j), CLOSURE_SIGMA_M, CLOSURE_SIGMA_RAD
    if constraint.kind is ConstraintKind.ODOMETRY:
        T = constraint.T_i_j
        sigma_m, sigma_rad = least_sigmas(float(group.shift_m(T)), float(group.turn_rad(T)))
    unit = group.sigmas(sigma_m, sigma_rad)
    eigenvalues, axes = np.linalg.eigh(constraint.information * np.outer(unit, unit))
    if eigenvalues[-1] <= _ROUNDING:
        return constraint
    information = (axes * np.minimum(eigenvalues, 1.0)) @ axes.T / np.outer(unit, unit)
    return replace(constraint, information=frozen(0.5 * (information + information.T)))


def check_distance(T_odom_base: FloatArray, robot: str, limits: ClaimLimits) -> None:
    """Check the pose (P,) of a keyscan by the robot's motions alone."""
    distance_m = float(group_of(T_odom_base).shift_m(T_odom_base))
    if not distance_m <= limits.distance_m:
        raise PacketError(
            f"{robot}: is {distance_m:.4g} m off its start, at most {limits.distance_m:g} m (fleet.claims)"
        )


def check_sighting(sighting: TagSighting) -> None:
    """Check a sighting of a tag."""
    distance_m = math.hypot(sighting.T_base_tag[0], sighting.T_base_tag[1])
    if not distance_m <= FARTHEST_TAG_M:
        name = f"{sighting.id.robot}: tag {sighting.tag}"
        raise PacketError(f"{name} is {distance_m:.4g} m away, at most {FARTHEST_TAG_M:g} m")


def check_voxel_map(voxels: VoxelMap) -> None:
    """Check where the floor below a robot is, and over how many keyscans a voxel map reaches."""
    name, below_m = f"{voxels.id.robot}: voxel map {voxels.id.number}", float(SE3.shift_m(voxels.T_base_ground))
    if not below_m <= HIGHEST_BASE_M:
        raise PacketError(f"{name} has its floor {below_m:.4g} m off the base, at most {HIGHEST_BASE_M:g} m")
    if voxels.last - voxels.first >= MOST_SUBMAP_KEYSCANS:
        raise PacketError(f"{name} is of {voxels.last - voxels.first + 1} keyscans, at most {MOST_SUBMAP_KEYSCANS}")


def check_submap(place: Place, poses: FloatArray) -> None:
    """Check the submap of a place, whose keyscans have these poses (N, P) by the robot's motions alone."""
    name = f"{place.id.robot}: {place.channel} place {place.id.number}"
    if len(poses) > MOST_SUBMAP_KEYSCANS:
        raise PacketError(f"{name} has {len(poses)} keyscans, at most {MOST_SUBMAP_KEYSCANS}")
    anchor = poses[place.id.number - place.first]
    group = group_of(poses)
    reach_m = float(group.shift_m(group.between(anchor, poses)).max())
    if not reach_m <= WIDEST_SUBMAP_M:
        raise PacketError(f"{name} has a keyscan {reach_m:.4g} m away, at most {WIDEST_SUBMAP_M:g} m")
