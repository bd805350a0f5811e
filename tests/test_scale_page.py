"""The page on several instances: its commands run as they stand there, in one shell."""

import os
import re
import signal
import stat
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest

from tests.cluster.clusters import needs_dask
from tests.postgres import HAS_POSTGRES, OWNER, PROGRAMS, WHY_NOT
from tests.test_docs import ROOT

PAGE = ROOT / "docs" / "howto" / "scale.md"
NOT_HERE = ("pip install",)
"""Commands that change this environment."""
SHIM = """#!/bin/sh
# PostgreSQL refuses to run as root; its other user gets the folder.
case "$(basename "$0")" in initdb) chown {owner} . password ;; esac
touch store.log && chown {owner} store.log
exec runuser -u {owner} -- {program} "$@"
"""


def commands() -> list[str]:
    """The lines of code of the first section."""
    section = PAGE.read_text(encoding="utf-8").partition("## Try it")[2].partition("\n## ")[0]
    lines = re.findall(r"^    (\S.*)$", section, re.MULTILINE)
    return [line for line in lines if not line.startswith(NOT_HERE)]


@pytest.fixture
def folder():
    with tempfile.TemporaryDirectory(prefix="fcslam-scale-") as place:
        yield Path(place)


@pytest.mark.system
@pytest.mark.slow
@needs_dask
@pytest.mark.skipif(not HAS_POSTGRES, reason=WHY_NOT)
def test_the_commands_of_the_page_start_three_instances_that_survive_a_kill(folder):
    folder.chmod(0o755)  # the database's user must reach its folder
    programs = folder / "bin"
    programs.mkdir()
    for name in ("fcslam", "dask"):
        module = "fcslam.cli" if name == "fcslam" else "dask.__main__"
        shim = programs / name
        shim.write_text(
            f"#!/bin/sh\nexec {sys.executable} -c 'from {module} import main; raise SystemExit(main())' \"$@\"\n"
        )
    for name in ("initdb", "pg_ctl", "createdb"):
        program = f"{PROGRAMS}/{name}"
        text = SHIM.format(owner=OWNER, program=program) if os.getuid() == 0 else f'#!/bin/sh\nexec {program} "$@"\n'
        (programs / name).write_text(text)
    for shim in programs.iterdir():
        shim.chmod(shim.stat().st_mode | stat.S_IXUSR)
    (folder / "examples").symlink_to(ROOT / "examples")
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    script = "set -e\n" + "\n".join(commands())
    log = folder / "shell.log"
    with log.open("wb") as output:  # a pipe would stay open as long as Dask, which the page leaves running
        shell = subprocess.Popen(
            ["bash", "-c", script], cwd=folder, env=environment, stdout=output, stderr=output, start_new_session=True
        )
    try:
        shell.wait(900.0)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(shell.pid, signal.SIGTERM)
        told = log.read_text(encoding="utf-8")
    assert shell.returncode == 0, told
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")
    assert told.count("has confirmed all packets") == 3
