"""Which processes verify closures: every choice gives the same, and a choice that cannot be is refused in one line."""

import subprocess
import sys

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature

from fcslam.cli import main
from fcslam.cluster.verifying import check_workers, verifying
from fcslam.errors import InputError


@pytest.mark.parametrize(
    "where",
    [
        "",
        "0",
        "-1",
        "2.5",
        "257",
        "scheduler:8786",
        "tcp://scheduler",
        "http://scheduler:1",
        "ucx://a:1",
        "tcp://a:1 x",
    ],
)
def test_a_choice_that_is_none_is_refused(where):
    with pytest.raises(InputError, match=r"--workers: '.*' is neither a number from 1 to 256 nor the address"):
        check_workers(where)


def test_without_dask_a_cluster_is_refused_and_the_rest_works(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(InputError, match=r"tcp://h:1: needs Dask; install it: pip install 'fcslam\[distributed\]'"),
        verifying("tcp://h:1"),
    ):
        pass


def test_processes_here_do_not_load_dask():
    code = (
        "import sys; from fcslam.cluster.verifying import verifying\n"
        "if __name__ == '__main__':\n"
        "    with verifying('2'): pass\n"
        "    print(sorted({'dask', 'distributed'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout == "[]\n"


def test_the_authority_of_a_cluster_signs_no_robots_certificate(tmp_path):
    assert main(["tools", "certificates", "--output", str(tmp_path), "--robot", "anna", "--cluster"]) == 0
    authority = x509.load_pem_x509_certificate((tmp_path / "cluster" / "ca.pem").read_bytes())
    member = x509.load_pem_x509_certificate((tmp_path / "cluster" / "member.pem").read_bytes())
    member.verify_directly_issued_by(authority)
    for name in ("robots/anna/client.pem", "cloud.pem"):
        other = x509.load_pem_x509_certificate((tmp_path / name).read_bytes())
        with pytest.raises(InvalidSignature):
            other.verify_directly_issued_by(authority)
    assert (tmp_path / "cluster" / "member.key").stat().st_mode & 0o077 == 0
