"""HTTP client of a robot: sends batches of packets and reads replies. It does not retry; its caller does."""

import ipaddress
import ssl
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, urlsplit

from fcslam.errors import CloudError, InputError, OversizeError, PacketError, UnavailableError
from fcslam.records import MOST_NETWORK_BYTES, Channel
from fcslam.wire.batches import (
    AGENT_HEADER,
    CORRECTION_HEADER,
    ENDED_HEADER,
    MEDIA_TYPE,
    REFUSED_HEADER,
    REMOVED_HEADER,
    read_batch,
    write_batch,
)
from fcslam.wire.keys import Server, no_passphrase

if TYPE_CHECKING:
    import httpx

CONNECT_TIMEOUT_S, ANSWER_TIMEOUT_S = 5.0, 30.0

_LATER = frozenset({408, 425, 429, 500, 502, 503, 504, 507})
"""Status codes of a cloud, or a proxy before it, after which a retry may succeed."""


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """Reply of the cloud to a batch."""

    packets: tuple[bytes, ...] = ()
    """Encoded packets from the cloud."""
    refusal: tuple[int, str] | None = None
    """Index and reason of a packet that is refused for good; only those before it are stored. It keeps its number."""
    refused: int = 0
    """Number of the robot's refused packets so far; some were refused after they were stored."""
    removed: bool = False
    """Whether the robot's session is removed: its packets are stored and have no effect."""


@dataclass(frozen=True, slots=True)
class CloudState:
    """The packets that the cloud has of a robot."""

    expected: Mapping[int, int]
    """Next expected sequence number, by epoch."""
    refused: Mapping[tuple[int, int], str] = field(default_factory=dict)
    """Reason of each of the last refused packets, by epoch and sequence."""
    refusals: int = 0
    """Number of refused packets."""


