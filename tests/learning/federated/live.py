"""The process of a fleet that learns, as a server in this process on loopback, with robots in threads."""

import contextlib
import socket
import threading

from fcslam.learning.federated.fleet_grid import FleetGrid
from fcslam.learning.federated.fleet_server import listening
from fcslam.learning.federated.robot_learning import RobotLink, serve_requests
from fcslam.wire.keys import Server


class _EndedError(Exception):
    pass


def _end(_seconds):
    raise _EndedError


class LiveFleet:
    """A server, while it runs as a context."""

    def __init__(self):
        self.grid, self.notices = FleetGrid(), []

    @contextlib.contextmanager
    def running(self):
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.address = f"http://127.0.0.1:{listener.getsockname()[1]}"
            with listening(self.grid, listener):
                yield self

    def link(self, robot):
        return contextlib.closing(RobotLink(Server(self.address), robot))

    def start(self, client):
        """Let a robot answer requests until the server ends."""

        def work():
            with contextlib.suppress(_EndedError), self.link(client.name) as link:
                serve_requests(link, client, self.notices.append, _end)

        threading.Thread(target=work, daemon=True).start()
