"""Where a robot is in the fleet's map: its own smooth motion, and where the cloud says that this lies."""

from collections.abc import Callable

import numpy as np

from fcslam.geometry import se2
from fcslam.lidar.mapper import ScanPose
from fcslam.records import Constraint, Correction, FloatArray, frozen


class Localizer:
    """``T_map_base = T_map_odom T_odom_base``. A correction moves ``odom`` in ``map``, never the robot in ``odom``:
    what drives by ``odom`` feels no jump."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._T_odom_keyscan: list[FloatArray] = [frozen(np.zeros(3))]
        """Of every keyscan; the first is the origin of ``odom``."""
        self._corrected: tuple[Correction, float] | None = None
        """The newest correction and when it came."""

    def extend(self, motion: Constraint) -> None:
        """The robot's motion to its next keyscan, as it tells the cloud."""
        self._T_odom_keyscan.append(se2.compose(self._T_odom_keyscan[motion.i], motion.T_i_j))

    def correct(self, correction: Correction) -> None:
        """Take over a correction; an older one than the last changes nothing. Any thread may call this."""
        if self._corrected is None or correction.version > self._corrected[0].version:
            self._corrected = correction, self._clock()

    @property
    def map_index(self) -> int | None:
        """Which of the fleet's maps the robot is in; None: the cloud has not said."""
        return None if self._corrected is None else self._corrected[0].map_index

    @property
    def quality(self) -> float:
        """How well the newest correction is borne out, in [0, 1]; 0 before the first one."""
        return 0.0 if self._corrected is None else self._corrected[0].quality

    @property
    def age_s(self) -> float | None:
        """How long ago the last correction came; None: none has."""
        return None if self._corrected is None else self._clock() - self._corrected[1]

    def T_odom_base(self, pose: ScanPose) -> FloatArray:
        """Where a scan was taken, shape (3,)."""
        return se2.compose(self._T_odom_keyscan[pose.keyscan], pose.T_keyscan_base)

    def T_map_base(self, pose: ScanPose) -> FloatArray | None:
        """The same in the fleet's map, by the newest correction; None before the first one."""
        if self._corrected is None:
            return None
        return se2.compose(self._corrected[0].T_map_odom, self.T_odom_base(pose))
