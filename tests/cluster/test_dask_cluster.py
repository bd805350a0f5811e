"""A real Dask cluster: the same bytes, whatever happens to it."""

import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import pytest

from fcslam.cli import main
from fcslam.cluster.verifying import DaskCluster, verifying
from fcslam.errors import InputError
from fcslam.lidar.pair_verification import VerificationPool, verify_here
from fcslam.mission.mission_store import MissionStore
from fcslam.service.credentials import make_cluster_credentials
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.supervisor import READY, WorkerTask
from tests.cluster.clusters import Cluster, needs_dask, written_address
from tests.lidar.test_pair_verification import pairs_of, written
from tests.mission.test_mission_file import contents
from tests.waiting import wait_for

pytestmark = [needs_dask, pytest.mark.slow]

DIFFERENT = "whose sources or libraries differ from fcslam 0.1.0 here; install the same ones there"


@pytest.fixture(scope="module")
def pairs():
    return pairs_of(2, lambda count: [(a, b, off) for a in range(count) for b in range(a) for off in (0.02, 0.5)][:300])


@pytest.fixture(scope="module")
def expected(pairs):
    return written(verify_here(pairs))


@pytest.fixture
def warnings_of(caplog):
    caplog.set_level(logging.INFO, "fcslam")
    return lambda: [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]


def test_killed_workers_and_a_scheduler_that_vanishes_change_nothing(tmp_path, pairs, expected, warnings_of, caplog):
    with Cluster(tmp_path) as cluster:
        one, two = cluster.start_worker("one"), cluster.start_worker("two")
        time.sleep(3.0)
        with DaskCluster(cluster.address) as workers:
            verify = VerificationPool(workers.executors, batch=2, patience_s=0.5, rest_s=0.5)
            wait_for(lambda: len(workers.executors()) == 2)

            def is_done_by_others(answers=1):
                before = verify.answers
                return written(verify(pairs)) == expected and verify.answers >= before + answers

            wait_for(lambda: is_done_by_others(4))

            os.kill(one.pid, signal.SIGSTOP)  # it neither works nor ends
            assert written(verify(pairs)) == expected
            one.kill()
            assert written(verify(pairs)) == expected
            assert written(verify(pairs[::-1])) == expected[::-1]
            wait_for(lambda: len(workers.executors()) == 1)
            assert not warnings_of(), "a cluster may shrink"

            wait_for(is_done_by_others)
            cluster.scheduler.kill()
            for _ in range(3):
                assert written(verify(pairs)) == expected
            wait_for(lambda: not workers.executors())
            assert written(verify(pairs)) == expected
            (warning,) = wait_for(warnings_of)
            assert warning.startswith(f"the cluster {cluster.address} is gone")

            two.kill()
            cluster.scheduler.wait()
            cluster.start_scheduler(int(cluster.address.rpartition(":")[2]))
            cluster.start_worker("three")
            wait_for(workers.executors)
            wait_for(is_done_by_others)
            wait_for(lambda: "is back" in caplog.text)
        assert len(warnings_of()) == 1


def test_a_worker_of_another_version_is_refused_by_name(tmp_path, pairs, expected, warnings_of):
    """At the start by one line, later by no work."""
    with Cluster(tmp_path) as cluster:
        check_refused(cluster.address, f"{cluster.address}: the cluster has no worker; start one: dask worker")
        old = cluster.start_worker("old", preload="import fcslam; fcslam.__version__ = '0.0.9'")
        refused = wait_for(lambda: refusal(cluster))
        assert refused.startswith(f"{cluster.address}: worker 'old' (tcp://127.0.0.1:")
        assert refused.endswith(f") has fcslam 0.0.9, {DIFFERENT}")
        old.kill()

        cluster.start_worker("good")
        wait_for(lambda: refusal(cluster) is None)
        with DaskCluster(cluster.address) as workers:
            cluster.start_worker(
                "changed", preload="import fcslam.storage.state_file as file; file.code_version = lambda: 'other'"
            )
            (warning,) = wait_for(warnings_of)
            assert warning.startswith("a worker of the cluster gets no work: 'changed' (tcp://127.0.0.1:")
            assert warning.endswith(f"has fcslam 0.1.0, {DIFFERENT}")
            assert len(workers.executors()) == 1
            assert written(VerificationPool(workers.executors)(pairs)) == expected
        assert len(warnings_of()) == 1


def credentials(folder):
    make_cluster_credentials(folder, datetime.now(UTC))
    return [folder / "cluster" / name for name in ("ca.pem", "member.pem", "member.key")]


def check_refused(address, reason):
    with pytest.raises(InputError, match=reason), verifying(address):
        pass


def refusal(cluster):
    """Why the cluster cannot be used; None: it can."""
    try:
        with verifying(cluster.address):
            return None
    except InputError as error:
        return "" if "has no worker" in str(error) else str(error)


def test_a_cluster_that_is_not_there_is_told_in_one_line_or_waited_for(monkeypatch, tmp_path, warnings_of, pairs):
    from fcslam.cluster import verifying as dask_cluster

    monkeypatch.setattr(dask_cluster, "CONNECT_S", 0.5)
    nobody = "tcp://127.0.0.1:9"
    check_refused(nobody, f"{nobody}: no Dask scheduler answers .*; start one: dask scheduler")
    with verifying(nobody, must_connect=False) as verify:
        assert written(verify(pairs[:5])) == written(verify_here(pairs[:5]))
        assert len(warnings_of()) == 1


