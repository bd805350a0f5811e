"""The threat model, put to the test: each line of `docs/develop/security.md`, and what its tests find.

    python benchmarks/attacks.py

The script reads the tables of `docs/develop/security.md` and runs the tests that their lines name, then all other
tests with the marker `attack`. A try is one test with one set of parameters. It succeeds for the attacker
if the test fails. The script fails if an attack succeeds or if a line has no try, for example without Flower. All
servers listen on loopback.
"""

import re
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import common

PAGE = common.REPOSITORY / "docs" / "develop" / "security.md"
TEST = re.compile(r"`(test_\w+)`")
DEFINITION = re.compile(r"^def (test_\w+)\(", re.MULTILINE)
COLUMNS = {"line": "", "tests": "", "tries": "", "succeeded": "", "not run": ""}
SELECTED_NONE = 5
"""Exit code of pytest."""

Outcomes = dict[str, Counter[str]]
"""For each test, how many of its cases ended as what: passed, failed or skipped."""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--processes", type=int, default=1, help="in which tests run")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    tables = lines_of(PAGE.read_text(encoding="utf-8"))
    named = node_ids({name for lines in tables.values() for _, names in lines for name in names})
    outcomes = run_tests(named, chosen.processes)
    unnamed = run_tests(["tests", "-m", "attack", *(f"--deselect={test}" for test in named)], chosen.processes)
    tables["Other attacks"] = [
        (name.removeprefix("test_").replace("_", " "), [name]) for name in sorted(unnamed) if name.startswith("test_")
    ]  # a module that is skipped as a whole has its own name
    rows = []
    for title, lines in tables.items():
        table = [row(line, names, outcomes | unnamed) for line, names in lines]
        report.table(title, COLUMNS, table)
        rows += table
    report.say(f"Attacks that succeeded: {sum(row[3] for row in rows)} of {sum(row[2] for row in rows)} tries.")
    report.write()
    if any(row[3] or not row[2] for row in rows):
        sys.exit("attacks: one succeeded, or a line has no try")


def lines_of(page: str) -> dict[str, list[tuple[str, list[str]]]]:
    """The lines of each table that name tests, by the heading above: their other cells, and the names."""
    tables: dict[str, list[tuple[str, list[str]]]] = defaultdict(list)
    heading = ""
    for line in page.splitlines():
        if line.startswith("## "):
            heading = line.removeprefix("## ")
        elif line.startswith("|") and (names := TEST.findall(line)):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            tables[heading].append((": ".join(cells[:-1]), names))
    return tables


def node_ids(names: set[str]) -> list[str]:
    """The tests of these names, as pytest calls them."""
    files = sorted((common.REPOSITORY / "tests").rglob("test_*.py"))
    found = [(file, name) for file in files for name in DEFINITION.findall(file.read_text(encoding="utf-8"))]
    return [f"{file.relative_to(common.REPOSITORY)}::{name}" for file, name in found if name in names]


def run_tests(selection: list[str], processes: int) -> Outcomes:
    """Run them with pytest and count how their cases end."""
    outcomes: Outcomes = defaultdict(Counter)
    with tempfile.TemporaryDirectory() as place:
        results = Path(place) / "results.xml"
        command = [sys.executable, "-m", "pytest", "-q", "-n", str(processes), f"--junit-xml={results}", *selection]
        ended = subprocess.run(command, cwd=common.REPOSITORY, capture_output=True, text=True, check=False)
        if ended.returncode not in (0, 1, SELECTED_NONE):
            sys.exit(f"pytest failed:\n{ended.stdout[-3000:]}{ended.stderr[-3000:]}")
        for case in ElementTree.parse(results).iter("testcase"):
            outcomes[case.attrib["name"].partition("[")[0]][outcome(case)] += 1
        if ended.returncode == 1:
            print(ended.stdout[-3000:], file=sys.stderr)
    return outcomes


def outcome(case: ElementTree.Element) -> str:
    """How a case of pytest's report ended."""
    kinds = {child.tag for child in case}
    if kinds & {"failure", "error"}:
        return "failed"
    return "skipped" if "skipped" in kinds else "passed"


def row(line: str, names: list[str], outcomes: Outcomes) -> tuple[Any, ...]:
    """A line of the report."""
    ended = sum((outcomes.get(name, Counter()) for name in names), Counter())
    return line, len(names), ended["passed"] + ended["failed"], ended["failed"], ended["skipped"]


if __name__ == "__main__":
    main()
