"""The systemd unit of docs/howto/deploy.md, and the service under the restrictions that it asks for."""

import configparser
import contextlib
import os
import re
import shlex
import shutil
import signal
import ssl
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from numba.core.caching import UserProvidedCacheLocator

from fcslam.cli import main
from tests.postgres import free_port
from tests.waiting import wait_for

ROOT = Path(__file__).parents[2]
PATIENCE_S = 300.0
RESTRICTED = """
set -e
for folder in {writable}; do mount --bind "$folder" "$folder"; done
mount -o remount,bind,ro /
exec setpriv --no-new-privs --bounding-set=-all --inh-caps=-all -- "$@"
"""
"""ProtectSystem=strict with the unit's state and cache, NoNewPrivileges=yes, and an unprivileged user: root without its
capabilities, because the Python of this machine may lie where only root can read it."""


def units():
    """The units of the page, by section and key: that of the service and that of a robot."""
    page, found = (ROOT / "docs" / "howto" / "deploy.md").read_text(encoding="utf-8"), []
    for text in re.findall(r"```ini\n(\[Unit\]\n.*?)```", page, re.DOTALL):
        found.append(configparser.ConfigParser())
        found[-1].optionxform = str
        found[-1].read_string(text)
    return found


def may_restrict():
    programs = all(shutil.which(name) for name in ("unshare", "setpriv", "mount"))
    return programs and not subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False).returncode


def lay_code(cache, installed=ROOT / "src"):
    """Copy the machine code of this checkout into a user's cache, but for that of quantisation.

    To compile all takes half a minute. ``installed`` is the folder with the user's package.
    """
    for code in (ROOT / "src").rglob("*.nb[ic]"):
        if not code.name.startswith("quantisation."):
            module = installed / code.parents[1].relative_to(ROOT / "src") / "module.py"
            folder = cache / UserProvidedCacheLocator.get_suitable_cache_subpath(str(module))
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copy2(code, folder)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
@pytest.mark.parametrize("parser", units(), ids=["cloud", "robot"])
def test_systemd_understands_the_unit_and_calls_it_safe(parser, tmp_path):
    path = tmp_path / "fcslam.service"
    parser["Service"]["ExecStart"] = re.sub(r"^\S+", "/bin/true", parser["Service"]["ExecStart"])
    parser["Service"]["User"] = "daemon"
    with path.open("w") as file:
        parser.write(file, space_around_delimiters=False)
    said = subprocess.run(["systemd-analyze", "verify", path], capture_output=True, text=True, check=False)
    assert [line for line in said.stderr.splitlines() if path.name in line] == []
    parser["Service"]["User"] = "fcslam"
    with path.open("w") as file:
        parser.write(file, space_around_delimiters=False)
    rated = ["systemd-analyze", "security", "--offline=true", "--threshold=20", path]  # 2.0 of 10
    subprocess.run(rated, capture_output=True, check=True)


@pytest.mark.system
@pytest.mark.skipif(not may_restrict(), reason="needs root, unshare and setpriv, to make the file system read-only")
def test_the_service_of_the_unit_runs_under_its_restrictions(tmp_path):
    service = units()[0]["Service"]
    assert (service["ProtectSystem"], service["NoNewPrivileges"]) == ("strict", "yes")
    state, cache, etc = (tmp_path / name for name in ("state", "cache", "etc"))
    state.mkdir()
    cache.mkdir()
    lay_code(cache)
    assert main(["tools", "certificates", "--host", "localhost", "--viewer", "lab", "-o", str(etc)]) == 0
    port = free_port()
    places = {"/var/lib/fcslam": state, "/etc/fcslam": etc, "0.0.0.0": "127.0.0.1"}
    program, *arguments = shlex.split(service["ExecStart"])
    assert program.endswith("/fcslam")
    for before, after in places.items():
        assert any(before in argument for argument in arguments)
        arguments = [argument.replace(before, str(after)) for argument in arguments]
    name, _, value = service["Environment"].partition("=")
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), name: value.replace("/var/cache/fcslam", str(cache))}
    script = RESTRICTED.format(writable=shlex.join([str(state), str(cache)]))
    command = [sys.executable, "-m", "fcslam.cli", *arguments, "--port", str(port)]
    trusted = ssl.create_default_context(cafile=etc / "ca.pem")

    def ask(path, token="none"):
        asked = {"Authorization": f"Bearer {token}"}
        return httpx.get(f"https://localhost:{port}{path}", headers=asked, verify=trusted, timeout=10.0).status_code

    def is_ready():
        with contextlib.suppress(httpx.TransportError):
            return ask("/healthz") == 200
        assert process.poll() is None, process.stderr.read()
        return False

    with subprocess.Popen(
        ["unshare", "--mount", "--propagation", "private", "sh", "-c", script, "sh", *command],
        env=environment, cwd="/", stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            wait_for(is_ready, PATIENCE_S)
            token = (etc / "users" / "lab" / "token").read_text().strip()
            assert ask("/api/v1/fleet", token) == 200
            process.send_signal(signal.SIGHUP)  # ExecReload
            assert ask("/api/v1/fleet", token) == 200
        finally:
            process.send_signal(signal.SIGTERM)  # KillMode=mixed: the main process alone
            process.wait(float(service["TimeoutStopSec"]))
            err = process.stderr.read()
    assert process.returncode in (0, -signal.SIGTERM), err  # systemd counts both as a clean stop
    assert "Traceback" not in err
    assert (state / "missions" / "mission" / "mission.sqlite").is_file()
    assert any(cache.rglob("quantisation.*.nbi"))
