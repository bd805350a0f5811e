"""Pose of a robot in the fleet's map: its own smooth motion, corrected by the cloud."""

from collections.abc import Callable
from dataclasses import replace

from fcslam.geometry import se2
from fcslam.records import Correction, FloatArray, frozen


class CorrectedOdometry:
    """``T_map_base = T_map_odom T_odom_base``. A correction moves ``odom`` in ``map``, never the robot in ``odom``: a
    controller that uses ``odom`` sees no jump."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._corrected: tuple[Correction, float] | None = None
        """The newest correction and the time of its arrival."""

    def correct(self, correction: Correction) -> None:
        """Apply a correction unless a newer one was applied before. Any thread may call this."""
        if self._corrected is None or correction.version > self._corrected[0].version:
            self._corrected = correction, self._clock()

    def move(self, T_map_odom: FloatArray) -> None:
        """Move ``odom`` in the map of the newest correction, as shape (3,); nothing before the first one."""
        if self._corrected is not None:
            correction, arrived_s = self._corrected
            self._corrected = replace(correction, T_map_odom=frozen(T_map_odom)), arrived_s

    @property
    def correction(self) -> Correction | None:
        """The newest correction; None before the first one."""
        return None if self._corrected is None else self._corrected[0]

    @property
    def map_index(self) -> int | None:
        """Index of the robot's map; None before the first correction."""
        return None if self._corrected is None else self._corrected[0].map_index

    @property
    def quality(self) -> float:
        """Quality of the newest correction, in [0, 1], as in ``Correction``; 0 before the first one."""
        return 0.0 if self._corrected is None else self._corrected[0].quality

    @property
    def age_s(self) -> float | None:
        """Time since the newest correction, seconds; None before the first one."""
        return None if self._corrected is None else self._clock() - self._corrected[1]

    def T_map_base(self, T_odom_base: FloatArray) -> FloatArray | None:
        """Poses of ``base`` in the fleet's map, given those in ``odom``, shape (..., 3), metres and radians; None
        before the first correction."""
        return None if self._corrected is None else se2.compose(self._corrected[0].T_map_odom, T_odom_base)