class HttpClient:
    """Connection to one cloud; where one of its instances does not answer, the next request asks the next one."""

    received_bytes = 0
    """Bytes of the replies' bodies so far."""
    most_reply_bytes = 4 * MOST_NETWORK_BYTES
    """A longer reply is not read: a map of 16,000 by 16,000 cells has as many bytes."""

    def __init__(self, server: Server, headers: Mapping[str, str] | None = None) -> None:
        """Open a client of a cloud; requests have the headers."""
        try:
            import httpx
        except ModuleNotFoundError as error:
            raise InputError("a server needs httpx; install it: pip install 'fcslam[service]'") from error

        self._urls = deque(address.rstrip("/") for address in addresses(server.url))
        for address in self._urls:
            _check_url(address, server)
        self._has_own, self._was_accepted = server.certificate is not None, False
        self._client = httpx.Client(
            base_url=f"{self._url}/api/v1/",
            headers=dict(headers or {}) | ({"Authorization": f"Bearer {server.token}"} if server.token else {}),
            timeout=httpx.Timeout(ANSWER_TIMEOUT_S, connect=CONNECT_TIMEOUT_S),
            verify=_trust(server),
            trust_env=False,
        )

    @property
    def _url(self) -> str:
        return self._urls[0]

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Read a reply in this block; a CloudError says that it is not what an fcslam cloud sends."""
        try:
            yield
        except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
            raise CloudError(f"{self._url}: the reply does not come from an fcslam cloud; check the address") from error

    def _ask(
        self,
        method: str,
        path: str,
        content: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        passes: Collection[int] = (),
    ) -> "httpx.Response":
        """The response, if its status is 200 or one of ``passes``; raises as ``HttpTransport.state``."""
        import httpx

        with self._trying():
            with self._explained(), self._client.stream(method, path, content=content, headers=headers) as reply:
                body, headers = bytearray(), {k: v for k, v in reply.headers.items() if k != "content-encoding"}
                for part in reply.iter_bytes():
                    body += part
                    if len(body) > self.most_reply_bytes:
                        raise CloudError(f"{self._url}: a reply of over {self.most_reply_bytes} bytes; is it a cloud?")
            self.received_bytes += len(body)
            return self._checked(httpx.Response(reply.status_code, headers=headers, content=bytes(body)), passes)

    @contextmanager
    def _trying(self) -> Iterator[None]:
        """Where this address cannot be used now, ask the next one from now on."""
        try:
            yield
        except UnavailableError:
            self.try_next()
            raise

    def try_next(self) -> None:
        """Ask the next address of the cloud from now on."""
        self._urls.rotate(-1)
        self._client.base_url = f"{self._url}/api/v1/"

    def _checked(self, response: "httpx.Response", passes: Collection[int]) -> "httpx.Response":
        code = response.status_code
        if code == 200 or code in passes:
            self._was_accepted = True
            return response
        after = response.headers.get("Retry-After", "")
        wait_s = float(after) if after.isascii() and after.isdigit() else 0.0
        is_other_agent = code == 409 and "index" not in _detail(response)  # another agent may stop soon
        are_tokens_changing = code == 401 and self._was_accepted  # the token was good before, and may be again
        if code in _LATER or is_other_agent or are_tokens_changing:
            raise UnavailableError(self._reason(response), wait_s)
        raise (OversizeError if code == 413 else CloudError)(self._reason(response))

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn the client's errors into those of ``HttpTransport.state``."""
        import httpx

        try:
            yield
        except httpx.RequestError as error:
            if isinstance(error.__cause__, ssl.SSLCertVerificationError) or "CERTIFICATE_VERIFY_FAILED" in str(error):
                advice = "give its ca.pem in --credentials"
                if "is not valid for" in str(error):
                    advice = "ask the cloud by a name of its certificate, or add this one (fcslam tools certificates)"
                elif "expired" in str(error) or "not yet valid" in str(error):
                    advice = "renew it (fcslam tools certificates), or correct the clock here"
                raise CloudError(f"{self._url}: its certificate is not trusted ({error}); {advice}") from error
            reason = str(error).removesuffix(".") or type(error).__name__
            raise UnavailableError(f"{self._url}: {reason}{self._hint(error)}") from error

    def _hint(self, error: "httpx.RequestError") -> str:
        """What may be wrong if a connection that was opened fails."""
        import httpx

        if "WRONG_VERSION_NUMBER" in str(error):
            return "; the cloud does not use TLS: its address begins with http://"
        if not isinstance(error, httpx.NetworkError | httpx.RemoteProtocolError):
            return ""
        if self._url.startswith("http:") and not isinstance(error, httpx.ConnectError):
            return "; if that stays, the cloud may use TLS: then its address begins with https://"
        # A cloud that rejects a certificate closes the connection; with TLS 1.3 the reason may not arrive here.
        return "; if that stays, it does not trust this robot's certificate" if self._has_own else ""

    def _reason(self, response: "httpx.Response") -> str:
        said = _detail(response).get("error") or response.reason_phrase
        remedy = {401: "; give a valid token in --credentials", 404: "; no such thing on this server: is it fcslam's?"}
        return f"{self._url}: {said} ({response.status_code}){remedy.get(response.status_code, '')}"


