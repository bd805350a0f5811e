"""schemathesis against the service and its own OpenAPI: whatever it is asked, it answers as described."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.service.http.missions import FILE
from fcslam.service.http.robots import NETWORK
from fcslam.wire.batches import MEDIA_TYPE
from tests.service.http.desk import ENTRIES, SCRIPT, A, B, Desk

HERE = Path(__file__).parent
AS_BOSS = ["--header", "Authorization: Bearer token of boss", "--exclude-tag", "robots"]
AS_ROBOT = ["--header", "Authorization: Bearer token of a", "--include-tag", "robots", "--include-tag", "operations"]
ITSELF = '[parameters]\n"path.robot" = "a"\n'
"""An addition to the configuration: a robot's token is valid for that robot alone."""


@pytest.mark.system
@pytest.mark.parametrize(("options", "more"), [(AS_BOSS, ""), (AS_ROBOT, ITSELF)], ids=["admin", "robot"])
def test_the_service_answers_as_it_is_described(tmp_path, scripted, options, more):
    scripted(SCRIPT)
    (bodies := tmp_path / "bodies").mkdir()
    with Desk(tmp_path / "data", ENTRIES) as desk:
        for robot, data in (("a", A), ("b", B)):
            desk.told(desk.send(robot, data))
        exported = desk.ask("GET", "/api/v1/missions/mission/export", "boss").content
        for media_type, body in ((MEDIA_TYPE, b""), (NETWORK, BUNDLED_NETWORK.read_bytes()), (FILE, exported)):
            (bodies / media_type.removeprefix("application/")).write_bytes(body)
        url = f"{desk.client.base_url}/openapi.json"
        (config := tmp_path / "schemathesis.toml").write_text((HERE / "schemathesis.toml").read_text() + more)
        command = [sys.executable, "-m", "schemathesis.cli", "--config-file", str(config), "run", url]
        done = subprocess.run(
            [*command, *options], capture_output=True, text=True, check=False, cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(HERE.parents[2]), "BODIES": str(bodies)},
        )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "passed" in done.stdout
