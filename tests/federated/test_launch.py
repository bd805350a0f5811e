"""Addresses of a server, and a robot that waits for one, without ports and processes where that is possible."""

import socket

import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.cli.federate.options import parse_address
from fcslam.errors import OutputError, TrainingError
from fcslam.federated import launch
from fcslam.federated.identity import RobotAuthenticator
from fcslam.federated.job import FederatedJob, ProgressCallbacks
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.tls import Address
from fcslam.learning.trainer import ExecutionOptions
from tests.federated.authority import free_port


def serve(tmp_path, where):
    task = FederatedJob(tmp_path / "run", FederatedSettings())
    launch.serve(task, ExecutionOptions(), where, None, RobotAuthenticator(None), ProgressCallbacks(), print)


def test_a_port_that_is_taken_is_told_before_anything_is_started(tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "FREED_S", 0.3)
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(TrainingError, match="cannot listen there"),
    ):
        serve(tmp_path, Address("127.0.0.1", taken.getsockname()[1]))
    assert not (tmp_path / "run").exists()


def test_a_name_that_means_this_machine_alone_is_told(tmp_path, monkeypatch):
    def debian(host, port):
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("127.0.1.1", port))]

    monkeypatch.setattr(socket, "getaddrinfo", debian)
    with pytest.raises(TrainingError, match=r"that name means 127\.0\.1\.1"):
        serve(tmp_path, Address("server.lab", 8000))


def test_an_output_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(OutputError, match="run: cannot be used as the output folder"):
        serve(tmp_path, Address("127.0.0.1", free_port()))


def test_an_ipv6_address_keeps_its_brackets_outside():
    assert parse_address("[::1]:8000") == Address("::1", 8000)
    assert str(parse_address("[::1]:8000")) == "[::1]:8000"
    with pytest.raises(TrainingError, match="is not a HOST:PORT"):
        parse_address("[]:8000")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1", "localhost", "LOCALHOST", "localhost.localdomain", "::1"])
def test_who_wants_loopback_gets_it(host, tmp_path, monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: [(2, 1, 6, "", ("127.0.0.1", 8000))])
    launch._check_name(Address(host, 8000))


@pytest.mark.parametrize("host", ["no.such.name.invalid", ".lab", "x" * 64])
def test_a_name_that_is_none_is_told(host, tmp_path):
    with pytest.raises(TrainingError, match="knows no such name"):
        serve(tmp_path, Address(host, 8000))
