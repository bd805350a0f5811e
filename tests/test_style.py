"""Modules and functions stay small enough to be read in one sitting."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "fcslam"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if not path.stem.endswith("_pb2"))
MODULE_LINES, FUNCTION_LINES = 400, 60


def too_long(source: str) -> list[str]:
    lengths = [("module", source.count("\n"), MODULE_LINES)]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lengths.append((node.name, (node.end_lineno or node.lineno) - node.lineno + 1, FUNCTION_LINES))
    return [f"{name}: {lines} lines, at most {limit}" for name, lines, limit in lengths if lines > limit]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_modules_and_functions_are_short(path):
    assert too_long(path.read_text(encoding="utf-8")) == []


def test_no_two_test_modules_have_one_name():
    """pytest imports them by their names alone, so it would collect only one."""
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


def test_the_rule_itself():
    assert too_long("def f():\n" + "    x = 1\n" * 59) == []
    assert too_long("def f():\n" + "    x = 1\n" * 60) == ["f: 61 lines, at most 60"]
    assert too_long("x = 1\n" * 401) == ["module: 401 lines, at most 400"]
