"""The package as a user installs it: a wheel in a read-only folder, used by an unprivileged process elsewhere."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import fcslam
from fcslam.cli import EXTRAS
from tests.service.test_unit import lay_code
from tools.dockerfile_in_root import steps

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOGS = ROOT / "examples" / "logs"
# Root may write everywhere; without its capabilities it is a user like any other.
UNPRIVILEGED = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--no-new-privs"] if os.geteuid() == 0 else []

needs_setpriv = pytest.mark.skipif(
    bool(UNPRIVILEGED) and shutil.which("setpriv") is None, reason="needs setpriv, to drop root's capabilities"
)


def run(*command, cwd, **environment):
    path = {"PATH": os.environ["PATH"]}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=path | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Folder with the package of the wheel, which nobody can write."""
    pytest.importorskip("setuptools", reason="needs setuptools, to build the wheel without a network")
    made = tmp_path_factory.mktemp("wheel")
    source = made / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    pip = (sys.executable, "-m", "pip", "-q", "--disable-pip-version-check")
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", made, source, cwd=made)
    folder = made / "site"
    run(*pip, "install", "--no-deps", "--target", folder, *made.glob("*.whl"), cwd=made)
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    for path in folders:
        path.chmod(0o555)
    yield folder
    for path in folders:
        path.chmod(0o755)


def test_the_wheel_holds_every_file_of_the_package(installed):
    package = Path(fcslam.__file__).parent
    ours = {
        path.relative_to(package)
        for path in package.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix not in (".nbi", ".nbc", ".lock")
    }
    assert ours <= {path.relative_to(installed / "fcslam") for path in (installed / "fcslam").rglob("*")}


@pytest.mark.system
@needs_setpriv
def test_an_unprivileged_user_maps_with_a_read_only_installation(installed, tmp_path):
    user = {"PYTHONPATH": str(installed), "HOME": str(tmp_path / "home"), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    asked = "import os, fcslam; print(fcslam.__file__, os.access(os.path.dirname(fcslam.__file__), os.W_OK))"
    said = run(*UNPRIVILEGED, sys.executable, "-c", asked, cwd=tmp_path, **user)
    assert said.split() == [str(installed / "fcslam" / "__init__.py"), "False"]
    for source in (ROOT / "src" / "fcslam").rglob("*.py"):  # numba knows a source by its time and size
        shutil.copystat(source, installed / source.relative_to(ROOT / "src"))
    lay_code(tmp_path / "cache", installed)
    fcslam_command = [*UNPRIVILEGED, sys.executable, "-m", "fcslam.cli"]
    run(*fcslam_command, "map", LOGS / "anna.clf.xz", "-o", "run", cwd=tmp_path, **user)
    assert set(fcslam.open_run(tmp_path / "run").trajectories) == {"anna"}
    assert any((tmp_path / "cache").rglob("quantisation.*.nbi"))


def test_every_extra_is_named_where_it_is_needed():
    extras = PROJECT["optional-dependencies"].keys() - {"dev", "docs"}
    hints = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "src").rglob("*.py"))
    named = re.findall(r'extra(?:: str = |=)"(\w+)"', hints) + re.findall(r"fcslam\[(\w+)\]", hints)
    assert extras == set(named) - {"forbid", "ignore"}  # words of pydantic
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md"))
    shown = re.findall(r"pip install (?:-e )?['\"]?(?:\.|fcslam)\[([\w,]+)\]", pages)
    assert {extra for extras_of_one in shown for extra in extras_of_one.split(",")} == extras


def test_make_takes_any_supported_python(tmp_path):
    supported = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert supported == ["3.11", "3.12", "3.13"]
    (tmp_path / "python3.11").write_text("#!/bin/sh\nexit 127\n")  # a shim of pyenv for a Python that is not chosen
    for version in supported[1:]:
        (tmp_path / f"python{version}").write_text("#!/bin/sh\nexit 0\n")
    for program in tmp_path.iterdir():
        program.chmod(0o755)
    for name in ("make", "sh"):
        program = shutil.which(name)
        if program is None:
            pytest.skip(f"needs {name}")
        (tmp_path / name).symlink_to(program)
    for left in (*supported[1:], None):
        said = subprocess.run(
            ["make", "-f", ROOT / "Makefile", "-f", "-", "asked"], input="$(info $(PYTHON))\nasked: ;", text=True,
            capture_output=True, check=True, env={"PATH": str(tmp_path)}, cwd=tmp_path,
        ).stdout  # fmt: skip
        assert said.startswith(f"python{left}" if left else "no-python")
        if left:
            (tmp_path / f"python{left}").unlink()


def test_the_dockerfile_copies_files_that_are_there_and_not_ignored():
    found = steps((ROOT / "Dockerfile").read_text(encoding="utf-8"))
    copied = {name for word, rest in found if word == "COPY" for name in rest.split()[:-1]}
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines() if line[0] == "!"}
    assert copied == kept
    assert all((ROOT / name).exists() for name in copied)
    assert [rest for word, rest in found if word in ("USER", "ENTRYPOINT")] == ["fcslam", '["fcslam"]']


BLOCKER = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {packages!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
"""


@pytest.fixture
def core(tmp_path):
    """The command as with `pip install .`: this process and its children lack the packages of all extras."""
    packages = {*EXTRAS, "onnxruntime", "torch", "onnx", "flwr", "mujoco", "ezdxf", "pyproj"}
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(BLOCKER.format(packages=packages))
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path / 'site'}{os.pathsep}{ROOT / 'src'}"}

    def fcslam_(*words):
        command = [sys.executable, "-m", "fcslam.cli", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)

    return fcslam_


def test_a_lidar_is_mapped_without_any_extra(core, tmp_path):
    done = core("map", LOGS / "anna.clf.xz", "-o", tmp_path / "run", "-q")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "run" / "map.png").stat().st_size > 1000


def test_a_missing_extra_is_named_in_one_line(core, tmp_path):
    cv2.imwrite(str(tmp_path / "image.png"), np.random.default_rng(1).integers(0, 255, (96, 96), np.uint8))
    served, shown, described = (
        core("serve", "--data", tmp_path / "data"),
        core("show", tmp_path / "run", "--html", tmp_path / "run.html"),
        core("tools", "extract", tmp_path, "-o", "x"),
    )
    assert [served.returncode, shown.returncode, described.returncode] == [2, 2, 2]
    for done in (served, shown):
        assert re.fullmatch(r"fcslam: this needs \w+; install it: pip install 'fcslam\[service\]'\n", done.stderr)
    assert re.fullmatch(
        r"fcslam: describing camera images needs ONNX Runtime; install it: pip install 'fcslam\[camera\]'.*\n",
        described.stderr,
    )
