"""Check the Dockerfile where no container runtime is: run its steps in a fresh Debian root, then its command.

    python tools/dockerfile_in_root.py FOLDER [ARGUMENT ...]

Needs root, debootstrap, unshare and setpriv. FOLDER becomes the root; one with a Debian in it is used as it is. The
arguments go to the image's entry point. Certificates and name service are those of this machine.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
BASE = re.compile(r"debian:(\w+)-slim(@sha256:[0-9a-f]{64})?")


def steps(dockerfile: str) -> list[tuple[str, str]]:
    """Instructions with their arguments, comments and continued lines resolved."""
    text = re.sub(r"^#.*\n", "", dockerfile, flags=re.MULTILINE).replace("\\\n", " ")
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in text.splitlines() if line)]


def run_in(root: Path, command: list[str], user: str, environment: dict[str, str], folder: str) -> None:
    """Run a command in the root as a user."""
    inside = ["env", f"--chdir={folder}", *(f"{name}={value}" for name, value in environment.items()), *command]
    if user != "root":
        inside = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups", "--no-new-privs", *inside]
    passed = {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_", "http", "https"))}
    path = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/tmp"}
    mounted = 'mount -t tmpfs tmpfs "$1/dev/shm" && mount -t proc proc "$1/proc" && exec chroot "$@"'
    command = ["unshare", "--mount", "--propagation", "private", "sh", "-c", mounted, "sh", root, *inside]
    subprocess.run(command, check=True, env=path | passed)


def make_root(root: Path, image: str) -> None:
    """What FROM does."""
    found = BASE.fullmatch(image)
    if found is None:
        raise SystemExit(f"FROM {image}: this script knows Debian's slim images only")
    if not (root / "etc" / "debian_version").exists():
        subprocess.run(["debootstrap", "--variant=minbase", found[1], root], check=True)


def connect(root: Path) -> None:
    """Give the root this machine's name service and certificates, which a step may have replaced."""
    for file in ("/etc/resolv.conf", "/etc/hosts", "/etc/ssl/certs/ca-certificates.crt"):
        (root / file[1:]).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, root / file[1:])


def copy_to(folder: Path, sources: list[str]) -> None:
    """What COPY does: the content of folders, and files."""
    folder.mkdir(parents=True, exist_ok=True)
    for source in (REPOSITORY / name for name in sources):
        if source.is_dir():
            shutil.copytree(source, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder)


def main(root: Path, arguments: list[str]) -> None:
    """Build and run."""
    image = {"USER": "root", "WORKDIR": "/", "ENTRYPOINT": "[]", "CMD": "[]"}
    environment: dict[str, str] = {}
    for word, rest in steps((REPOSITORY / "Dockerfile").read_text(encoding="utf-8")):
        began = time.monotonic()
        match word:
            case "FROM":
                make_root(root, rest)
            case "RUN":
                connect(root)
                run_in(root, ["sh", "-c", rest], image["USER"], environment, image["WORKDIR"])
            case "COPY":
                *sources, target = rest.split()
                copy_to(root / target.strip("/"), sources)
            case "ENV":
                environment |= dict(pair.split("=", 1) for pair in rest.split())
            case _:
                image[word] = rest
        print(f"{time.monotonic() - began:6.1f} s  {word} {rest[:80]}", flush=True)
    size = subprocess.run(["du", "-smx", root], check=True, capture_output=True, text=True).stdout.split()[0]
    print(f"{size} MB", flush=True)
    command = json.loads(image["ENTRYPOINT"]) + (arguments or json.loads(image["CMD"]))
    run_in(root, command, image["USER"], environment, image["WORKDIR"])


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])