def configured(files):
    """Dask's configuration with the certificates of a client."""
    import dask
    import distributed  # noqa: F401  its defaults must be there before: they would go with these

    keys = ("distributed.comm.tls.ca-file", "distributed.comm.tls.client.cert", "distributed.comm.tls.client.key")
    return dask.config.set(dict(zip(keys, map(str, files), strict=True)))


def test_a_cluster_with_tls_takes_its_own_certificates_only(tmp_path, pairs, expected):
    ours, others = (credentials(tmp_path / name) for name in ("ours", "others"))
    options = ("--tls-ca-file", ours[0], "--tls-cert", ours[1], "--tls-key", ours[2])
    with Cluster(tmp_path, "tls", tuple(map(str, options))) as cluster:
        assert cluster.address.startswith("tls://")
        cluster.start_worker("one")
        with configured(others):
            check_refused(cluster.address, "no Dask scheduler answers")
        check_refused(cluster.address, "the certificates cannot be used|no Dask scheduler answers")
        wait_for(lambda: "Starting established" in (tmp_path / "scheduler-0.log").read_text())
        time.sleep(1.0)
        with configured(ours), DaskCluster(cluster.address) as workers:
            assert len(workers.executors()) == 1
            assert written(VerificationPool(workers.executors)(pairs)) == expected


def is_silent(port):
    """Whether a port of another machine's processes, asked without a certificate, says nothing but 404."""
    address = "127.0.0.1" if port.ip in ("0.0.0.0", "::") else port.ip
    with socket.create_connection((address, port.port), 5.0) as plain:
        plain.sendall(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        with suppress(ConnectionError):
            answer = plain.recv(1000)
            return answer.startswith(b"HTTP/1.1 404") if port.ip == "127.0.0.1" else not answer.startswith(b"HTTP")
    return True


def test_the_documented_cluster_answers_nobody_without_its_certificates(tmp_path, monkeypatch):
    """Lists the open ports of both commands: other machines reach those with TLS only, and the others have no pages."""
    import psutil

    credentials(tmp_path)
    monkeypatch.chdir(tmp_path / "cluster")
    page = (Path(__file__).parents[2] / "docs" / "howto" / "cluster.md").read_text(encoding="utf-8")
    for name, value in re.findall(r"^    export (\w+ROUTES)='(.*)'$", page, re.MULTILINE):
        monkeypatch.setenv(name, value)
    documented = [re.search(rf"^    dask {kind} (.*)$", page, re.MULTILINE)[1] for kind in ("scheduler", "worker")]
    with Cluster(tmp_path, "tls", start=False) as cluster:
        scheduler, worker = (options.split() for options in documented)
        scheduler[scheduler.index("tls://:8786")], worker[worker.index("4")] = "tls://:0", "1"
        cluster.start("scheduler", *scheduler, "--scheduler-file", "s.json")
        worker[worker.index("tls://scheduler:8786")] = wait_for(lambda: written_address(Path("s.json")))
        cluster.start("worker", *worker)
        wait_for(lambda: "Registered to" in (tmp_path / "worker-1.log").read_text())
        programs = [psutil.Process(each.pid) for each in cluster.processes]
        programs += [child for each in programs for child in each.children(recursive=True)]
        ports = {one.laddr for each in programs for one in each.net_connections("tcp") if one.status == "LISTEN"}
        assert len(ports) >= 5  # scheduler, worker and nanny, and HTTP of the first two
        assert [port for port in ports if not is_silent(port)] == []


def test_the_command_maps_the_same_on_a_cluster_and_on_processes(tmp_path, logs, capsys):
    arguments = ["map", *map(str, logs), "--quiet", "--output"]
    assert main([*arguments, str(tmp_path / "here")]) == 0
    assert main([*arguments, str(tmp_path / "processes"), "--workers", "2"]) == 0
    with Cluster(tmp_path) as cluster:
        cluster.start_worker("one")
        wait_for(lambda: refusal(cluster) is None)
        assert main([*arguments, str(tmp_path / "cluster"), "--workers", cluster.address]) == 0
    expected = contents(tmp_path / "here")
    assert contents(tmp_path / "processes") == contents(tmp_path / "cluster") == expected
    capsys.readouterr()
    assert main([*arguments, str(tmp_path / "none"), "--workers", "tcp://127.0.0.1:x"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_worker_of_a_mission_uses_the_cluster_and_outlives_it(tmp_path):
    folder = MissionFolder(tmp_path / "mission")
    folder.path.mkdir()
    MissionStore(folder.store)
    with Cluster(tmp_path) as cluster:
        cluster.start_worker("one")
        wait_for(lambda: refusal(cluster) is None)
        task = WorkerTask(str(folder.path), cluster.address)
        command = [sys.executable, "-m", "fcslam.service.worker"]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            process.stdin.write(json.dumps(task._asdict()).encode() + b"\n")
            process.stdin.flush()
            while json.loads(process.stdout.readline())["event"] != READY:
                pass
            cluster.scheduler.kill()
            assert b"is gone" in process.stderr.readline()
            process.stdin.close()
            assert process.stderr.read() == b""
            assert process.wait(60) == 0
