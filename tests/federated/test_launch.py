"""How long a robot tries to join, told by a clock that the test moves."""

import socket
from types import SimpleNamespace

import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.cli.federate.options import parse_address
from fcslam.errors import OutputError, TrainingError
from fcslam.federated import launch
from fcslam.federated.job import FederatedJob
from fcslam.federated.settings import FederatedSettings
from fcslam.federated.tls import Address

REFUSED, INTERRUPTED = 1, 0
STARTS_S = 2.0


@pytest.fixture
def joined(monkeypatch, tmp_path):
    """Runs ``join``: each time a SuperNode starts, ``lives`` says how long it runs and what it ends with."""

    def run(lives, listening=lambda _now: True):
        now, starts, said = [0.0], [], []

        def sleep(seconds):
            now[0] += seconds

        def be_node(_command, _log):
            starts.append(now[0])
            lived, code = lives(len(starts))
            now[0] += STARTS_S + lived
            return code

        monkeypatch.setattr(launch, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
        monkeypatch.setattr(launch, "_run_supernode", be_node)
        monkeypatch.setattr(launch, "_listens", lambda _address: listening(now[0]))
        code = launch.join(Address("there", 1), {"robot": "r"}, None, None, tmp_path / "log", said.append)
        return code, starts, now[0], said

    return run


def test_a_robot_that_is_not_known_is_refused_after_a_while(joined):
    code, starts, end, said = joined(lambda _: (0.0, REFUSED))
    assert code == REFUSED
    assert launch.GRACE_S < end < launch.GRACE_S + launch.RETRY_S + 2 * STARTS_S
    assert len(starts) > 5
    assert said == []


def test_a_robot_whose_key_comes_late_is_taken(joined):
    """And when it is interrupted it ends well."""
    late = 4
    code, starts, _, _ = joined(lambda start: (0.0, REFUSED) if start < late else (1000.0, INTERRUPTED))
    assert (code, len(starts)) == (INTERRUPTED, late)


def test_a_server_that_is_not_there_is_waited_for(joined):
    code, starts, _, said = joined(lambda _: (1.0, INTERRUPTED), listening=lambda now: now > 500.0)
    assert code == INTERRUPTED
    assert starts[0] > 500.0
    assert set(said) == {"nobody listens at there:1"}


def test_a_server_that_goes_and_comes_back_is_joined_again(joined):
    """However often: a robot that was taken once is no stranger, and each time it may be refused for a moment."""
    lives = {1: (1000.0, REFUSED), 2: (0.0, REFUSED), 3: (1000.0, REFUSED), 4: (0.0, REFUSED), 5: (9.0, INTERRUPTED)}
    code, starts, _, _ = joined(lives.__getitem__)
    assert (code, len(starts)) == (INTERRUPTED, 5)


def serve(tmp_path, where):
    task = FederatedJob(tmp_path / "run", FederatedSettings())
    launch.serve(task, "cpu", where, None, [], lambda: None)


def test_a_port_that_is_taken_is_told_before_anything_is_started(tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "FREED_S", 0.3)
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(TrainingError, match="another process listens there already"),
    ):
        serve(tmp_path, Address("127.0.0.1", taken.getsockname()[1]))
    assert not (tmp_path / "run").exists()


def test_a_name_that_means_this_machine_alone_is_told(tmp_path, monkeypatch):
    def debian(host, port):
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("127.0.1.1", port))]

    monkeypatch.setattr(socket, "getaddrinfo", debian)
    with pytest.raises(TrainingError, match=r"that name means 127\.0\.1\.1"):
        serve(tmp_path, Address("server.lab", 8000))


def test_a_log_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "run" / launch.LOG_FILE).mkdir(parents=True)
    with pytest.raises(OutputError, match="run: cannot be used as the output folder"):
        serve(tmp_path, Address("127.0.0.1", launch.free_port()))


def test_an_ipv6_address_keeps_its_brackets_outside():
    assert parse_address("[::1]:8000") == Address("::1", 8000)
    assert str(parse_address("[::1]:8000")) == "[::1]:8000"
    with pytest.raises(TrainingError, match="is no HOST:PORT"):
        parse_address("[]:8000")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1", "localhost", "LOCALHOST", "localhost.localdomain", "::1"])
def test_who_wants_loopback_gets_it(host, tmp_path, monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: [(2, 1, 6, "", ("127.0.0.1", 8000))])
    monkeypatch.setattr(launch, "_listens", lambda _address: False)
    launch._check_address(Address(host, 8000))


@pytest.mark.parametrize("host", ["no.such.name.invalid", ".lab", "x" * 64])
def test_a_name_that_is_none_is_told(host, tmp_path):
    with pytest.raises(TrainingError, match="knows no such name"):
        serve(tmp_path, Address(host, 8000))
