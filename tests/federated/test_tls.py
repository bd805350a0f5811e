"""Certificates that fit are taken, all others refused in one line, before Flower hears of them."""

import socket
import ssl
import threading
from contextlib import contextmanager

import pytest

from fcslam.errors import TrainingError
from fcslam.federated.tls import Address, Certificates, check_own_certificate, check_server_certificate
from tests.federated.authority import certificates


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    return certificates(tmp_path_factory.mktemp("fleet") / "keys")


@pytest.fixture(scope="module")
def others(tmp_path_factory):
    return certificates(tmp_path_factory.mktemp("others") / "keys")


def of(ca, certificate, key):
    return Certificates(ca / "ca.crt", certificate / "own.crt", key / "own.key")


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_certificate_fits_its_authority_its_key_and_its_names(fleet, host):
    check_own_certificate(of(fleet, fleet, fleet), host)


def refused(call, *arguments):
    with pytest.raises(TrainingError) as error:
        call(*arguments)
    (line,) = str(error.value).splitlines()
    return line


def test_another_name_key_or_authority_does_not(fleet, others):
    assert "hostname mismatch" in refused(check_own_certificate, of(fleet, fleet, fleet), "server.lab")
    assert "is not the key of" in refused(check_own_certificate, of(fleet, fleet, others), "localhost")
    assert str(others / "ca.crt") in refused(check_own_certificate, of(others, fleet, fleet), "localhost")


def test_what_is_no_certificate_is_said_by_name(fleet, tmp_path):
    (tmp_path / "text").write_text("hello")
    assert "text" in refused(
        check_own_certificate, Certificates(tmp_path / "text", fleet / "own.crt", fleet / "own.key"), "a"
    )
    assert "text" in refused(
        check_own_certificate, Certificates(fleet / "ca.crt", tmp_path / "text", fleet / "own.key"), "a"
    )


@contextmanager
def listening(context=None, words=b"HTTP/1.1 400 Bad Request\r\n\r\n"):
    """A server of one connection; without a context it knows no TLS, says ``words`` and hangs up."""

    def answer():
        connection, _ = door.accept()
        connection.settimeout(5.0)
        try:
            if context is None:
                connection.recv(4096)
                connection.sendall(words)
            else:
                connection = context.wrap_socket(connection, server_side=True)
                connection.recv(1)
        except OSError:
            pass  # the other side went away, as it may
        finally:
            connection.close()

    with socket.create_server(("127.0.0.1", 0)) as door:
        thread = threading.Thread(target=answer)
        thread.start()
        yield Address("127.0.0.1", door.getsockname()[1])
        thread.join()


def tls_of(folder):
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / "own.crt", folder / "own.key")
    return context


def test_a_server_is_known_by_the_fleets_authority(fleet, others):
    with listening(tls_of(fleet)) as address:
        check_server_certificate(address, fleet / "ca.crt")
    with listening(tls_of(others)) as address:
        line = refused(check_server_certificate, address, fleet / "ca.crt")
    assert str(address) in line
    assert "does not fit" in line


def test_a_server_without_tls_is_refused_and_one_that_is_not_there_awaited(fleet):
    with listening() as address:
        assert "does not fit" in refused(check_server_certificate, address, fleet / "ca.crt")
    check_server_certificate(address, fleet / "ca.crt")


@pytest.mark.parametrize("words", [b"", bytes.fromhex("15030300020100")], ids=["nothing", "farewell"])
def test_a_server_that_hangs_up_in_the_middle_is_awaited(fleet, words):
    with listening(words=words) as address:
        check_server_certificate(address, fleet / "ca.crt")
