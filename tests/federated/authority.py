"""Certificates and keys of a fleet, made as docs/howto/federated.md says."""

import shutil
import socket
import subprocess

import pytest

EXTENSIONS = """subjectAltName=DNS:localhost,IP:127.0.0.1
extendedKeyUsage=serverAuth
keyUsage=critical,digitalSignature,keyEncipherment
basicConstraints=CA:FALSE
authorityKeyIdentifier=keyid
"""


def certificates(folder):
    """`ca.crt`, and `own.crt` with `own.key` for this machine."""

    def run(*words):
        subprocess.run(("openssl", *words), cwd=folder, check=True, capture_output=True)

    if shutil.which("openssl") is None:
        pytest.skip("needs the command openssl")
    folder.mkdir()
    run("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=test", "-keyout", "ca.key", "-out",
        "ca.crt", "-addext", "basicConstraints=critical,CA:TRUE", "-addext",
        "keyUsage=critical,keyCertSign,cRLSign")  # fmt: skip
    run("req", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=localhost", "-keyout", "own.key", "-out", "own.csr")
    (folder / "extensions").write_text(EXTENSIONS)
    run("x509", "-req", "-in", "own.csr", "-CA", "ca.crt", "-CAkey", "ca.key", "-CAcreateserial", "-days", "2",
        "-extfile", "extensions", "-out", "own.crt")  # fmt: skip
    return folder


def keys(folder, *robots):
    """A pair of keys for each robot."""
    for robot in robots:
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ecdsa", "-b", "384", "-N", "", "-f", robot],
            cwd=folder, check=True, capture_output=True,
        )  # fmt: skip


def free_port():
    """A port of this machine on which no process listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
