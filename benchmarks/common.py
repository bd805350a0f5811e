"""What every benchmark shares: the recordings' folder, the real command with its cost, and the report that is written.

No benchmark itself. Peak memory counts what the parent held when it started the command, so scripts that measure the
command import nothing heavy before it.
"""

import argparse
import csv
import json
import math
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import fcslam

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = Path(__file__).resolve().parent / "results"

SPLITS = {"intel": 3, "fr079": 3, "mit-csail": 2}
"""Logs of the SLAM benchmark and into how many robots each is cut."""

TABLE_ROWS, PAGE_ROWS = 12, 40
"""Most rows of a table on the page of a report, and of all its tables there."""

_COMMAND = "import sys; from fcslam.cli import main; sys.exit(main(sys.argv[1:]))"
_PACKAGES = ("numpy", "numba", "scipy", "opencv-python-headless", "onnxruntime")


def recordings(*needed: str, kind: str = "lidar") -> Path:
    """The folder ``$FCSLAM_DATA/lidar``, or of another kind; without FCSLAM_DATA the script ends and succeeds.

    ``needed``: paths below it that must be there, or the script fails with one line.
    """
    place = os.environ.get("FCSLAM_DATA")
    if not place:
        print("skipped: needs recordings; set FCSLAM_DATA to their folder")
        sys.exit(0)
    folder = Path(place) / kind
    missing = [name for name in needed if not (folder / name).exists()]
    if missing:
        sys.exit(f"{folder}: {', '.join(missing)} missing")
    return folder


def log_path(folder: Path, name: str) -> Path:
    """A log of the SLAM benchmark."""
    return folder / "slam-benchmark" / f"{name}.clf.xz"


def relations_path(folder: Path, name: str) -> Path:
    """Its reference relations."""
    return folder / "slam-benchmark" / f"{name}.relations.gz"


def slam_benchmark_files() -> list[str]:
    """What ``recordings`` is asked for by those who use these logs."""
    return [f"slam-benchmark/{name}.{kind}" for name in SPLITS for kind in ("clf.xz", "relations.gz")]


@dataclass(frozen=True, slots=True)
class Cost:
    """What a command took, its own children included."""

    cpu_s: float
    """User and system."""
    wall_s: float
    peak_mb: float
    """Largest resident set."""


def run_fcslam(*arguments: object, environment: Mapping[str, str] | None = None) -> Cost:
    """Run ``fcslam`` with ``arguments`` in a fresh process and measure it; its own failure ends the script."""
    package = str(Path(fcslam.__file__).parents[1])
    # As of most users, who do not keep Python from caching its modules.
    process_environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "", "PYTHONPATH": package, **(environment or {})}
    command = [sys.executable, "-c", _COMMAND, *map(str, arguments)]
    with tempfile.TemporaryFile() as output:
        began = time.perf_counter()
        process = subprocess.Popen(
            command, env=process_environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output
        )
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            output.seek(0)
            sys.exit(f"fcslam {' '.join(command[3:])} failed:\n{output.read().decode(errors='replace')}")
    return Cost(usage.ru_utime + usage.ru_stime, wall_s, usage.ru_maxrss * 1024 / 1e6)


def run_fcslam_cold(*arguments: object) -> Cost:
    """As ``run_fcslam``, with an empty cache of compiled code: the first run after installing."""
    with tempfile.TemporaryDirectory() as cache:
        return run_fcslam(*arguments, environment={"NUMBA_CACHE_DIR": cache})


def simulated(folder: Path, *arguments: object) -> Path:
    """A fleet that `fcslam tools simulate` records into ``folder``; one that is there already is taken as it is."""
    # The true map is written last.
    if not (folder / "ground_truth" / "map.yaml").exists():
        shutil.rmtree(folder, ignore_errors=True)
        run_fcslam("tools", "simulate", *arguments, "--output", folder)
    return folder


def metrics(run: Path) -> dict[str, float]:
    """metrics.json of a run folder, by name."""
    rows = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    return {row["name"]: math.nan if row["value"] is None else row["value"] for row in rows}


def options(docstring: str) -> argparse.ArgumentParser:
    """The options that every benchmark has; a script adds its own."""
    parser = argparse.ArgumentParser(description=docstring, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--date", default=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"), help="date in the report")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the report")
    return parser


