"""Length, duration and motion of a path, pose by pose: what every format's survey needs."""

from dataclasses import dataclass
from math import hypot, inf

from fcslam.sources.pose import Pose


@dataclass(slots=True)
class PathSummary:
    """Poses of one robot with their stamps, in file order."""

    count: int = 0
    length_m: float = 0.0
    """Length of the polyline through the positions."""
    moves: bool = False
    """Whether any two successive poses differ."""
    earliest: float = inf
    latest: float = -inf
    _pose: Pose | None = None

    def add(self, stamp: float, pose: Pose) -> None:
        """Append the next pose; ``stamp`` in seconds, ``pose`` in metres and radians."""
        if self._pose is not None and pose != self._pose:
            self.moves = True
            self.length_m += hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
        self._pose = pose
        self.count += 1
        self.earliest = min(self.earliest, stamp)
        self.latest = max(self.latest, stamp)

    @property
    def duration_s(self) -> float:
        """Between the earliest and the latest stamp; 0 without poses."""
        return max(0.0, self.latest - self.earliest)
