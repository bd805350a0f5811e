"""`fcslam serve` and `fcslam tools certificates`: what is refused at once, and a real service behind TLS."""

import json
import os
import shutil
import signal
import ssl
import stat
import time
from contextlib import closing
from pathlib import Path

import httpx
import pytest
import yaml
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)

from fcslam.cli import main
from fcslam.cloud.settings import CloudConfig
from fcslam.errors import CloudError
from fcslam.mission.mission_store import MissionStore
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.missions import FIRST
from fcslam.wire.batches import read_batch, write_batch
from fcslam.wire.http_transport import HttpTransport
from fcslam.wire.keys import Server
from fcslam.wire.packets import decode, encode
from tests.cli.commands import Service
from tests.small_fleet import in_order
from tests.waiting import wait_for

API = "/api/v1"


@pytest.fixture(scope="module")
def credentials(tmp_path_factory):
    folder = tmp_path_factory.mktemp("credentials")
    names = [f"--robot=robot_{k}" for k in (1, 2, 3)]
    assert main(["tools", "certificates", "-o", str(folder), "--host", "cloud.test", *names, "--admin", "boss"]) == 0
    return folder


def token(folder, name):
    return (folder / ("robots" if name.startswith("robot") else "users") / name / "token").read_text().strip()


def test_secrets_are_their_owners_alone_and_the_cloud_knows_hashes_only(credentials):
    for name in ("ca.key", "cloud.key", "robots/robot_1/client.key", "robots/robot_1/token", "users/boss/token"):
        assert stat.S_IMODE((credentials / name).stat().st_mode) == 0o600
    text = (credentials / "tokens.yaml").read_text()
    assert token(credentials, "robot_1") not in text
    assert [entry["name"] for entry in yaml.safe_load(text)["tokens"]] == ["robot_1", "robot_2", "robot_3", "boss"]
    assert {path.parent.name for path in credentials.rglob("client.pem")} == {"robot_1", "robot_2", "robot_3"}


def test_once_more_keeps_what_is_there_and_adds_what_is_new(credentials, tmp_path):
    mine = shutil.copytree(credentials, tmp_path / "credentials")  # the other tests share theirs
    tokens, again = mine / "tokens.yaml", ["tools", "certificates", "-o", str(mine), "--robot", "robot_1"]
    tokens.write_text("# robots of the ground floor\n" + tokens.read_text())
    tokens.chmod(0o640)
    kept = [mine / name for name in ("ca.pem", "ca.key", "cloud.pem", "users/boss/token", "robots/robot_1/token")]
    before = [path.read_bytes() for path in (*kept, tokens)]
    assert main(again) == 0
    assert [path.read_bytes() for path in (*kept, tokens)] == before
    assert main([*again, "--robot", "new"]) == 0
    assert [path.read_bytes() for path in kept] == before[:-1]
    names = [entry["name"] for entry in yaml.safe_load(tokens.read_text())["tokens"]]
    assert names == ["robot_1", "robot_2", "robot_3", "boss", "new"]
    assert stat.S_IMODE(tokens.stat().st_mode) == 0o640


@pytest.mark.parametrize("wrong", [["--robot", "a", "--viewer", "a"], ["--robot", "a+1"], ["--robot", "../a"]])
def test_names_that_cannot_be_are_refused(tmp_path, wrong, refused):
    assert refused("tools", "certificates", "-o", tmp_path / "out", *wrong)
    assert not (tmp_path / "out").exists()


