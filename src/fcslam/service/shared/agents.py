"""The agents of robots, known to all instances, and the limit of robots that send to one instance."""

import threading
from collections.abc import Callable
from typing import Final

from fcslam.service.intake import AGENT_LEASE_S, Agents, BusyError, held_by_another
from fcslam.service.shared.schema import schema_of
from fcslam.storage.postgres import Postgres

CONFIRM_S: Final = AGENT_LEASE_S / 3.0
"""An instance asks the store so long after it asked last."""
ELSEWHERE_S: Final = 5.0
"""How long a robot waits that comes to a full instance."""


class RobotLimit:
    """How many robots send to this instance. Any thread may call."""

    def __init__(self, most: int, clock: Callable[[], float]) -> None:
        self._most, self._clock = most, clock
        self._lock = threading.Lock()
        self._heard: dict[tuple[int, str], float] = {}

    def admit(self, mission: int, robot: str) -> None:
        """Count a robot that sends."""
        now = self._clock()
        with self._lock:
            if (mission, robot) not in self._heard and len(self._heard) >= self._most:
                self._heard = {who: heard for who, heard in self._heard.items() if now < heard + AGENT_LEASE_S}
                if len(self._heard) >= self._most:
                    raise BusyError(
                        f"{robot}: this instance takes {self._most} robots (FCSLAM_MAX_ROBOTS); send to another one",
                        ELSEWHERE_S,
                    )
            self._heard[mission, robot] = now


class SharedAgents(Agents):
    """The agents of one mission's robots."""

    def __init__(self, server: Postgres, mission: int, limit: RobotLimit, clock: Callable[[], float]) -> None:
        super().__init__(clock)
        self._server, self._mission, self._limit = server, mission, limit
        self._confirmed: dict[tuple[str, str], float] = {}
        """When the store said last that an agent speaks for a robot."""

    def hold(self, robot: str, agent: str) -> None:
        """Let an agent speak for a robot."""
        self._limit.admit(self._mission, robot)
        if self._clock() >= self._confirmed.get((robot, agent), -CONFIRM_S) + CONFIRM_S:
            self._confirm(robot, agent)
        self.note(robot, agent)

    def _confirm(self, robot: str, agent: str) -> None:
        taken = self._server.rows(
            "INSERT INTO agents VALUES (?, ?, clock_timestamp()) ON CONFLICT (robot) DO UPDATE"
            " SET agent = excluded.agent, heard = clock_timestamp() WHERE agents.agent = excluded.agent"
            f" OR agents.heard < clock_timestamp() - interval '{AGENT_LEASE_S} seconds' RETURNING 1",
            (robot, agent),
            schema_of(self._mission),
        )
        if not taken:
            raise held_by_another(robot, AGENT_LEASE_S)
        with self._lock:
            self._confirmed = {known: at for known, at in self._confirmed.items() if known[0] != robot}
            self._confirmed[robot, agent] = self._clock()

    def silent_s(self, robot: str) -> float | None:
        """Seconds since the robot's last batch to this instance, or about that to another one; None: never."""
        here = super().silent_s(robot)
        rows = self._server.rows(
            "SELECT CAST(extract(epoch FROM clock_timestamp() - heard) AS DOUBLE PRECISION) FROM agents"
            " WHERE robot = ?",
            (robot,),
            schema_of(self._mission),
        )
        known = [silent for silent in (here, *(float(silent) for (silent,) in rows)) if silent is not None]
        return min(known, default=None)
