"""Compiled functions work with a folder for their machine code and without one."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

WITHOUT_FOLDER = """
import numpy as np
from fcslam import compiled
compiled._CachedCode._locator_classes = []  # as where nothing can be written
from fcslam.cli.warm_up import report_uncached
from fcslam.cli.output import notices
from fcslam.features.codes import hamming
from fcslam.warmup import is_cold
assert hamming(*np.zeros((2, 4), np.uint64)) == 0
assert is_cold()
assert report_uncached(notices(False))
"""


def run(script, *arguments, **environment):
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        env={**os.environ, **environment}, capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_without_a_folder_every_process_compiles_and_says_so():
    done = run(WITHOUT_FOLDER)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert "NUMBA_CACHE_DIR" in line


def test_a_cache_folder_that_cannot_be_made_does_no_harm(tmp_path):
    (tmp_path / "file").touch()
    script = "from fcslam.compiled import njit\nprint(njit(lambda x: x + 1)(1))"
    done = run(script, NUMBA_CACHE_DIR=str(tmp_path / "file" / "cache"))
    assert (done.stdout, done.returncode) == ("2\n", 0), done.stderr


def test_code_of_an_installed_package_is_in_the_cache_folder_of_the_user_so_pip_removes_all_of_the_package(tmp_path):
    package = tmp_path / "site-packages"
    package.mkdir()
    (package / "module.py").write_text(MODULE)
    script = f"import sys; sys.path.insert(0, {str(package)!r})\nimport module\nprint(module.f(1))"
    home = {"XDG_CACHE_HOME": str(tmp_path / "cache"), "NUMBA_CACHE_DIR": "", "PYTHONDONTWRITEBYTECODE": "1"}
    done = run(script, **home)
    assert (done.stdout, done.returncode) == ("2\n", 0), done.stderr
    assert [path.name for path in package.rglob("*")] == ["module.py"]
    assert any((tmp_path / "cache").rglob("*.nbi"))


MODULE = "from fcslam.compiled import is_compiled, njit\n@njit\ndef f(x):\n    return x + 1\n"


def test_a_cache_folder_that_fails_later_does_no_harm(tmp_path):
    (tmp_path / "module.py").write_text(MODULE)
    script = (
        f"import os, shutil, sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import module\n"
        "cache = os.environ['NUMBA_CACHE_DIR']\n"
        "shutil.rmtree(cache); open(cache, 'w').close()\n"
        "print(module.f(1), module.is_compiled(module.f))"
    )
    done = run(script, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert (done.stdout, done.returncode) == ("2 False\n", 0), done.stderr


def test_the_cache_holds_what_was_compiled(tmp_path):
    (tmp_path / "module.py").write_text(MODULE)
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from module import f, is_compiled\n"
        "print(is_compiled(f), f(1), is_compiled(f), sum(f.stats.cache_hits.values()))"
    )
    outputs = [run(script, NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout for _ in range(2)]
    assert outputs == ["False 2 True 0\n", "True 2 True 1\n"]


def test_the_runtime_of_numba_is_loaded_as_other_code_is(tmp_path):
    (tmp_path / "module.py").write_text(
        MODULE.replace("return x + 1", "return np.full(3, x)[1:]") + "import numpy as np\n"
    )
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from numba.core.runtime import nrtdynmod\n"
        "made, make = [], nrtdynmod.create_nrt_module\n"
        "nrtdynmod.create_nrt_module = lambda context: made.append(1) or make(context)\n"
        "from module import f\n"
        "print(*f(2), len(made))"
    )
    outputs = [run(script, NUMBA_CACHE_DIR=str(tmp_path / "cache")).stdout for _ in range(2)]
    assert outputs == ["2 2 1\n", "2 2 0\n"]
