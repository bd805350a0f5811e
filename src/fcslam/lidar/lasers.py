"""The lasers of one robot, distinguished by their mounting and their beams."""

from fcslam.geometry.beams import is_same_laser
from fcslam.records import LaserModel


class Lasers:
    """The lasers seen so far, in the order of their first scans. The beams of one laser may vary from scan to scan."""

    def __init__(self) -> None:
        self._known: list[LaserModel] = []

    @property
    def known(self) -> tuple[LaserModel, ...]:
        """Each with the beams of its first scan."""
        return tuple(self._known)

    def index(self, laser: LaserModel) -> int:
        """Index of the laser of a scan in ``known``; an unknown one is added."""
        for index, known in enumerate(self._known):
            if is_same_laser(laser, known):
                return index
        self._known.append(laser)
        return len(self._known) - 1
