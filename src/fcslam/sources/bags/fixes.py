"""The fixes of a satellite receiver in a bag: sensor_msgs/NavSatFix."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

from fcslam.records import GnssFix
from fcslam.sources.bags.census import BagMessage
from fcslam.sources.bags.messages import header_of
from fcslam.sources.bags.rig import FARTHEST_SENSOR_M
from fcslam.sources.bags.transforms import NoTransformError, TransformTree, planar
from fcslam.sources.faults import Audit, Fault

SIGMA_M: Final = {0: 5.0, 1: 2.0, 2: 0.5}
"""Standard deviations of fixes without a covariance, by status: alone, corrected by satellite, by ground stations."""
NO_FIX: Final = -1
"""STATUS_NO_FIX; below, the status is unknown, as in messages that nobody set it in."""
FIX_INTERVAL_S: Final = 0.9
"""Least time between two fixes that are used; the errors of nearer ones are the same."""
LARGEST_SIGMA_M: Final = 1e4


class FixReader:
    """Turns the messages of a receiver into fixes, by the clock of the scans."""

    def __init__(self, tree: TransformTree, base_frame: str, ahead_s: float, audit: Audit) -> None:
        """The clock of the fixes is ``ahead_s`` ahead; ``audit`` counts the faults."""
        self._tree, self._base_frame, self._ahead_s, self._audit = tree, base_frame, ahead_s, audit
        self._used_s = -math.inf

    def read(self, message: BagMessage) -> Iterator[GnssFix]:
        """The fix in the next message, if there is one; it is left out if it comes soon after the one before."""
        try:
            found = self._fix(message.content, message.unstamped_ns)
        except ValueError:
            found = Fault.BROKEN_MESSAGE
        if isinstance(found, Fault):
            self._audit.add(found, message.number)
            return
        if message.content.status.status < NO_FIX:
            self._audit.add(Fault.UNKNOWN_FIX, message.number)
        if abs(found.stamp - self._used_s) >= FIX_INTERVAL_S:
            self._used_s = found.stamp
            yield replace(found, stamp=found.stamp - self._ahead_s)

    def _fix(self, content: Any, unstamped_ns: int) -> GnssFix | Fault:
        """Convert a message, or say what it lacks; a status that is not known counts as a fix.

        Latitude and longitude 0 are a fault: the receiver has no fix, and does not say so.
        """
        latitude, longitude, altitude = float(content.latitude), float(content.longitude), float(content.altitude)
        if content.status.status == NO_FIX:
            return Fault.NO_FIX
        if latitude == 0.0 == longitude:
            return Fault.FIX_AT_ZERO
        if abs(latitude) > 90.0:
            return Fault.NO_LATITUDE
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):  # false for NaN
            raise ValueError(f"latitude {latitude:g}, longitude {longitude:g} are not a position on the earth")
        stamp, frame = header_of(content.header, unstamped_ns)
        east2, north2 = float(content.position_covariance[0]), float(content.position_covariance[4])
        sigma_m = SIGMA_M.get(int(content.status.status), SIGMA_M[0])
        if content.position_covariance_type and min(east2, north2) > 0.0 and max(east2, north2) < LARGEST_SIGMA_M**2:
            sigma_m = (0.5 * (east2 + north2)) ** 0.5
        altitude_m = altitude if math.isfinite(altitude) else 0.0
        return GnssFix(stamp, latitude, longitude, altitude_m, sigma_m, self._antenna(frame))

    def _antenna(self, frame: str) -> tuple[float, float]:
        """Where tf says that the antenna sits; in the middle of the robot if it does not."""
        try:
            x, y, _ = planar(self._tree.fixed(self._base_frame, frame))
        except NoTransformError:
            return 0.0, 0.0
        if not math.hypot(x, y) <= FARTHEST_SENSOR_M:
            raise ValueError(f"the antenna is {math.hypot(x, y):g} m from the robot")
        return x, y