class Report:
    """Tables: all of them as CSV, one below the other, and a short page in Markdown with the small ones."""

    def __init__(self, script: str, docstring: str, chosen: argparse.Namespace) -> None:
        self._name = Path(script).stem
        self._summary = " ".join(docstring.strip().split("\n\n")[0].split())
        self._folder: Path = chosen.results
        self._setting = {
            "date": chosen.date,
            "command": " ".join([f"python benchmarks/{Path(sys.argv[0]).name}", *map(_without_folders, sys.argv[1:])]),
        }
        self._setting |= machine()
        self._parts: list[str] = []
        self._tables: dict[str, list[list[Any]]] = {}
        self._shown_rows = 0

    def say(self, text: str) -> None:
        """A paragraph."""
        self._parts.append(text.strip())

    def table(self, title: str, columns: Mapping[str, str], rows: Iterable[Sequence[Any]]) -> None:
        """A table; ``columns`` maps headings to format specifications. One of many rows is in the CSV file alone."""
        kept = [dict(zip(columns, row, strict=True)) for row in rows]
        self._tables[title] = [list(columns), *([_exact(value) for value in row.values()] for row in kept)]
        if len(kept) > min(TABLE_ROWS, PAGE_ROWS - self._shown_rows):
            return
        self._shown_rows += len(kept)
        lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
        for row in kept:
            lines.append(f"| {' | '.join(_cell(row[heading], spec) for heading, spec in columns.items())} |")
        self._parts.append("\n".join([f"## {title}", "", *lines]))

    def picture(self, title: str, figure: Any) -> None:
        """A Matplotlib figure, written beside the report as a PNG of its name."""
        self._folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(self._folder / f"{self._name}.png", dpi=120, bbox_inches="tight", metadata={"Software": None})
        self._parts.append(f"![{title}]({self._name}.png)")

    def write(self) -> None:
        """Write both files and print the page."""
        setting = "\n".join(f"- {key}: {value}" for key, value in self._setting.items())
        links = f"[How it is measured](../{self._name}.py), [all figures]({self._name}.csv)."
        text = "\n\n".join([f"# {self._name}", f"{self._summary}\n{links}", setting, *self._parts]) + "\n"
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / f"{self._name}.md").write_text(text, encoding="utf-8")
        with (self._folder / f"{self._name}.csv").open("w", encoding="utf-8", newline="") as file:
            for number, (title, rows) in enumerate(self._tables.items()):
                file.write(f"\n# {title}\n" if number else f"# {title}\n")
                csv.writer(file, lineterminator="\n").writerows(rows)
        print(text)


def _without_folders(argument: str) -> str:
    """An argument as a reader may repeat it: absolute paths name folders of one machine."""
    return f"/path/to/{Path(argument).name}" if argument.startswith("/") else argument


def figures(path: Path, title: str) -> list[dict[str, str]]:
    """The rows of a table in the CSV file of a report."""
    tables = (table.partition("\n") for table in path.read_text(encoding="utf-8").split("\n\n"))
    return next(list(csv.DictReader(rows.splitlines())) for head, _, rows in tables if head == f"# {title}")


class Kept:
    """Rows of a long benchmark in a file, so that an interrupted run goes on; rows of another commit do not count."""

    def __init__(self, path: Path | None) -> None:
        """``path``: a file of JSON lines; None keeps nothing."""
        self._path = path
        self._lock = threading.Lock()
        lines = path.read_text(encoding="utf-8").splitlines() if path is not None and path.exists() else []
        found = [json.loads(line) for line in lines]
        self._rows = {tuple(entry["key"]): entry["rows"] for entry in found if entry["commit"] == commit()}

    def rows(self, key: tuple, compute: Callable[[], Iterable[tuple]]) -> list[tuple]:
        """The rows of ``key``: kept, or computed and kept now."""
        if key not in self._rows:
            self._rows[key] = list(compute())
            if self._path is not None:
                entry = {"commit": commit(), "key": key, "rows": self._rows[key]}
                with self._lock, self._path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(entry) + "\n")
        return [tuple(row) for row in self._rows[key]]


def machine() -> dict[str, str]:
    """Where and with what a result was measured."""
    packages = [f"{name} {_version(name)}" for name in _PACKAGES]
    busy = ", ".join(f"{load:.2f}" for load in os.getloadavg())
    return {
        "machine": f"{_cpu_model()}, {os.cpu_count()} cores, load average {busy} before",
        "versions": ", ".join(
            [f"fcslam {fcslam.__version__} ({commit()})", f"python {platform.python_version()}", *packages]
        ),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def commit() -> str:
    """The commit of the code, with `-dirty` if files differ from it."""
    command = ["git", "-C", str(REPOSITORY), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "no repository"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _plain(value: Any) -> Any:
    """A number of Python; None for NaN."""
    plain = value.item() if hasattr(value, "item") else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


def _exact(value: Any) -> Any:
    plain = _plain(value)
    return format(plain, ".9g") if isinstance(plain, float) else plain


def _cell(value: Any, spec: str) -> str:
    plain = _plain(value)
    return "-" if plain is None else format(plain, spec)
