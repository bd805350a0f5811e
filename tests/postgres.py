"""A PostgreSQL server of the tests' own: made for them, on this machine only, and gone with them."""

import os
import shutil
import socket
import subprocess
from importlib.util import find_spec
from pathlib import Path

PROGRAMS = max(Path("/usr/lib/postgresql").glob("*/bin"), default=None, key=lambda path: int(path.parent.name))
HAS_POSTGRES = PROGRAMS is not None and find_spec("psycopg") is not None
WHY_NOT = "PostgreSQL or psycopg is not installed: make scale-test"
PASSWORD = "only-for-tests"
OWNER = "postgres"
"""The user of the server where the tests run as root, which PostgreSQL refuses."""


def free_port() -> int:
    """A port on which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port: int = listening.getsockname()[1]
        return port


class Server:
    """A server that can be stopped, killed and started."""

    def __init__(self, folder: Path) -> None:
        """Make an empty server in ``folder``, with the role fcslam, and start it."""
        self._folder, self.port = folder, free_port()
        folder.mkdir(exist_ok=True)
        secret = folder / "secret"
        secret.write_text(PASSWORD, encoding="utf-8")
        for path in (folder, secret):
            if os.getuid() == 0:
                shutil.chown(path, OWNER)
        data = str(folder / "data")
        self._run("initdb", "-D", data, "-U", "fcslam", "--pwfile", str(secret), "--auth=scram-sha-256", "--no-sync")
        self.start()

    @property
    def url(self) -> str:
        """Of a database in which the role may do everything."""
        return f"postgresql://fcslam:{PASSWORD}@127.0.0.1:{self.port}/postgres"

    def start(self) -> None:
        """Start the server and wait until it answers."""
        options = f"-F -p {self.port} -k {self._folder} -h 127.0.0.1"
        self._run("pg_ctl", "-D", f"{self._folder}/data", "-o", options, "-l", f"{self._folder}/log", "-w", "start")

    def stop(self, how: str = "immediate") -> None:
        """Stop the server; ``immediate`` is what a kill does."""
        self._run("pg_ctl", "-D", f"{self._folder}/data", "-m", how, "-w", "stop")

    def _run(self, program: str, *arguments: str) -> None:
        as_owner = ("runuser", "-u", OWNER, "--") if os.getuid() == 0 else ()
        done = subprocess.run(
            [*as_owner, f"{PROGRAMS}/{program}", *arguments], cwd="/", check=False, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert not done.returncode, done.stderr
