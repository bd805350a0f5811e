"""A robot's side of HTTP: batches of packets to the cloud, its answers back. It tries once; its caller tries again."""

import ipaddress
import ssl
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import quote, urlsplit

from fcslam.errors import CloudError, OversizeError, PacketError, UnavailableError
from fcslam.records import Channel
from fcslam.wire.batches import AGENT_HEADER, CORRECTION_HEADER, MEDIA_TYPE, REFUSED_HEADER, read_batch, write_batch
from fcslam.wire.keys import no_passphrase

if TYPE_CHECKING:
    import httpx

CONNECT_TIMEOUT_S, ANSWER_TIMEOUT_S = 5.0, 30.0

_LATER = frozenset({408, 425, 429, 500, 502, 503, 504, 507})
"""Answers of a cloud, or of what stands before it, that may be others soon."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """One packet of a batch that the cloud will never take; its number is used up all the same.

    Those before it are stored, those after it are not.
    """

    index: int
    reason: str


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """What came of a batch."""

    packets: tuple[bytes, ...] = ()
    """Encoded packets from the cloud."""
    refusal: Refusal | None = None
    refused: int = 0
    """How many of the robot's packets count for nothing by now; some were found out after they were stored."""


@dataclass(frozen=True, slots=True)
class CloudState:
    """What the cloud has of a robot."""

    expected: Mapping[int, int]
    """The next sequence that it expects, by epoch."""
    refused: Mapping[tuple[int, int], str] = field(default_factory=dict)
    """Why packets count for nothing, by epoch and sequence."""


class BatchTransport(Protocol):
    """How a robot reaches the cloud."""

    def state(self) -> CloudState:
        """What the cloud has of this robot.

        Raises:
            UnavailableError: it cannot be asked now.
            CloudError: it turns this robot away.
        """

    def send(self, packets: Sequence[bytes], correction: int) -> HttpResponse:
        """Hand over a batch of encoded packets, tell the newest correction (-1: none), wait for the answer.

        Without packets it asks for what is new. Nothing is known of a batch whose answer is lost, so it comes again.

        Raises:
            UnavailableError: no answer came, or the cloud is busy.
            OversizeError: it takes no batch of this size.
            CloudError: it turns this robot away.
        """

    def detector(self, channel: Channel, version: str) -> bytes:
        """The file of a detector that was announced.

        Raises:
            UnavailableError: it cannot be had now.
            CloudError: there is none of this version.
        """


