"""State shared by all routes of the HTTP service."""

import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from fastapi import Depends, HTTPException, Request, Security
from fastapi.params import Depends as Dependency
from fastapi.security import HTTPBearer
from starlette.datastructures import Headers
from starlette.types import Scope

from fcslam.service.audit_log import AuditLog
from fcslam.service.authentication import Authenticator, Identity, Role
from fcslam.service.http.limits import WHO
from fcslam.service.http.prometheus import ServiceMetrics
from fcslam.service.missions import Missions, OpenMission
from fcslam.service.viewed_mission import ViewedMission

if TYPE_CHECKING:
    from fcslam.service.shared.missions import SharedMissions

ANYBODY = "anybody"
"""The author of what is done without authentication."""
ACTOR = "actor"
"""Key of the client in the state of a request that only administrators may make."""
_BEARER = HTTPBearer(auto_error=False, scheme_name="token", description="of tokens.yaml")


class EventStream:
    """The newest event of each kind, for each mission. Any thread may call."""

    def __init__(self, current: Callable[[], str] = str, beat_s: float = 5.0) -> None:
        """``current``: name of the mission that the present request is about, if there are several; ``beat_s``: a
        stream says something at least so often, so that a client notices a dead connection.
        """
        self._current, self.beat_s = current, beat_s
        self._newest: dict[str, dict[str, tuple[int, int]]] = {}
        self._counter = itertools.count()
        self._lock = threading.Lock()

    def publish(self, kind: str, number: int, mission: str = "") -> None:
        """Tell all who watch a mission."""
        with self._lock:
            self._newest[mission] = {**self._newest.get(mission, {}), kind: (next(self._counter), number)}

    def newest(self) -> dict[str, tuple[int, int]]:
        """By kind, which of all events the newest one of the current mission is, and its number."""
        return self._newest.get(self._current(), {})


class ViewerState(Protocol):
    """Passed to the routers of viewers: by the service, or for a run that nobody can change."""

    @property
    def mission(self) -> ViewedMission:
        """The mission that viewers see."""

    @property
    def events(self) -> EventStream:
        """Changes of it."""

    @property
    def read_only(self) -> bool:
        """Whether nobody can change the mission here, whoever asks."""

    @property
    def learning(self) -> Path | None:
        """Output folder of the federated training that viewers see; None without one."""

    def require(self, *roles: Role) -> list[Dependency]:
        """Dependencies of a route that only these roles may ask."""

    def admits(self, request: Request, *roles: Role) -> bool:
        """Whether a long answer may go on: the service is not stopping, and who asked still has one of the roles."""


@dataclass(slots=True)
class ServiceState:
    """Passed to every router."""

    missions: "Missions | SharedMissions"
    authenticator: Authenticator
    events: EventStream
    audit: AuditLog
    learning: Path | None = None
    """Output folder of a federated training, for viewers."""
    measures: ServiceMetrics = field(default_factory=ServiceMetrics)
    closing: bool = False
    """Whether the service is stopping and takes no new requests."""
    changing: threading.Lock = field(default_factory=threading.Lock)
    """Held while missions are created, opened or imported."""

    def close(self) -> None:
        """Take no new requests, and end the streams of events."""
        self.closing = True

    @property
    def read_only(self) -> bool:
        """Administrators change the mission."""
        return False

    @property
    def mission(self) -> OpenMission:
        """The open mission."""
        return self.missions.open_mission

    def require(self, *roles: Role) -> list[Dependency]:
        """Dependencies of a route: whoever asks has one of the roles, and a robot that of itself alone.

        Refuses (HTTPException): 401 without a token that is known, 403 with another one's.
        """

        async def check(request: Request) -> None:
            if self.closing:
                raise HTTPException(503, "the service is stopping; try again")
            who: Identity | None = request.scope.get("state", {}).get(WHO)
            if who is None and not self.authenticator.is_open:
                headers = {"WWW-Authenticate": "Bearer"}
                raise HTTPException(
                    401, "no known token and no robot's certificate; send Authorization: Bearer TOKEN", headers
                )
            if set(roles) == {Role.ADMIN}:  # the handler and the audit log learn who asks
                setattr(request.state, ACTOR, ANYBODY if who is None else who.name)
            if who is not None and who.role not in roles:
                needed = " or ".join(roles)
                raise HTTPException(403, f"'{who.name}' is a {who.role}; this needs the role {needed}")
            robot = request.path_params.get("robot")
            if who is not None and who.role is Role.ROBOT and robot not in (None, who.name):
                raise HTTPException(403, f"robot '{who.name}' does not speak for robot '{robot}'")

        # the second one tells OpenAPI of tokens, and does nothing else
        return [Depends(check)] if self.authenticator.is_open else [Depends(check), Security(_BEARER)]

    def admits(self, request: Request, *roles: Role) -> bool:
        """As in ``ViewerState``."""
        if self.closing:
            return False
        who = self.who(request.scope)
        return self.authenticator.is_open or (who is not None and who.role in roles)

    def who(self, scope: Scope) -> Identity | None:
        """Whose token or certificate a request has; None if nobody's that is known."""
        tls = scope.get("extensions", {}).get("tls", {})
        return self.authenticator.who(Headers(scope=scope).get("authorization"), tls.get("client_cert_name"))
