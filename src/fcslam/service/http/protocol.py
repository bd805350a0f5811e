"""The connections of the service: how many there may be, how long they may be idle, and whose certificate they show."""

import asyncio
import gc
import resource
import socket
import ssl
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from types import FrameType
from typing import Any, ClassVar

import uvicorn
from cryptography import x509
from uvicorn.protocols.http.h11_impl import H11Protocol

from fcslam.service.http.limits import CONNECTION, WAITING, WHO
from fcslam.service.intake import TokenBuckets

MOST_CONNECTIONS = 4096
"""Connections at a time."""
WRITE_S = 20.0
"""Time for a client to read what fills the buffers of its connection, 64 KiB and those of the system."""
IDLE_S = 10.0
"""Time for a TLS handshake, and for the header of a request, from the connection or the response before."""
PAUSE_S = 0.001
"""Pause after each connection that is accepted, and after a failure to accept one."""
_LOOK_EVERY_S = 2.0


def allow_many_connections() -> None:
    """Raise this process's limit of open files: connections whose TLS handshake is not done need some, too."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = 4 * MOST_CONNECTIONS if hard == resource.RLIM_INFINITY else min(4 * MOST_CONNECTIONS, hard)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


@cache
def most_connections() -> int:
    """Connections at a time: some files are left for missions and handshakes."""
    return min(MOST_CONNECTIONS, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)


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
        sys.setswitchinterval(0.0005)  # threads that store packets wait for this one at every statement
        gc.freeze()
        gc.set_threshold(2000, 10, 500)  # to look through the objects of thousands of connections takes 0.3 s
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
    holds connections would lock everybody else out.
    """

    _read: ClassVar = TokenBuckets(time.monotonic, 16.0 * 2**20, 4.0 * 2**20)
    """Bytes that are read of one token, or of all connections without one."""
    _stuck_since: float | None = None
    """When the client stopped to read what is sent; None: it reads."""
    _idle_since = 0.0
    """Time of the loop when the connection was made, or the newest response was complete."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """After the handshake: a client certificate, if there is one, was signed by the trusted authority."""
        super().connection_made(transport)
        self._idle_since = self.loop.time()
        self.loop.call_later(_LOOK_EVERY_S, self._enforce_timeouts)
        if len(self.connections) > most_connections():
            self._make_room()
        self._pass_connection(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """The client or a limit closed the connection."""
        turn = self._state.get(WAITING)
        if turn is not None and not turn.done():
            turn.set_result(False)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take a part of a request; if its sender has sent more than others may, its next parts wait in the network."""
        super().data_received(data)
        if self.cycle is not None and WHO not in self._state:  # nobody asks for tokens, or not yet
            return
        name = getattr(self._state.get(WHO), "name", "")
        wait_s = self._read.wait_s(name, len(data) + 2**14)  # each part takes time, also a small one
        if wait_s > 0.0 and not self.transport.is_closing():
            self.transport.pause_reading()
            self.loop.call_later(wait_s, self._read_on)

    def _read_on(self) -> None:
        if not self.flow.read_paused:
            self.transport.resume_reading()

    def on_response_complete(self) -> None:
        """A client that asks again and again keeps its connection: for a new one it would wait behind others."""
        self._idle_since = self.loop.time()
        super().on_response_complete()

    def close(self) -> None:
        """Close the connection, whatever is on its way."""
        self.transport.abort()

    @property
    def is_idle(self) -> bool:
        """Whether no request is in progress."""
        return self.cycle is None or self.cycle.response_complete

    @property
    def is_unfinished(self) -> bool:
        """Whether a request is in progress whose body has not come."""
        return not self.is_idle and self.cycle.more_body

    @property
    def may_be_closed(self) -> bool:
        """Whether nobody works on a request of the connection."""
        return self.is_idle or self.cycle.more_body or WAITING in self._state

    @property
    def holder(self) -> str:
        """Name of the token of the newest request, or the address."""
        who = self._state.get(WHO)
        return who.name if who is not None else self.client[0] if self.client else ""

    @property
    def _state(self) -> dict[str, Any]:
        return {} if self.cycle is None else self.cycle.scope["state"]

    def pause_writing(self) -> None:
        """The client reads slower than the service sends."""
        self._stuck_since = self.loop.time()
        super().pause_writing()

    def resume_writing(self) -> None:
        """The client has read."""
        self._stuck_since = None
        super().resume_writing()

    def _enforce_timeouts(self) -> None:
        """Close the connection if it has been idle, or its client has read nothing, for too long."""
        now = self.loop.time()
        if not self.is_idle:
            self._idle_since = now
        if now - self._idle_since > IDLE_S or (self._stuck_since is not None and now - self._stuck_since > WRITE_S):
            self.close()
        elif not self.transport.is_closing():
            self.loop.call_later(_LOOK_EVERY_S, self._enforce_timeouts)

    def _make_room(self) -> None:
        """Close some connections of the holder that has most: those whose body has not come, then the oldest.

        To find them takes a while, so one is not enough; all requests wait while many are closed. Without any that may
        be closed, it is this one.
        """
        held: defaultdict[str, list[GuardedProtocol]] = defaultdict(list)
        for each in self.connections:
            if isinstance(each, GuardedProtocol) and each.may_be_closed and each is not self:
                held[each.holder].append(each)
        most = max(held.values(), key=len, default=[self])
        most.sort(key=lambda each: (not each.is_unfinished, each._idle_since))
        for each in most[: 1 + len(most) // 100]:
            each.close()

    def _pass_connection(self, transport: asyncio.Transport) -> None:
        """Pass the connection to the limits of requests.

        Pass the certificate to the application by ASGI's TLS extension; of its entries only ``client_cert_name``:
        https://asgi.readthedocs.io/en/latest/specs/tls.html
        """
        tls: ssl.SSLObject | None = transport.get_extra_info("ssl_object")
        shown = None if tls is None else tls.getpeercert(binary_form=True)
        name = None if shown is None else x509.load_der_x509_certificate(shown).subject.rfc4514_string()
        app = self.app

        async def with_connection(scope: Any, receive: Any, send: Any) -> None:
            scope["state"][CONNECTION] = self
            if name is not None:
                scope["extensions"] = {**scope.get("extensions", {}), "tls": {"client_cert_name": name}}
            await app(scope, receive, send)

        self.app = with_connection
