"""A server of a fleet in this process, over TLS on loopback, with robots in threads."""

import contextlib
import socket
import threading
import time
from datetime import UTC, datetime

import numpy as np

from fcslam.learning.federated.coordinator import Coordinator, CoordinatorHooks
from fcslam.learning.federated.fleet_grid import FleetGrid
from fcslam.learning.federated.fleet_robot import RobotLink, serve_requests
from fcslam.learning.federated.fleet_server import FleetApp, listening
from fcslam.service.credentials import make_credentials
from fcslam.service.http.authentication import Authenticator, Role, read_tokens
from fcslam.wire.keys import Credentials
from tests.learning.federated.fakes import version

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
    """The certificates and tokens of a fleet, and a server for it."""

    def __init__(self, folder, robots):
        self._keys, self.robots, self.notices = folder / "keys", tuple(robots), []
        make_credentials(self._keys, ["127.0.0.1"], dict.fromkeys(robots, Role.ROBOT), datetime.now(UTC))
        self.ca = self._keys / "ca.pem"

    def token(self, robot):
        return (self._keys / "robots" / robot / "token").read_text().strip()

    @contextlib.contextmanager
    def server(self):
        """A grid that listens."""
        grid = FleetGrid()
        app = FleetApp(grid, Authenticator(read_tokens(self._keys / "tokens.yaml")), self.notices.append)
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.address = f"127.0.0.1:{listener.getsockname()[1]}"
            with listening(app, listener, (self._keys / "cloud.pem", self._keys / "cloud.key")):
                yield grid

    def link(self, robot, owner=None):
        """The link of a robot that shows the token of ``owner``."""
        return RobotLink(f"https://{self.address}", robot, Credentials(self.token(owner or robot), self.ca))

    def start(self, client):
        """Let a robot answer requests until the server ends."""

        def work():
            with contextlib.suppress(_EndedError), self.link(client.name) as link:
                serve_requests(link, client, self._end, _end)

        threading.Thread(target=work, daemon=True).start()

    def run(self, grid, folder, settings):
        """A whole run, with the reports of its rounds."""
        reports, ended = [], time.monotonic() + LIMIT_S

        def wait(reason):
            assert time.monotonic() < ended, reason
            time.sleep(0.1)

        hooks = CoordinatorHooks(version, lambda _: {"repeatability": 0.5, "mma_3px": 0.5}, reports.append, wait=wait)
        return Coordinator(grid, settings, WEIGHTS, folder, hooks).run(), reports

    def _end(self, notice):
        if notice.startswith("waiting: "):
            raise _EndedError
        self.notices.append(notice)


class _EndedError(Exception):
    pass


def _end(_seconds):
    raise _EndedError
