"""A robot of a fleet on several machines: it fetches requests, lets its own client answer them, and brings the replies.

The client is part of fcslam as it is installed on the robot. A server can send weights and settings, and no program.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final, TypeVar
from urllib.parse import quote

import httpx

from fcslam.errors import InputError, UnavailableError
from fcslam.learning.federated.client import FederatedClient, answer
from fcslam.learning.federated.fleet_server import LONG_POLL_S, NUMBER_HEADER
from fcslam.learning.federated.messages import TrainingReply, printable_line, read_request, write_reply
from fcslam.wire.http_transport import HttpClient
from fcslam.wire.keys import NO_CREDENTIALS, Credentials

ALIVE_S: Final = 15.0
"""Time between two signs of life; a quarter of that after which a robot counts as gone."""
ANSWER_S: Final = 60.0
RETRY_S: Final = 3.0
"""Time between two attempts to reach the server."""
IDLE_S: Final = 1.0
"""Time after which a robot that was not ready asks again."""
MAX_REQUEST_BYTES: Final = 256 * 2**20
"""A larger request of the server is not read: weights take a few megabytes."""

_T = TypeVar("_T")


class RobotLink(HttpClient):
    """The connection of a robot with the service that it learns at.

    ``url`` and ``shown`` are as in ``HttpClient``; ``robot`` is its name.
    """

    def __init__(self, url: str, robot: str, shown: Credentials = NO_CREDENTIALS) -> None:
        super().__init__(url, shown)
        self._path = f"robots/{quote(robot, safe='')}/learning/"
        self._client.timeout = httpx.Timeout(ANSWER_S, read=LONG_POLL_S + ANSWER_S)

    def __enter__(self) -> "RobotLink":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fetch(self) -> tuple[int, bytes] | None:
        """A request with its number; None if no request waits.

        Raises:
            InputError: the server does not accept the robot.
            ConnectionError: the server cannot be reached, or is not a server of a fleet.
        """
        status, headers, body = self._post("next")
        if status == httpx.codes.NO_CONTENT:
            return None
        number = headers.get(NUMBER_HEADER, "")
        if status != httpx.codes.OK or not number.isdecimal():
            raise ConnectionError(f"the server answers with status {status}")
        return int(number), body

    def reply(self, number: int, body: bytes) -> str | None:
        """Bring a reply; returns the reason why the server does not want it, or None.

        Raises:
            InputError, ConnectionError: as in ``fetch``.
        """
        status, _, answer = self._post(f"reply/{number}", body)
        return None if status == httpx.codes.NO_CONTENT else answer.decode(errors="replace") or f"status {status}"

    def show_alive(self) -> None:
        """Show the server that the robot is still there.

        Raises:
            InputError, ConnectionError: as in ``fetch``.
        """
        self._post("alive")

    def _post(self, operation: str, body: bytes = b"") -> tuple[int, httpx.Headers, bytes]:
        content = bytearray()
        try:
            with self._explained(), self._client.stream("POST", self._path + operation, content=body) as response:
                for part in response.iter_bytes():
                    content += part
                    if len(content) > MAX_REQUEST_BYTES:
                        raise ConnectionError(f"the server sends more than {MAX_REQUEST_BYTES} bytes")
        except UnavailableError as error:
            raise ConnectionError(str(error)) from error
        if response.status_code in (httpx.codes.UNAUTHORIZED, httpx.codes.FORBIDDEN):
            raise InputError(f"the server does not accept this robot: {content.decode(errors='replace')}")
        return response.status_code, response.headers, bytes(content)


def serve_requests(
    link: RobotLink,
    client: FederatedClient,
    on_notice: Callable[[str], None],
    sleep: Callable[[float], None] = time.sleep,
    is_ready: Callable[[], bool] = lambda: True,
) -> None:
    """Answer the server's requests until the robot is interrupted. Waits for a server that is not there, or gone.

    ``on_notice`` is called with one line for a request that was refused, and while the server is not there.
    ``is_ready`` is asked before each request; if false, the robot asks for none now.

    Raises:
        InputError: the server does not accept the robot.
    """

    def fetch() -> tuple[int, bytes] | None:
        if is_ready():
            return link.fetch()
        sleep(IDLE_S)
        return None

    while True:
        found = _retried(fetch, on_notice, sleep)
        if found is None:
            continue
        number, data = found
        with _signs_of_life(link):
            reply = _answer(client, data)
        if reply.error:
            on_notice(f"refused: {printable_line(reply.error)}")
        reason = _retried(partial(link.reply, number, write_reply(reply)), on_notice, sleep)
        if reason is not None:
            on_notice(f"the server does not take a reply: {reason}")


def _answer(client: FederatedClient, data: bytes) -> TrainingReply:
    try:
        return answer(client, read_request(data))
    except InputError as error:
        return TrainingReply(client.name, "", error=str(error))


def _retried(operation: Callable[[], _T], on_notice: Callable[[str], None], sleep: Callable[[float], None]) -> _T:
    while True:
        try:
            return operation()
        except ConnectionError as error:
            on_notice(f"waiting: {error}")
            sleep(RETRY_S)


@contextlib.contextmanager
def _signs_of_life(link: RobotLink) -> Iterator[None]:
    """Show the server from a thread that the robot is there, because work on a request takes long."""
    ended = threading.Event()

    def show() -> None:
        while not ended.wait(ALIVE_S):
            with contextlib.suppress(ConnectionError, InputError):
                link.show_alive()

    thread = threading.Thread(target=show, name="signs of life", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