class HttpTransport(HttpClient):
    """Connection of one robot to its cloud; docs/howto/robot.md lists how it handles status codes."""

    def __init__(self, server: Server, robot: str, agent: str) -> None:
        """Open a client; raises as ``HttpClient``. ``agent``: random, to distinguish two processes of one robot."""
        super().__init__(server, {AGENT_HEADER: agent, "Content-Type": MEDIA_TYPE})
        self._robot = quote(robot, safe="")

    def state(self) -> CloudState:
        """Ask the cloud which packets of this robot it has.

        Raises:
            UnavailableError: the cloud cannot be reached now, or is busy.
            CloudError: the cloud rejects this robot.
        """
        response = self._ask("GET", f"robots/{self._robot}/state")
        with self._reading():
            state = response.json()
            expected = {int(epoch): int(sequence) for epoch, sequence in state["next"].items()}
            refused = {(int(one["epoch"]), int(one["sequence"])): str(one["reason"]) for one in state["refused"]}
            return CloudState(expected, refused, int(state.get("refusals", len(refused))))

    def send(self, packets: Sequence[bytes], correction: int) -> HttpResponse:
        """Send a batch of encoded packets with the version of the newest correction (-1: none), and wait for the reply.

        Without packets it only asks for news. A batch whose reply is lost has to be sent again. It raises as ``state``,
        and ``OversizeError`` for a batch that is too large for the cloud.
        """
        response = self._ask(
            "POST",
            f"robots/{self._robot}/packets",
            content=write_batch(packets),
            headers={CORRECTION_HEADER: str(correction)},
            passes=(400,),
        )
        index = _detail(response).get("index") if response.status_code == 400 else None
        if isinstance(index, int) and 0 <= index < len(packets):
            return HttpResponse(refusal=(index, self._reason(response)))
        with self._trying():
            if response.status_code == 400:  # the batch was corrupted on its way
                raise UnavailableError(self._reason(response))
            try:
                return HttpResponse(
                    tuple(read_batch(response.content)),
                    refused=int(response.headers.get(REFUSED_HEADER, 0)),
                    removed=response.headers.get(REMOVED_HEADER) == "1",
                )
            except (PacketError, ValueError) as error:
                raise UnavailableError(f"{self._url}: the reply is broken ({error})") from error

    def end(self) -> None:
        """Tell the cloud that this robot ends and has sent everything; raises as ``state``."""
        path, headers = f"robots/{self._robot}/packets", {ENDED_HEADER: "1"}
        self._ask("POST", path, content=write_batch(()), headers=headers)

    def detector(self, channel: Channel, version: str) -> bytes:
        """Download the file of an announced detector; raises as ``state``."""
        return self._ask("GET", f"detectors/{channel.value}/{quote(version, safe='')}").content


def addresses(given: str) -> tuple[str, ...]:
    """The addresses of a cloud's instances, which commas separate."""
    return tuple(address.strip() for address in given.split(",") if address.strip()) or (given,)


def _detail(response: "httpx.Response") -> dict[str, Any]:
    """The JSON object of an error; empty if it is none."""
    try:
        content = response.json()
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _check_url(url: str, server: Server) -> None:
    if "@" in url:
        raise CloudError("the address of a cloud has no user name and no password; remove all up to the @")
    try:
        parts = urlsplit(url)
        is_address = parts.scheme in ("http", "https") and parts.port != 0 and not any(map(str.isspace, url))
    except ValueError:  # the port, or a bracket of IPv6
        is_address = False
    if not is_address or not parts.hostname:
        raise CloudError(
            f"{url!r} is not the address of a cloud; give one like https://cloud.example:8443, "
            "on this machine http://127.0.0.1:8340"
        )
    if server.token and parts.scheme == "http" and not is_loopback(parts.hostname):
        raise CloudError(f"{url}: a token would be sent unencrypted; use https")
    if server.certificate and parts.scheme == "http":
        raise CloudError(f"{url}: certificates need https")


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _trust(server: Server) -> ssl.SSLContext:
    ca, own = server.ca, server.certificate
    try:
        context = ssl.create_default_context(cafile=None if ca is None else str(ca))
    except (OSError, ssl.SSLError) as error:
        raise CloudError(f"{ca}: cannot read a certificate authority ({error}); give a PEM file") from error
    if own is not None:
        try:
            context.load_cert_chain(*own, password=no_passphrase)
        except (OSError, ssl.SSLError) as error:
            raise CloudError(
                f"{own[0]}, {own[1]}: cannot read the certificate and its key ({error}); give PEM files"
            ) from error
    return context
