"""The connections of the service: how many there may be, how long they may be idle, and whose certificate they show."""

import asyncio
import resource
import socket
import ssl
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from types import FrameType
from typing import Any

import uvicorn
from cryptography import x509
from uvicorn.protocols.http.h11_impl import H11Protocol

from fcslam.service.http.middleware import MOST_WAITING, WAITING

WRITE_S = 20.0
"""Time for a client to read what fills the buffers of its connection, 64 KiB and those of the system."""
REFUSAL_S = 5.0
"""Time until what is no HTTP is answered."""
IDLE_S = 10.0
"""Time for a TLS handshake, and for the header of a request, from the connection or the response before."""
BODY_S = 60.0
"""Time for a request with its body, beside that of its bytes."""
LEAST_BYTES_PER_S = 20_000
"""A slower body is cut: a mission that is imported may take long, a client that sends a byte now and then may not."""
PAUSE_S = 0.001
"""Pause after each connection that is accepted, and after a failure to accept one."""
_LOOK_EVERY_S = 2.0


def allow_many_connections() -> None:
    """Raise this process's limit of open files: connections whose TLS handshake is not done need some, too."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = 4 * MOST_WAITING if hard == resource.RLIM_INFINITY else min(4 * MOST_WAITING, hard)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


@cache
def most_connections() -> int:
    """Connections without a request in progress at a time: some files are left for missions and handshakes.

    Of more, one of the address that has most is closed.
    """
    return min(MOST_WAITING, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)


_Factory = Callable[[], asyncio.Protocol]


class GuardedServer(uvicorn.Server):
    """uvicorn's server with limits for new connections and for TLS handshakes, which come before a protocol.

    ``on_exit`` is called when it is asked to stop, before it waits for the answers in progress.
    """

    def __init__(
        self, config: uvicorn.Config, on_exit: Callable[[], None] = lambda: None, handshake_s: float = IDLE_S
    ) -> None:
        super().__init__(config)
        self._on_exit, self._handshake_s = on_exit, handshake_s

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """A signal asks to stop."""
        self._on_exit()
        super().handle_exit(sig, frame)

    def run(self, sockets: list[socket.socket] | None = None) -> None:
        """Serve until the server is stopped."""
        with asyncio.Runner(loop_factory=self._loop) as runner:
            runner.run(self.serve(sockets=sockets))

    def _loop(self) -> asyncio.AbstractEventLoop:
        loop = (self.config.get_loop_factory() or asyncio.new_event_loop)()

        async def listen(factory: _Factory, *, sock: socket.socket, ssl: ssl.SSLContext | None, backlog: int) -> object:
            sock.listen(backlog)
            return _Listener(factory, sock, ssl, self._handshake_s)

        loop.create_server = listen  # type: ignore[method-assign, assignment]
        return loop


class _Listener:
    """Accepts connections one by one: asyncio accepts all that wait at once, and requests in progress wait."""

    def __init__(
        self, factory: _Factory, listening: socket.socket, tls: ssl.SSLContext | None, handshake_s: float
    ) -> None:
        self._factory, self._listening, self._tls = factory, listening, tls
        self._timeout_s = None if tls is None else handshake_s
        self._handshakes: dict[asyncio.Task[None], None] = {}
        listening.setblocking(False)
        self._accepting = asyncio.get_running_loop().create_task(self._accept())

    def close(self) -> None:
        """Accept no more."""
        self._accepting.cancel()

    async def wait_closed(self) -> None:
        """Wait for the handshakes in progress."""
        await asyncio.wait([self._accepting, *self._handshakes])

    async def _accept(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(PAUSE_S)
            try:
                connection, _ = await loop.sock_accept(self._listening)
            except OSError:  # no file is left: wait until a connection is closed
                continue
            handshake = loop.create_task(self._connect(connection))
            self._handshakes[handshake] = None
            handshake.add_done_callback(lambda task: self._handshakes.pop(task, None))
            if len(self._handshakes) > most_connections():
                next(iter(self._handshakes)).cancel()

    async def _connect(self, connection: socket.socket) -> None:
        with suppress(OSError):  # the client is gone, or no client of ours
            await asyncio.get_running_loop().connect_accepted_socket(
                self._factory, connection, ssl=self._tls, ssl_handshake_timeout=self._timeout_s
            )


class GuardedProtocol(H11Protocol):
    """uvicorn's protocol, with limits for connections that ask nothing, and with the client's certificate.

    uvicorn has a timeout only between two requests, and where it limits connections it refuses new ones. So whoever
    holds idle connections would lock everybody else out.
    """

    _stuck_since: float | None = None
    """When the client stopped to read what is sent; None: it reads."""
    _idle_since = _asked_since = 0.0
    """Times of the loop: when the present request began, or when the connection was seen without one first."""
    _look: asyncio.TimerHandle | None = None
    _seen: object = None
    """The request at the last look."""
    _received = 0
    """Bytes that came in since the present request began."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """After the handshake: a client certificate, if there is one, was signed by the trusted authority."""
        super().connection_made(transport)
        self._idle_since = self._asked_since = self.loop.time()
        self._look = self.loop.call_later(_LOOK_EVERY_S, self._enforce_timeouts)
        if len(self.connections) > most_connections():
            self._make_room()
        self._pass_certificate(transport)

    def data_received(self, data: bytes) -> None:
        """The client sends."""
        self._received += len(data)
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """The client or a limit closed the connection."""
        if self._look is not None:
            self._look.cancel()
        super().connection_lost(exc)

    @property
    def is_idle(self) -> bool:
        """Whether no request is in progress."""
        return self.cycle is None or self.cycle.response_complete

    @property
    def may_be_closed(self) -> bool:
        """Whether the connection is idle, or its request waits among those without a known token."""
        return self.is_idle or WAITING in self.cycle.scope["state"]

    def pause_writing(self) -> None:
        """The client reads slower than the service sends."""
        self._stuck_since = self.loop.time()
        super().pause_writing()

    def resume_writing(self) -> None:
        """The client has read."""
        self._stuck_since = None
        super().resume_writing()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, but late, so that whoever sends it again and again waits."""
        self.transport.pause_reading()
        self.loop.call_later(REFUSAL_S, self._refuse, msg)

    def _refuse(self, msg: str) -> None:
        if not self.transport.is_closing():
            super().send_400_response(msg)

    def _enforce_timeouts(self) -> None:
        """Close the connection if it has been idle, or its request has been coming in, for too long."""
        now = self.loop.time()
        if self.cycle is not self._seen:
            self._seen, self._asked_since, self._received = self.cycle, now, 0
        if self.is_idle:
            self._asked_since = now
            is_late = now - self._idle_since > IDLE_S
        else:
            self._idle_since = now
            longest_s = BODY_S + self._received / LEAST_BYTES_PER_S
            is_late = self.cycle.more_body and now - self._asked_since > longest_s
        if is_late or (self._stuck_since is not None and now - self._stuck_since > WRITE_S):
            self.transport.abort()
        else:
            self._look = self.loop.call_later(_LOOK_EVERY_S, self._enforce_timeouts)

    def _make_room(self) -> None:
        """Close the longest idle connection of the address that has most of them; without any, this one."""
        idle = [each for each in self.connections if isinstance(each, GuardedProtocol) and each.may_be_closed]
        held = Counter(_address(each) for each in idle if each is not self)
        if held:
            ((address, _),) = held.most_common(1)
            oldest = min((e for e in idle if e is not self and _address(e) == address), key=lambda e: e._idle_since)
            oldest.transport.abort()
        else:
            self.transport.abort()

    def _pass_certificate(self, transport: asyncio.Transport) -> None:
        """Pass the certificate to the application by ASGI's TLS extension; of its entries only ``client_cert_name``.

        https://asgi.readthedocs.io/en/latest/specs/tls.html
        """
        tls: ssl.SSLObject | None = transport.get_extra_info("ssl_object")
        shown = None if tls is None else tls.getpeercert(binary_form=True)
        if shown is None:
            return
        name, app = x509.load_der_x509_certificate(shown).subject.rfc4514_string(), self.app

        async def with_certificate(scope: Any, receive: Any, send: Any) -> None:
            scope["extensions"] = {**scope.get("extensions", {}), "tls": {"client_cert_name": name}}
            await app(scope, receive, send)

        self.app = with_certificate


def _address(protocol: H11Protocol) -> str:
    return protocol.client[0] if protocol.client else ""
