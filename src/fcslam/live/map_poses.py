"""Where a live robot's odometry lies in the map: by the server's corrections, and by those of the robot's own map."""

import threading
from collections.abc import Callable
from dataclasses import replace

from fcslam.geometry.groups import SE2, compose, group_of
from fcslam.records import Correction, FloatArray, frozen


class CorrectedOdometry:
    """``T_map_base = T_map_odom T_odom_base``. A correction moves ``odom`` in ``map``, never the robot in ``odom``: a
    controller that uses ``odom`` sees no jump."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.correction: Correction | None = None
        """The newest one; None before the first one, as all that follows from it."""
        self._arrived_s = 0.0

    def correct(self, correction: Correction) -> None:
        """Apply a correction unless a newer one was applied before. Any thread may call this."""
        if self.correction is None or correction.version > self.correction.version:
            self._arrived_s, self.correction = self._clock(), correction  # others read without a lock

    def move(self, T_map_odom: FloatArray) -> None:
        """Move ``odom`` in the map of the newest correction, as shape (P,)."""
        if self.correction is not None:
            self.correction = replace(self.correction, T_map_odom=frozen(T_map_odom))

    @property
    def map_index(self) -> int | None:
        """Index of the robot's map."""
        return None if self.correction is None else self.correction.map_index

    @property
    def quality(self) -> float:
        """Quality of the newest correction, in [0, 1], as in ``Correction``; 0 before the first one."""
        return 0.0 if self.correction is None else self.correction.quality

    @property
    def age_s(self) -> float | None:
        """Time since the newest correction, seconds."""
        return None if self.correction is None else self._clock() - self._arrived_s

    def T_map_base(self, T_odom_base: FloatArray) -> FloatArray | None:
        """Poses of ``base`` in the map, given those in ``odom``, shape (..., P); in space if the map is."""
        return None if self.correction is None else compose(self.correction.T_map_odom, T_odom_base)


class MapPoses:
    """Corrections by session; a robot that was lost goes on in another one. Any thread may call."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._own: dict[int, CorrectedOdometry] = {}
        self._by_server: dict[int, CorrectedOdometry] = {}
        self._T_map_own: dict[int, FloatArray] = {}
        """Where the robot's own map lies in the map of the server, by its newest correction."""
        self._lock = threading.Lock()

    def localizer(self, session: int) -> CorrectedOdometry:
        """The localizer of a session: with the server's corrections as soon as there is one, else the robot's own."""
        return self._by_server.get(session) or self._own.setdefault(session, CorrectedOdometry(self._clock))

    def T_map_own(self, session: int) -> FloatArray:
        """Where the robot's own map lies in the map of its poses, shape (P,)."""
        return self._T_map_own.get(session, SE2.identity)

    def correct(self, session: int, correction: Correction, is_server_away: bool) -> None:
        """Take a correction of the robot's own map. While the server is away, it counts for the pose."""
        with self._lock:
            own = self._own.setdefault(session, CorrectedOdometry(self._clock))
            own.correct(correction)
            if session in self._T_map_own and own.correction is not None and is_server_away:
                T_map_odom = compose(self._T_map_own[session], own.correction.T_map_odom)
                self._by_server[session].move(T_map_odom)

    def correct_by_server(self, session: int, correction: Correction) -> None:
        """Take a correction of the server."""
        with self._lock:
            by_server = self._by_server.setdefault(session, CorrectedOdometry(self._clock))
            by_server.correct(correction)
            if by_server.correction is correction:
                own = self._own.get(session)
                T_own_odom = SE2.identity if own is None or own.correction is None else own.correction.T_map_odom
                self._T_map_own[session] = compose(correction.T_map_odom, group_of(T_own_odom).inverse(T_own_odom))
