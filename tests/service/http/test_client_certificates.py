"""Over real TLS: a robot that shows its certificate is that robot, and nobody else is let in by one."""

import datetime
import ssl

import httpx
import pytest

from fcslam.errors import CloudError, UnavailableError
from fcslam.service.authentication import Authenticator, Identity, Role, read_tokens
from fcslam.service.credentials import make_credentials
from fcslam.service.http.protocol import GuardedProtocol
from fcslam.wire.http_transport import HttpTransport
from fcslam.wire.keys import Server
from fcslam.wire.messages import Acknowledgement
from fcslam.wire.packets import decode
from tests.service.http.desk import A, B, Desk

pytestmark = pytest.mark.slow

NOW = datetime.datetime.now(datetime.UTC)
ROBOTS = {"a": Role.ROBOT, "b": Role.ROBOT, "boss": Role.ROBOT}


def pair(folder, name):
    return folder / f"{name}.pem", folder / f"{name}.key"


def own_pair(folder, robot):
    return pair(folder / "robots" / robot, "client")


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    make_credentials(folder := tmp_path_factory.mktemp("ours"), [], ROBOTS, NOW)
    return folder


@pytest.fixture
def connect(tmp_path, scripted, authority):
    """Makes a robot's connection to a service that asks for certificates and takes tokens."""
    scripted()
    transports = []
    certificate, key = pair(authority, "cloud")
    tls = {
        "http": GuardedProtocol, "ssl_certfile": certificate, "ssl_keyfile": key,
        "ssl_ca_certs": str(authority / "ca.pem"), "ssl_cert_reqs": ssl.CERT_OPTIONAL,
    }  # fmt: skip
    with Desk(tmp_path / "data", read_tokens(authority / "tokens.yaml"), **tls) as desk:

        def made(own, robot="a", token=None):
            url = str(desk.client.base_url).replace("http:", "https:")
            transports.append(HttpTransport(Server(url, token, authority / "ca.pem", own), robot, "ab" * 16))
            return transports[-1]

        made.desk = desk
        yield made
        for transport in transports:
            transport.close()


def stored(connect):
    return connect.desk.state.mission.intake.ready_count()


def test_a_robot_with_its_certificate_needs_no_token(connect, authority):
    robot = connect(own_pair(authority, "a"))
    assert decode(robot.send(A[:3], -1).packets[0]).body == Acknowledgement("a", 0, 2)
    assert robot.state().expected == {0: 3}, "and again in the same connection"


def test_without_a_certificate_a_token_is_needed(connect, authority):
    with pytest.raises(CloudError, match=r"certificate.* \(401\)"):
        connect(None).send(A[:3], -1)
    assert stored(connect) == 0
    token = (authority / "robots" / "b" / "token").read_text().strip()
    assert connect(None, "b", token).send(B[:3], -1).packets
    assert connect(own_pair(authority, "a"), "b", token).state().expected == {0: 3}, "what is said counts"


def test_another_robots_certificate_is_not_good(connect, authority):
    with pytest.raises(CloudError, match=r"'b' does not speak for robot 'a' \(403\)"):
        connect(own_pair(authority, "b")).send(A[:3], -1)
    assert stored(connect) == 0


@pytest.mark.parametrize("made", ["by others", "for the cloud", "long ago"])
def test_who_shows_a_certificate_that_is_not_good_is_hung_up_on(connect, authority, tmp_path, made):
    own = pair(authority, "cloud")
    if made == "by others":
        make_credentials(tmp_path, [], ROBOTS, NOW)
        own = own_pair(tmp_path, "a")
    if made == "long ago":
        for name in ("ca.pem", "ca.key"):
            (tmp_path / name).write_bytes((authority / name).read_bytes())
        make_credentials(tmp_path, [], ROBOTS, NOW - datetime.timedelta(days=400))
        own = own_pair(tmp_path, "a")
    with pytest.raises(UnavailableError, match="does not trust this robot's certificate"):
        connect(own).send(A[:3], -1)
    assert stored(connect) == 0


def test_a_certificate_is_a_robots_whatever_it_is_called(connect, authority):
    """One of the authority's that names an administrator by a token opens nothing but a robot's own door."""
    robot = connect(own_pair(authority, "boss"), "boss")
    assert robot.state().expected == {}
    url = str(connect.desk.client.base_url).replace("http:", "https:")
    tls = ssl.create_default_context(cafile=authority / "ca.pem")
    tls.load_cert_chain(*own_pair(authority, "boss"))
    for method, path in (("GET", "fleet"), ("POST", "finalize")):
        assert httpx.request(method, f"{url}/api/v1/{path}", verify=tls).status_code == 403


@pytest.mark.parametrize(
    ("subject", "who"),
    [
        ("CN=a", Identity("a", Role.ROBOT)), ("CN=a,O=fleet", Identity("a", Role.ROBOT)), ("O=fleet", None), ("", None),
        ("CN=a+CN=b", None), ("CN=a\\+1", None), ("CN=../a", None), ("CN=", None), ("OU=a", None), ("CN=a\\00", None),
    ],
)  # fmt: skip
def test_the_common_name_must_be_a_robots(subject, who):
    assert Authenticator(()).who(None, subject) == who
    assert Authenticator(()).who("Bearer x", subject) is None


def test_a_certificate_that_cannot_be_used_is_told(authority, tmp_path):
    with pytest.raises(CloudError, match="cannot read the certificate and its key"):
        HttpTransport(
            Server("https://cloud.example", certificate=(authority / "ca.pem", tmp_path / "none")), "a", "ab" * 16
        )
    with pytest.raises(CloudError, match="need https"):
        HttpTransport(Server("http://localhost", certificate=own_pair(authority, "a")), "a", "ab" * 16)
