"""The motion of a robot during a scan, from the odometry around it."""

from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np

from fcslam.geometry import se2
from fcslam.records import Sweep
from fcslam.sources.pose import Pose

SAMPLES: Final = 9
"""Poses by odometry that the motion during a sweep is fitted to."""
LARGEST_ACCELERATION: Final = 50.0
"""Largest acceleration of a robot, m/s^2 and rad/s^2; odometry that jumps shows more."""


class Reading(Protocol):
    """A pose by odometry at a time."""

    @property
    def stamp(self) -> float:
        """Seconds."""

    @property
    def T_odom_base(self) -> Pose:
        """Metres and radians."""


class _Track(NamedTuple):
    """Poses by odometry around a sweep, in the order of their stamps."""

    stamps: np.ndarray
    poses: np.ndarray

    def at(self, stamps: np.ndarray) -> np.ndarray:
        """Poses at ``stamps`` (N,), interpolated, shape (N, 3); before the first and after the last these two."""
        return np.stack([np.interp(stamps, self.stamps, axis) for axis in self.poses.T], axis=1)


def moving_sweep(sweep: Sweep, stamp: float, readings: Sequence[Reading]) -> Sweep:
    """The sweep with the motion by odometry: the least-squares fit of a constant acceleration.

    Args:
        sweep: the times of the beams.
        stamp: of the scan, seconds.
        readings: odometry up to the scan and beyond it, the newest last; those of a clock that stepped back are left
            out.
    """
    track = _around(sweep, stamp, readings)
    if track is None:
        return sweep
    # Odometry that ends within the sweep says nothing about the rest of it: the fit goes on.
    begin_s = max(min(sweep.first_s, sweep.last_s), track.stamps[0] - stamp)
    end_s = min(max(sweep.first_s, sweep.last_s), track.stamps[-1] - stamp)
    if end_s - begin_s < 0.5 * sweep.duration_s:
        begin_s, end_s = track.stamps[0] - stamp, track.stamps[-1] - stamp
    times = np.linspace(begin_s, end_s, SAMPLES)
    motion = se2.between(track.at(np.array([stamp]))[0], track.at(stamp + times))
    design = np.stack((times, 0.5 * times**2), axis=1)
    (velocity, acceleration), *_ = np.linalg.lstsq(design, motion, rcond=None)
    if np.abs(acceleration).max() > LARGEST_ACCELERATION:
        velocity, acceleration = np.linalg.lstsq(design[:, :1], motion, rcond=None)[0][0], np.zeros(3)
    (vx, vy, vtheta), (ax, ay, atheta) = velocity.tolist(), acceleration.tolist()
    return sweep._replace(velocity=(vx, vy, vtheta), acceleration=(ax, ay, atheta))


def _around(sweep: Sweep, stamp: float, readings: Sequence[Reading]) -> _Track | None:
    """The readings from one before the sweep to one after it; None if there are fewer than two."""
    first_s, last_s = stamp + min(0.0, sweep.first_s, sweep.last_s), stamp + max(0.0, sweep.first_s, sweep.last_s)
    near: list[Reading] = []
    for reading in reversed(readings):
        if near and reading.stamp >= near[-1].stamp:
            break
        if reading.stamp >= last_s:
            near.clear()
        near.append(reading)
        if reading.stamp <= first_s and len(near) > 1:
            break
    if len(near) < 2:
        return None
    near.reverse()
    poses = np.array([reading.T_odom_base for reading in near])
    poses[:, 2] = np.unwrap(poses[:, 2])
    return _Track(np.array([reading.stamp for reading in near]), poses)