def test_a_folder_without_tokens_opens_the_service_to_nobody(credentials, tmp_path, refused):
    for name in ("cloud.pem", "cloud.key"):
        shutil.copy(credentials / name, tmp_path / name)
    line = refused("serve", "--data", tmp_path / "data", "--credentials", tmp_path, "--port", 0)
    assert "holds no tokens.yaml, so everybody could send" in line


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (["--credentials", "half"], "belong together"),
        (["--credentials", "bad"], "cloud.pem"),
        (["--client-ca", "ca.pem"], "--credentials with cloud.pem"),
        (["--credentials", "tokens"], "tokens.yaml"),
    ],
)
def test_a_service_that_cannot_run_as_told_says_so_in_one_line(tmp_path, wrong, says, refused, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for place in ("half/cloud.key", "bad/cloud.key", "bad/cloud.pem", "tokens/tokens.yaml"):
        Path(place).parent.mkdir(exist_ok=True)
        Path(place).write_text("x")
    assert says in refused("serve", "--data", "data", "--port", 0, *wrong)


def test_an_encrypted_key_is_told_and_no_passphrase_asked_for(credentials, tmp_path, refused):
    key = load_pem_private_key((credentials / "cloud.key").read_bytes(), None)
    (tmp_path / "sealed").mkdir()
    shutil.copy(credentials / "cloud.pem", tmp_path / "sealed")
    sealed = tmp_path / "sealed" / "cloud.key"
    sealed.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret")))
    line = refused("serve", "--data", tmp_path / "data", "--port", 0, "--credentials", sealed.parent)
    assert "cloud.key" in line
    assert "encrypted" in line
    with pytest.raises(CloudError, match="encrypted"):
        HttpTransport(Server("https://cloud.test", certificate=(credentials / "cloud.pem", sealed)), "robot_1", "agent")


def send(client, robot, packets, **headers):
    batch = write_batch([encode(packet) for packet in packets])
    response = client.post(f"{API}/robots/{robot}/packets", content=batch, headers={"Fcslam-Agent": "x", **headers})
    assert response.status_code == 200, response.text
    return decode(read_batch(response.content)[0]).body.sequence


def children(pid):
    """Processes that this one started, of all its threads."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


MAPPED = ("pose_graph.g2o", "closures.csv", "robots.csv", "*.pgm", "*.yaml", "*.png", "trajectories/*", "local/*")


def mapped(folder):
    """The files of a run folder, without those about its traffic."""
    return {str(path.relative_to(folder)): path.read_bytes() for name in MAPPED for path in folder.glob(name)}


@pytest.mark.attack
@pytest.mark.system
def test_a_removed_robot_leaves_no_trace_and_its_undo_neither(tmp_path, packets):
    """The worker is killed in between; the robot goes on sending. Nobody else may read what they send."""
    honest = [packet for packet in packets if packet.robot != "robot_2"]
    service = Service(tmp_path / "data")
    with closing(service), httpx.Client(base_url=service.url, timeout=300.0) as client:

        def play(sent):
            for robot in dict.fromkeys(packet.robot for packet in sent):
                send(client, robot, [packet for packet in sent if packet.robot == robot])

        def finalized():
            return mapped(Path(client.post(f"{API}/finalize").json()["run"]))

        def robots():
            return {robot for one in client.get(f"{API}/maps").json() for robot in one["robots"]}

        expected = {}
        for name, sent in (("without", honest), ("with", packets)):
            client.post(f"{API}/missions", json={"name": name}).raise_for_status()
            play(sent)
            expected[name] = finalized()
        assert expected["with"] != expected["without"]
        client.post(f"{API}/missions", json={"name": "edited"}).raise_for_status()
        cut = 2 * len(packets) // 3
        play(packets[:cut])
        wait_for(lambda: robots() == {"robot_1", "robot_2", "robot_3"})
        removed = client.post(f"{API}/edits", json={"kind": "removal", "content": {"robot": "robot_2"}}).json()
        wait_for(lambda: robots() == {"robot_1", "robot_3"})
        os.kill(children(service.process.pid)[0], signal.SIGKILL)
        play(packets[cut:])
        assert finalized() == expected["without"]
        assert robots() == {"robot_1", "robot_3"}
        assert client.post(f"{API}/edits/{removed['number']}/undo").status_code == 201
        assert finalized() == expected["with"]
        wait_for(lambda: robots() == {"robot_1", "robot_2", "robot_3"})
        wait_for(lambda: client.get("/readyz").json()["backlog"] == 0)
        audited = [json.loads(line)["action"] for line in (tmp_path / "data" / "audit.jsonl").read_text().splitlines()]
        assert audited[-4:] == [
            f"POST {API}/edits", f"POST {API}/finalize", f"POST {API}/edits/1/undo", f"POST {API}/finalize"
        ]  # fmt: skip
    assert all(path.stat().st_mode & 0o077 == 0 for path in tmp_path.glob("data*/**/*"))


@pytest.mark.attack
@pytest.mark.system
@pytest.mark.parametrize("options", [(), ("--insecure",)])
def test_a_service_without_tokens_answers_to_no_other_name(tmp_path, options):
    """As when a web page points its own name to 127.0.0.1."""
    service = Service(tmp_path / "data", *options)
    try:
        assert httpx.get(f"{service.url}{API}/robots").status_code == 200
        page = httpx.get(f"{service.url}{API}/robots", headers={"Host": "evil.example"})
        assert page.status_code == 421
        forged = {"Origin": "http://evil.example", "X-Forwarded-For": "6.6.6.6"}
        made = httpx.post(f"{service.url}{API}/missions", json={"name": "forged"}, headers=forged)
        assert made.status_code == 403
        audited = [
            httpx.get(f"{service.url}{API}/audit", headers={"X-Forwarded-For": "6.6.6.6"}).text for _ in range(2)
        ]
        assert "127.0.0.1" in audited[1]
        assert "6.6.6.6" not in audited[1]
    finally:
        service.stop()


@pytest.mark.system
def test_an_option_that_an_existing_mission_does_not_take_is_told(tmp_path, capfd):
    folder = MissionFolder.of(tmp_path / "data", FIRST)
    folder.path.mkdir(parents=True)
    with closing(MissionStore(folder.store)) as store:
        store.configure(CloudConfig())
    Service(tmp_path / "data", "--3d").stop()
    assert "mission 'mission' keeps its configuration" in capfd.readouterr().err


@pytest.fixture(scope="module")
def secured(credentials, tmp_path_factory):
    """A service behind TLS with tokens, its data, and the file of its tokens."""
    folder = tmp_path_factory.mktemp("secured")
    own = shutil.copytree(credentials, folder / "credentials")
    asked = ["--credentials", str(own), "--client-ca", str(credentials / "ca.pem")]
    with closing(Service(folder / "data", *asked)) as service:
        yield service, folder / "data", own / "tokens.yaml"


def trusting(credentials):
    return ssl.create_default_context(cafile=str(credentials / "ca.pem"))


@pytest.mark.system
def test_behind_tls_with_tokens_a_robot_is_itself_alone(packets, credentials, secured):
    mine = in_order(p for p in packets if p.robot == "robot_1")[:40]
    service, _, _ = secured
    trusted = trusting(credentials)
    bearer = {"Authorization": f"Bearer {token(credentials, 'robot_1')}"}
    with httpx.Client(base_url=service.url, verify=trusted, timeout=60.0) as client:
        assert send(client, "robot_1", mine, **bearer) == 39
        assert client.get(f"{API}/robots/robot_2/state", headers=bearer).status_code == 403
        assert client.get(f"{API}/robots/robot_1/state").status_code == 401
        assert client.get(f"{API}/fleet", headers=bearer).status_code == 403
        boss = {"Authorization": f"Bearer {token(credentials, 'boss')}"}
        assert client.get(f"{API}/fleet", headers=boss).json()["packets"] == 40
    own = credentials / "robots" / "robot_2"
    trusted.load_cert_chain(own / "client.pem", own / "client.key")
    with httpx.Client(base_url=service.url, verify=trusted, timeout=60.0) as client:
        assert client.get(f"{API}/robots/robot_2/state").status_code == 200, "it has shown its certificate"
        assert client.get(f"{API}/robots/robot_1/state").status_code == 403
    with httpx.Client(base_url=service.url, timeout=60.0) as client, pytest.raises(httpx.ConnectError):
        client.get("/healthz")


@pytest.mark.system
def test_tokens_are_read_again_at_sighup(credentials, secured):
    service, data, tokens = secured
    as_boss = {"Authorization": f"Bearer {token(credentials, 'boss')}"}
    trusted = trusting(credentials)

    def hang_up(text):
        tokens.write_text(text)
        service.process.send_signal(signal.SIGHUP)
        time.sleep(1.0)
        return httpx.get(f"{service.url}{API}/robots", headers=as_boss, verify=trusted, timeout=30.0).status_code

    entries = yaml.safe_load(tokens.read_text())["tokens"]
    (boss,) = (entry for entry in entries if entry["name"] == "boss")
    others = [entry for entry in entries if entry is not boss]
    ended = [*others, {**boss, "expires": "2020-01-01T00:00:00Z"}]
    assert hang_up(yaml.safe_dump({"tokens": entries})) == 200
    assert hang_up("tokens: [") == 200, "those of before stay"
    assert hang_up(yaml.safe_dump({"tokens": ended})) == 401
    assert hang_up(yaml.safe_dump({"tokens": entries})) == 200
    assert hang_up(yaml.safe_dump({"tokens": others})) == 401
    assert hang_up(yaml.safe_dump({"tokens": entries})) == 200
    lines = [json.loads(line) for line in (data / "audit.jsonl").read_text().splitlines()]
    read = [line["content"]["changed"] for line in lines if line["action"] == "tokens read again"]
    assert read == [[], *4 * [["boss"]]]
