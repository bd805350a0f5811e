"""`fcslam serve --store` answers wrong options in one line, without a password."""

import contextlib
import os
import signal
import socket
import subprocess
import sys

import httpx
import pytest

from fcslam.cli import main
from fcslam.service.shared.registry import Registry
from tests.postgres import PASSWORD, free_port
from tests.waiting import wait_for

WRONG = "no-such-secret"


def refused(arguments, tmp_path, capsys):
    assert main(["serve", "--data", str(tmp_path / "data"), "--port", "0", "--store", *arguments]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert PASSWORD not in line
    assert WRONG not in line
    return line


@pytest.fixture(autouse=True)
def no_password(monkeypatch):
    monkeypatch.delenv("PGPASSWORD", raising=False)


@pytest.mark.parametrize(
    ("url", "says"),
    [
        (f"mysql://me:{WRONG}@127.0.0.1/x", "write postgresql://USER@HOST:PORT/DATABASE"),
        (f"postgresql://me:{WRONG}@127.0.0.1:port/x", 'invalid integer value "port"'),
        (f"postgresql://me@127.0.0.1/x?sslpassword={WRONG}", "use PGSERVICEFILE"),
        ("data/missions.db", "write postgresql://USER@HOST:PORT/DATABASE"),
    ],
)
def test_an_address_that_is_none_is_told(url, says, tmp_path, capsys):
    assert says in refused([url], tmp_path, capsys)


def test_without_the_driver_the_extra_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "psycopg", None)
    line = refused([f"postgresql://me:{WRONG}@127.0.0.1/x"], tmp_path, capsys)
    assert "pip install 'fcslam[postgres]'" in line


def test_a_server_that_cannot_be_used_is_told(postgres_server, tmp_path, capsys):
    place = f"127.0.0.1:{postgres_server.port}"
    nobody = f"postgresql://fcslam:{PASSWORD}@127.0.0.1:{free_port()}/postgres"
    assert "refused" in refused([nobody], tmp_path, capsys)
    wrong = f"postgresql://fcslam:{WRONG}@{place}/postgres"
    assert "password authentication failed" in refused([wrong], tmp_path, capsys)
    hidden = f"postgresql://fcslam@{place}/postgres?password={WRONG}"
    assert "password authentication failed" in refused([hidden], tmp_path, capsys)
    missing = f"postgresql://fcslam:{PASSWORD}@{place}/missing"
    assert 'database "missing" does not exist' in refused([missing], tmp_path, capsys)


def test_a_role_without_rights_is_told(postgres, postgres_server, tmp_path, capsys):
    with postgres.connection("SELECT 1") as connection:
        connection.execute("DROP DATABASE IF EXISTS guarded")
        connection.execute("CREATE DATABASE guarded")
        connection.execute("DROP ROLE IF EXISTS weak")
        connection.execute(f"CREATE ROLE weak LOGIN PASSWORD '{PASSWORD}'")
    line = refused([f"postgresql://weak:{PASSWORD}@127.0.0.1:{postgres_server.port}/guarded"], tmp_path, capsys)
    assert "too few rights" in line
    assert "GRANT CREATE ON DATABASE" in line


def test_a_name_that_is_taken_is_told(postgres, postgres_server, tmp_path, capsys):
    postgres.rows("DELETE FROM instances RETURNING 1")
    port = free_port()
    assert Registry(postgres, f"{socket.gethostname()}-{port}", "another process", 3600.0).register(1)
    line = refused([postgres_server.url, "--port", str(port)], tmp_path, capsys)
    assert f"another instance is called '{socket.gethostname()}-{port}'" in line


def test_a_limit_that_is_not_one_is_told(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("FCSLAM_MAX_MISSIONS", "few")
    assert "FCSLAM_MAX_MISSIONS=few" in refused(["postgresql://u@h/d"], tmp_path, capsys)


@pytest.mark.system
def test_an_instance_shows_no_password_survives_its_database_and_ends_in_order(postgres, postgres_server, tmp_path):
    for table in ("missions", "instances"):
        postgres.rows(f"DELETE FROM {table} RETURNING 1")
    port = free_port()
    command = [sys.executable, "-c", "from fcslam.cli import main; raise SystemExit(main())"]
    options = ["serve", "--data", str(tmp_path), "--port", str(port), "--store", postgres.url]
    environment = {**os.environ, "PGPASSWORD": PASSWORD}
    with subprocess.Popen(
        [*command, *options], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as served:
        try:
            address = f"http://127.0.0.1:{port}"

            def is_ready():
                with contextlib.suppress(httpx.TransportError):
                    return httpx.get(f"{address}/healthz", verify=False).status_code == 200

            wait_for(is_ready)
            workers = subprocess.run(["ps", "-eo", "args"], check=True, capture_output=True, text=True).stdout
            assert PASSWORD not in workers
            assert httpx.get(f"{address}/missions/mission/api/v1/fleet").json()["mission"] == "mission"
            assert httpx.get(f"{address}/missions/other/api/v1/fleet").status_code == 404
            assert httpx.post(f"{address}/api/v1/missions", json={"name": "other"}).json()["open"] == "other"
            assert httpx.get(f"{address}/missions/other/api/v1/fleet").json()["mission"] == "other"
            assert httpx.get(f"{address}/api/v1/fleet").json()["mission"] == "other"
            assert httpx.get(f"{address}/missions/other/").status_code in (200, 404)
            postgres_server.stop()
            for method, path in (("GET", "fleet"), ("POST", "robots/a/packets"), ("POST", "finalize")):
                away = httpx.request(method, f"{address}/api/v1/{path}", timeout=60.0)
                assert away.status_code == 503, away.text
                assert "cannot be used" in away.text
            postgres_server.start()
        finally:
            served.send_signal(signal.SIGTERM)
            told, _ = served.communicate(timeout=60)
    assert served.returncode in (0, -signal.SIGTERM), told
    assert PASSWORD not in told
    assert "Traceback" not in told
    assert postgres.rows("SELECT count(*) FROM instances") == [(0,)]
    assert postgres.rows("SELECT count(*) FROM missions WHERE expires > clock_timestamp()") == [(0,)]
