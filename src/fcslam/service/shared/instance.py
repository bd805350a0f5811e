"""One of several instances of the service: its name, its part of the workers, and what it sees of the others."""

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from fcslam.errors import InputError, StoreError
from fcslam.service.shared.mission_tables import Lease
from fcslam.service.shared.registry import KnownMission, Registry
from fcslam.service.supervisor import RunningWorker

LOOK_S: Final = 0.5
"""Between two renewals of the leases."""
GRACE_S: Final = 1.5
"""After the store was gone, the others get so long to renew leases that ended meanwhile."""

_log = logging.getLogger(__name__)


class Instance:
    """Holds leases and the workers that belong to them, on a thread of its own."""

    def __init__(
        self,
        registry: Registry,
        name: str,
        most_missions: int,
        launch: Callable[[KnownMission, Lease], RunningWorker],
        listen: Callable[[str, int, str], None],
        follow: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take the name, to run at most ``most_missions`` workers, which ``launch`` starts.

        ``listen`` receives an event, its number and the name of its mission, whoever has the mission's worker.
        ``follow`` is called at each step, to take over what other instances put into the store.
        """
        self._registry, self._name, self._most, self._clock = registry, name, most_missions, clock
        self._launch, self._listen, self._follow = launch, listen, follow
        self._closing = threading.Event()
        self._take_name()
        self._held: dict[Lease, RunningWorker] = {}
        self._ending: dict[Lease, threading.Thread] = {}
        """Workers that do their last step; nobody else may begin before."""
        self._claims_from = clock()
        self.known: Mapping[str, KnownMission] = {}
        """All missions by name, as they were a moment ago."""
        self._looking = threading.Lock()
        self.look()
        self._thread = threading.Thread(target=self._run, name=f"instance {name}", daemon=True)

    def start(self) -> None:
        """Begin to take missions."""
        self._thread.start()

    def close(self) -> None:
        """Stop all workers and give up their missions, for other instances to take."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join()
        for lease in list(self._held):
            self._end(lease)
        for thread in list(self._ending.values()):
            thread.join()
        try:
            self._registry.leave()
        except StoreError as error:
            _log.error("the name of this instance ends by itself: %s", error)

    def worker(self, number: int) -> RunningWorker | None:
        """The worker of a mission, if it is here."""
        return next((worker for lease, worker in list(self._held.items()) if lease.mission == number), None)

    def look(self) -> None:
        """See which missions there are now; requests look, too, and an earlier look replaces no later one."""
        with self._looking:
            before, self.known = self.known, {mission.name: mission for mission in self._registry.missions()}
            for name in before.keys() & self.known.keys():
                old, mission = before[name], self.known[name]
                if mission.live > old.live:
                    self._listen("live", mission.live, name)
                if mission.finalized > old.finalized:
                    self._listen("finalized", mission.finalized, name)

    def _take_name(self) -> None:
        for _ in range(round(2.0 * self._registry.lease_s / LOOK_S)):  # one that was killed loses it in this time
            if self._registry.register(self._most):
                return
            self._closing.wait(LOOK_S)
        raise InputError(f"another instance is called '{self._name}'; stop it, or give this one another --port")

    def _run(self) -> None:
        is_gone = False
        while not self._closing.wait(LOOK_S):
            try:
                self.step()
                is_gone = False
            except StoreError as error:
                if not is_gone:
                    _log.error("the store does not answer; this instance waits for it: %s", error)
                is_gone = True
                self._claims_from = self._clock() + GRACE_S
            except Exception:
                _log.exception("the instance failed at a look, and goes on")

    def step(self) -> None:
        """Renew the name and the leases, and take or give up missions."""
        if not self._registry.register(self._most):
            _log.error("another instance took the name '%s'; this one stops", self._name)
            os.kill(os.getpid(), signal.SIGTERM)
            self._closing.set()
            return
        ending = [(lease, False) for lease in list(self._ending)]
        kept = self._registry.renew([(lease, worker.is_ready) for lease, worker in self._held.items()] + ending)
        for lease in self._held.keys() - kept:
            _log.warning("mission %d has a worker on another instance now", lease.mission)
            threading.Thread(target=self._held.pop(lease).stop, daemon=True).start()
        self._registry.let_rest()
        self.look()
        resting = {mission.number for mission in self.known.values() if not mission.is_wanted}
        for lease in [lease for lease in self._held if lease.mission in resting]:
            self._end(lease)
        self._spread()
        self._follow()  # last: what it cannot take over stops nothing else

    def _spread(self) -> None:
        """Take missions without a worker, or give one up, until each instance has its part."""
        wanted = [mission for mission in self.known.values() if mission.is_wanted]
        free = [mission for mission in wanted if not mission.is_held]
        rooms = self._registry.rooms()
        surplus = len(self._held) - fair_part(len(wanted), rooms, self._most)
        if surplus == 0 and sum(rooms) < len(wanted) and any(mission.is_open for mission in free):
            free, surplus = [], 1  # robots send to the open mission, so another one makes room
        if free and self._clock() >= self._claims_from and surplus < 0:
            for lease in self._registry.claim(-surplus):
                mission = next(mission for mission in self._registry.missions() if mission.number == lease.mission)
                self._held[lease] = self._launch(mission, lease)
        elif not free and not self._ending and self._held and surplus > 0:
            self._end(next(reversed(self._held)))

    def _end(self, lease: Lease) -> None:
        """Stop a worker and give its mission up, beside the renewals: a worker's last step may take long."""
        worker = self._held.pop(lease)
        self._ending[lease] = threading.Thread(target=self._stop, args=(lease, worker), daemon=True)
        self._ending[lease].start()

    def _stop(self, lease: Lease, worker: RunningWorker) -> None:
        worker.stop()
        self._ending.pop(lease, None)
        try:
            self._registry.release(lease)
        except StoreError as error:
            _log.error("the lease of mission %d ends by itself: %s", lease.mission, error)


def fair_part(wanted: int, rooms: Sequence[int], own: int) -> int:
    """How many of the ``wanted`` missions an instance with room for ``own`` shall have.

    All instances get the same number, but none more than it has room for.
    """
    part = 0
    while part < own and sum(min(room, part) for room in rooms) < wanted:
        part += 1
    return part
