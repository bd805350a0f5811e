"""A server of a fleet in this process, over TLS on loopback, with robots in threads."""

import contextlib
import socket
import threading
import time

import numpy as np

from fcslam.federated.client_app import build_client_app
from fcslam.federated.coordinator import Coordinator, CoordinatorHooks
from fcslam.federated.fleet_grid import FleetGrid
from fcslam.federated.fleet_robot import RobotLink, robot_context, serve_requests
from fcslam.federated.fleet_server import FleetApp, listening
from fcslam.federated.identity import RobotAuthenticator, RobotIdentity, read_private_key, read_robot_keys
from fcslam.federated.tls import Address, Certificates
from tests.federated.authority import certificates, keys
from tests.federated.fakes import version

LIMIT_S = 120.0
"""For a run."""
_RNG = np.random.default_rng(4)
_COMMON = _RNG.normal(size=(80, 80))
"""The direction in which all robots' images pull."""
WEIGHTS = {
    "a.weight": _RNG.normal(size=(80, 80)).astype(np.float32),
    "a.running_mean": _RNG.normal(size=64).astype(np.float32),
    "a.running_var": _RNG.uniform(0.5, 2.0, 64).astype(np.float32),
}


def honest_update(seed):
    """Trains in the common direction and in one of its own, and has seen other light than the others."""

    def answer(weights, round_number):
        rng = np.random.default_rng([seed, round_number])
        step = 0.02 * (0.4 * _COMMON + 0.9 * rng.normal(size=_COMMON.shape))
        return {
            "a.weight": (weights["a.weight"] + step).astype(np.float32),
            "a.running_mean": (weights["a.running_mean"] + rng.normal(0.0, 0.2, 64)).astype(np.float32),
            "a.running_var": (weights["a.running_var"] * np.exp(rng.normal(0.0, 0.2, 64))).astype(np.float32),
        }

    return answer


class LiveFleet:
    """The keys of a fleet, and a server for it."""

    def __init__(self, folder, robots):
        self._keys = certificates(folder / "keys")
        keys(self._keys, *robots)
        self.robots, self.notices = tuple(robots), []
        self.ca = self._keys / "ca.crt"

    @contextlib.contextmanager
    def server(self):
        """A grid that listens."""
        public = read_robot_keys([self._keys / f"{robot}.pub" for robot in self.robots])
        grid = FleetGrid(self.robots)
        app = FleetApp(grid, RobotAuthenticator(public), self.notices.append)
        own = Certificates(self.ca, self._keys / "own.crt", self._keys / "own.key")
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.address = Address("127.0.0.1", listener.getsockname()[1])
            with listening(app, listener, own):
                yield grid

    def identity(self, robot, key=None):
        """The name that a robot claims, and the key with which it signs."""
        return RobotIdentity(robot, read_private_key(self._keys / (key or robot)))

    def link(self, robot, key=None):
        return RobotLink(self.address, self.identity(robot, key), self.ca)

    def start(self, client, app=None):
        """Let a robot answer requests until the server ends."""

        def work():
            with contextlib.suppress(_EndedError), self.link(client.name) as link:
                serve_requests(link, app or build_client_app(lambda _: client), robot_context(), self._end, _end)

        threading.Thread(target=work, daemon=True).start()

    def run(self, grid, folder, settings):
        """A whole run, with the reports of its rounds."""
        reports, ended = [], time.monotonic() + LIMIT_S

        def wait(reason):
            assert time.monotonic() < ended, reason
            time.sleep(0.1)

        hooks = CoordinatorHooks(
            version, lambda _: {"repeatability": 0.5, "mma_3px": 0.5}, lambda report, _: reports.append(report), wait
        )
        return Coordinator(grid, settings, WEIGHTS, folder, hooks).run(), reports

    def _end(self, notice):
        if notice.startswith("waiting: "):
            raise _EndedError
        self.notices.append(notice)


class _EndedError(Exception):
    pass


def _end(_seconds):
    raise _EndedError
