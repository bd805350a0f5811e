"""A robot of a fleet on several machines: it fetches requests, lets its own client answer them, and brings the replies.

The client is part of fcslam as it is installed on the robot. A server can send weights and settings, and no program.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar
from urllib.parse import quote

import httpx

from fcslam.errors import InputError, UnavailableError
from fcslam.learning.federated.client import Client, reply_to
from fcslam.learning.federated.fleet_server import ANSWER_S, NUMBER_HEADER, RETRY_S
from fcslam.learning.federated.messages import TrainingReply, printable_line, read_request, write_reply
from fcslam.wire.http_transport import HttpClient
from fcslam.wire.keys import NO_CREDENTIALS, Credentials

_T = TypeVar("_T")


class RobotLink(HttpClient):
    """The connection of a robot with the service that it learns at.

    ``url`` and ``shown`` are as in ``HttpClient``; ``robot`` is its name.
    """

    def __init__(self, url: str, robot: str, shown: Credentials = NO_CREDENTIALS) -> None:
        super().__init__(url, shown)
        self.robot = robot
        self._path = f"robots/{quote(robot, safe='')}/learning/"
        self._client.timeout = httpx.Timeout(ANSWER_S)

    def fetch(self) -> tuple[int, bytes] | None:
        """A request with its number; None if no request waits.

        Raises:
            CloudError: the server does not accept the robot, or is not a server of a fleet.
            UnavailableError: the server cannot be reached.
        """
        response = self._ask("POST", self._path + "next", passes=(204,))
        if response.status_code == httpx.codes.NO_CONTENT:
            return None
        with self._reading():
            return int(response.headers[NUMBER_HEADER]), response.content

    def reply(self, number: int, body: bytes) -> str:
        """Bring a reply; returns the reason why the server does not want it, or nothing.

        Raises:
            CloudError, UnavailableError: as in ``fetch``.
        """
        response = self._ask("POST", f"{self._path}reply/{number}", body, passes=(204, 410, 413))
        return response.content.decode(errors="replace")


def serve_requests(
    link: RobotLink,
    client: Client,
    on_notice: Callable[[str], None],
    sleep: Callable[[float], None] = time.sleep,
    is_ready: Callable[[], bool] = lambda: True,
) -> None:
    """Answer the server's requests until the robot is interrupted. Waits for a server that is not there, or gone.

    ``on_notice`` is called with one line for a request that was refused, and while the server is not there.
    ``is_ready`` is asked before each request; if false, the robot asks for none now.

    Raises:
        CloudError: the server does not accept the robot.
    """

    def retried(operation: Callable[[], _T]) -> _T:
        while True:
            try:
                return operation()
            except UnavailableError as error:
                on_notice(f"waiting: {error}")
                sleep(max(RETRY_S, error.retry_after_s))

    while True:
        if not is_ready():
            sleep(RETRY_S)
            continue
        found = retried(link.fetch)
        if found is None:
            continue
        number, data = found
        try:
            reply = reply_to(read_request(data), link.robot, client)
        except InputError as error:
            reply = TrainingReply(link.robot, "", error=str(error))
        if reply.error:
            on_notice(f"refused: {printable_line(reply.error)}")
        reason = retried(partial(link.reply, number, write_reply(reply)))
        if reason:
            on_notice(f"the server does not take a reply: {reason}")