class HttpTransport:
    """One connection to one cloud for one robot; docs/howto-robot.md says what it makes of which answer."""

    def __init__(
        self, url: str, robot: str, agent: str, token: str | None = None, ca: Path | None = None,
        own: tuple[Path, Path] | None = None,
    ) -> None:  # fmt: skip
        """``agent`` tells two processes apart that go by one name; ``ca`` is a PEM file, the system's if not given.

        ``own``: PEM files of the robot's certificate and its key, which it shows instead of a token.

        Raises:
            CloudError: ``url`` is none, or would show the token to the network; ``ca`` or ``own`` cannot be read.
        """
        import httpx

        _check_url(url, token, own)
        self._url = url.rstrip("/")
        self._has_own = own is not None
        self._robot = quote(robot, safe="")
        headers = {AGENT_HEADER: agent, "Content-Type": MEDIA_TYPE, "Accept": MEDIA_TYPE}
        self._client = httpx.Client(
            base_url=f"{self._url}/api/v1/",
            headers=headers | ({"Authorization": f"Bearer {token}"} if token else {}),
            timeout=httpx.Timeout(ANSWER_TIMEOUT_S, connect=CONNECT_TIMEOUT_S),
            verify=_trust(ca, own),
            trust_env=False,
        )

    def close(self) -> None:
        """Hang up."""
        self._client.close()

    def state(self) -> CloudState:
        """As in BatchTransport."""
        response = self._ask("GET", f"robots/{self._robot}/state", accept="application/json")
        self._require(response, 200)
        try:
            told = response.json()
            expected = {int(epoch): int(sequence) for epoch, sequence in told["next"].items()}
            refused = {(int(one["epoch"]), int(one["sequence"])): str(one["reason"]) for one in told["refused"]}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise CloudError(f"{self._url}: answers, but not as a cloud of fcslam; give its address") from error
        return CloudState(expected, refused)

    def send(self, packets: Sequence[bytes], correction: int) -> HttpResponse:
        """As in BatchTransport."""
        response = self._ask(
            "POST",
            f"robots/{self._robot}/packets",
            content=write_batch(packets),
            headers={CORRECTION_HEADER: str(correction)},
        )
        if response.status_code == 400:
            index = _detail(response).get("index")
            if isinstance(index, int) and 0 <= index < len(packets):
                return HttpResponse(refusal=Refusal(index, self._reason(response)))
            raise UnavailableError(self._reason(response))  # the batch went astray on its way
        self._require(response, 200)
        try:
            return HttpResponse(
                tuple(read_batch(response.content)), refused=int(response.headers.get(REFUSED_HEADER, 0))
            )
        except (PacketError, ValueError) as error:
            raise UnavailableError(f"{self._url}: the answer is broken ({error})") from error

    def detector(self, channel: Channel, version: str) -> bytes:
        """As in BatchTransport."""
        response = self._ask("GET", f"detectors/{channel.value}/{quote(version, safe='')}", accept="*/*")
        self._require(response, 200)
        return response.content

    def _ask(
        self, method: str, path: str, content: bytes | None = None, headers: Mapping[str, str] | None = None,
        accept: str = MEDIA_TYPE,
    ) -> "httpx.Response":  # fmt: skip
        import httpx

        try:
            return self._client.request(method, path, content=content, headers={"Accept": accept, **(headers or {})})
        except httpx.RequestError as error:
            if isinstance(error.__cause__, ssl.SSLCertVerificationError) or "CERTIFICATE_VERIFY_FAILED" in str(error):
                raise CloudError(f"{self._url}: its certificate is not trusted ({error}); give --ca") from error
            # A cloud that does not believe a certificate hangs up, as TLS 1.3 has it, without a word that gets here.
            hint = (
                "; if that stays, it does not trust this robot's certificate"
                if self._has_own and isinstance(error, httpx.NetworkError | httpx.RemoteProtocolError)
                else ""
            )
            raise UnavailableError(f"{self._url}: {str(error) or type(error).__name__}{hint}") from error

    def _require(self, response: "httpx.Response", status: int) -> None:
        """Turn any other answer into an error."""
        code = response.status_code
        if code == status:
            return
        after = response.headers.get("Retry-After", "")
        wait_s = float(after) if after.isascii() and after.isdigit() else 0.0
        is_other_agent = code == 409 and "index" not in _detail(response)  # it may be gone soon
        if code in _LATER or is_other_agent:
            raise UnavailableError(self._reason(response), wait_s)
        raise (OversizeError if code == 413 else CloudError)(self._reason(response))

    def _reason(self, response: "httpx.Response") -> str:
        said = _detail(response).get("error") or response.reason_phrase
        return f"{self._url}: {said} ({response.status_code})"


def _detail(response: "httpx.Response") -> dict[str, Any]:
    """The JSON object of an error; empty if it is none."""
    try:
        content = response.json()
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _check_url(url: str, token: str | None, own: tuple[Path, Path] | None) -> None:
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise CloudError(f"{url!r} is no address of a cloud; give one as https://cloud.example:8443")
    if token and parts.scheme == "http" and not _is_loopback(parts.hostname):
        raise CloudError(f"{url}: a token would be readable on its way; use https")
    if own and parts.scheme == "http":
        raise CloudError(f"{url}: nobody is shown a certificate there; use https")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _trust(ca: Path | None, own: tuple[Path, Path] | None) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=None if ca is None else str(ca))
    except (OSError, ssl.SSLError) as error:
        raise CloudError(f"{ca}: no certificate authority can be read ({error}); give a PEM file") from error
    if own is not None:
        try:
            context.load_cert_chain(*own, password=no_passphrase)
        except (OSError, ssl.SSLError) as error:
            raise CloudError(f"{own[0]}, {own[1]}: no certificate with its key ({error}); give PEM files") from error
    return context
