"""Every command that the documentation shows runs here, or tests/commands_of_docs.yaml gives the reason why not."""

import datetime
import gzip
import json
import os
import re
import shlex
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from glob import glob
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import httpx
import pytest
import yaml

from fcslam import open_run
from fcslam.cli import main
from fcslam.geometry import se2
from fcslam.sources import open_source
from tests.carmen_logs import write_carmen
from tests.lab.simulation.gl import require_gl
from tests.postgres import free_port
from tests.sources.test_bag_robots import fleet_bag
from tests.test_docs import PAGES, ROOT, command_lines
from tests.waiting import wait_for

LISTED: dict[str, Any] = yaml.safe_load((ROOT / "tests" / "commands_of_docs.yaml").read_text(encoding="utf-8"))
EXECUTED: dict[str, list[str]] = LISTED["executed"]
BESIDE_A_SERVICE: dict[str, list[str]] = LISTED["beside a service"]
OTHER_PROGRAMS: dict[str, str] = LISTED["other programs"]
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
PAGES_WITH_COMMANDS = [page for page in PAGES if page.name not in {"CHANGELOG.md", "CONTRIBUTING.md", "commands.md"}]

ANNA, BEN, CLEO, LONG, MEETS = "anna.clf", "ben.clf", "cleo.clf", "long.clf", "meets.clf"
SCANS = {ANNA: 45, BEN: 24, CLEO: 45, LONG: 100, MEETS: 100}
"""Of a sample log that the commands get. ``BEN`` ends before its map joins, which takes longest."""
OF = {LONG: ANNA, MEETS: BEN}
"""Sample logs of other names. The long one has relations over 20 s."""
LOGS = {
    "robot1.clf.gz": ANNA, "robot1.clf": ANNA, "monday.clf.gz": ANNA, "monday.clf.xz": ANNA,
    "building.clf.gz": LONG, "lift.clf.gz": LONG,
    "robot2.log": BEN, "robot2.clf": BEN, "tuesday.clf.gz": BEN, "tuesday.clf.xz": MEETS,
    "robot3.log": CLEO, "today.clf.gz": CLEO, "today.clf.xz": CLEO,
    "examples/logs/anna.clf.xz": ANNA, "examples/logs/ben.clf.xz": BEN, "examples/logs/cleo.clf.xz": CLEO,
}  # fmt: skip
"""Names that the pages use, and the sample log whose beginning stands for each."""
BAGS = {
    "run1.bag": ANNA, "monday/run.bag": ANNA, "robot2.mcap": BEN, "run2.bag": BEN, "tuesday/run.bag": BEN,
    "robot2.bag": BEN, "day.mcap": CLEO, "today.bag": CLEO,
}  # fmt: skip
NEXT_YEAR = f"{datetime.datetime.now(datetime.UTC).year + 1}-01-31"
SUBSTITUTES = {"/etc/fcslam/": "credentials/", "2027-01-31": NEXT_YEAR, "--speed 4": "--speed 100"}
"""Parts of commands that are those of the reader's machine or take long, and what stands for them here."""
PATIENCE_S = 300.0


def shown() -> set[str]:
    """Every command of fcslam on a line of its own in the README and docs/."""
    lines = (line for page in PAGES_WITH_COMMANDS for line in command_lines(page.read_text(encoding="utf-8")))
    return {line.partition(" #")[0].strip() for line in lines}


def test_every_command_shown_is_executed_or_has_a_reason():
    kinds = (EXECUTED, BESIDE_A_SERVICE, LISTED["not executed"])
    assert shown() == {command for kind in kinds for commands in kind.values() for command in commands}


def test_every_command_of_another_program_is_tested_or_has_a_reason():
    blocks = (block for page in PAGES_WITH_COMMANDS for block in BLOCK.findall(page.read_text(encoding="utf-8")))
    lines = [line for block in blocks for line in block.splitlines() if line and not line.startswith(("fcslam ", "#"))]
    assert [line for line in lines if not line.startswith(tuple(OTHER_PROGRAMS))] == []
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES_WITH_COMMANDS)
    assert [
        beginning for beginning in OTHER_PROGRAMS if not re.search(rf"^(?: {{4}})?{re.escape(beginning)}", text, re.M)
    ] == []


def test_the_tests_that_reasons_name_are_there():
    reasons = [*LISTED["not executed"], *OTHER_PROGRAMS.values()]
    named = [name for reason in reasons for name in re.findall(r"(?:tests|tools|\.ci)/[\w/.]*\w", reason)]
    assert len(named) > 10
    assert [name for name in named if not (ROOT / name).exists()] == []


def relations(run_folder: Path) -> str:
    """Relations between scans of a run 21 s apart, as the reference files of the SLAM benchmark hold them."""
    (trajectory,) = open_run(run_folder).trajectories.values()
    poses, stamps = trajectory.T_map_base, trajectory.stamps
    lines = []
    for i in range(0, len(stamps) - 84, 4):
        x, y, theta = se2.between(poses[i], poses[i + 84])
        lines.append(f"{stamps[i]:.6f} {stamps[i + 84]:.6f} {x:.6f} {y:.6f} 0 0 0 {theta:.6f}")
    return "\n".join(lines) + "\n"


def make_relations(run: str) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(gzip.compress(relations(path.parent / "runs" / run).encode()))


def make_another_day(path: Path) -> None:
    """The third sample log, two days later: then something may have changed."""
    first = open_source(path.with_name("today.clf.gz")).records()
    scans = (replace(record, stamp=record.stamp + 172_800.0) for record in first)
    write_carmen(path, scans)


def make_map_of_another_program(path: Path) -> None:
    building = path.parent / "runs" / "building" / "map.yaml"
    path.write_text(building.read_text(encoding="utf-8").replace("map.pgm", "office.pgm"), encoding="utf-8")
    path.with_suffix(".pgm").write_bytes(building.with_suffix(".pgm").read_bytes())


def make_demo(path: Path) -> None:
    """The short drive of a robot with a camera, as `fcslam demo` leaves several."""
    require_gl()
    arguments = ["--robots", "1", "--path-length", "2", "--seed", "1", "--output", str(path)]
    assert main(["tools", "simulate", *arguments]) == 0


MADE = {
    "demo/recordings": make_demo,
    "building.relations.gz": make_relations("in-one"),
    "wednesday.clf.gz": make_another_day,
    "wednesday.clf.xz": make_another_day,
    "office.yaml": make_map_of_another_program,
    "fleet.bag": lambda path: fleet_bag(path.parent, name="fleet.bag"),
}
"""Other inputs of commands. Each is made when a command names it for the first time."""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """The beginnings of the sample logs."""
    folder = tmp_path_factory.mktemp("logs")
    for log, scans in SCANS.items():
        whole = ROOT / "examples" / "logs" / f"{OF.get(log, log)}.xz"
        write_carmen(folder / log, islice(open_source(whole).records(), scans))
    return folder


@pytest.fixture
def desk(logs, tmp_path, monkeypatch):
    """The folder of a reader with all logs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples" / "logs").mkdir(parents=True)
    for alias, log in LOGS.items():
        (tmp_path / alias).symlink_to(logs / log)
    return tmp_path


def as_here(command: str) -> str:
    for theirs, ours in SUBSTITUTES.items():
        command = command.replace(theirs, ours)
    return command


def run(command: str) -> int:
    words = shlex.split(command.partition(">")[0])
    return main([name for word in words[1:] for name in sorted(glob(word)) or [word]])


@pytest.mark.slow
@pytest.mark.parametrize("name", EXECUTED)
def test_the_commands_run_in_the_order_of_the_list(name, logs, desk, capsys):
    for alias, log in BAGS.items():
        if any(alias in command for command in EXECUTED[name]):
            (desk / alias).parent.mkdir(exist_ok=True)
            assert main(["record", str(logs / log), "-o", alias]) == 0
    for command in map(as_here, EXECUTED[name]):
        for made, make in MADE.items():
            if made in command and not (desk / made).exists():
                make(desk / made)
        capsys.readouterr()
        again = ["--force"] if any(output in command for output in overwritten(desk, command)) else []
        assert run(" ".join([command.partition(">")[0], *again])) == 0, (command, capsys.readouterr().err)
        if ">" in command:
            (desk / command.partition(">")[2].strip()).write_text(capsys.readouterr().out)


def overwritten(folder: Path, command: str) -> list[str]:
    """Outputs of a command that an earlier command of the list has written."""
    words = shlex.split(command)
    outputs = [words[i + 1] for i, word in enumerate(words) if word == "-o"]
    return [output for output in outputs if (folder / output).exists()]


def start(command: str, *more: str) -> subprocess.Popen[str]:
    """A command in a process of its own, without a display."""
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    words = [sys.executable, "-m", "fcslam.cli", *shlex.split(command)[1:], *more]
    return subprocess.Popen(
        words, env=environment | {"PYTHONPATH": path}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        preexec_fn=heed_interrupts,  # noqa: PLW1509
    )  # fmt: skip


def heed_interrupts() -> None:
    """Also where the tests were started in the background, which ignores them."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def end(process: subprocess.Popen[str]) -> str:
    """Press Ctrl-C; returns what the command printed."""
    process.send_signal(signal.SIGINT)
    return process.communicate(timeout=PATIENCE_S)[0]


def answer(url: str, process: subprocess.Popen[str]) -> bytes:
    """The content at a URL of the process, as soon as it is ready."""

    def read() -> bytes | None:
        try:
            return httpx.get(url, timeout=10.0).raise_for_status().content
        except httpx.HTTPError:
            assert process.poll() is None
            return None

    content: bytes = wait_for(read, PATIENCE_S)
    return content


def downloads(port: int) -> set[tuple[str, str]]:
    """File and address of every download that a page shows, from the service at ``port``."""
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES_WITH_COMMANDS)
    shown_here = re.findall(r"^(?: {4})?curl -o (\S+) (http://127\.0\.0\.1:8340\S+)$", text, re.MULTILINE)
    return {(file, url.replace("8340", str(port))) for file, url in shown_here}


@pytest.mark.system
def test_two_robots_and_a_service_as_the_pages_show_them(logs, desk, capsys):
    for name, long in (("anna", LONG), ("ben", MEETS)):  # after 45 scans, the evidence for a join is at its limit
        (link := desk / "examples" / "logs" / f"{name}.clf.xz").unlink()
        link.symlink_to(logs / long)
    port = free_port()

    def there(command: str) -> str:
        return as_here(command).replace("8340", str(port))

    (serve,) = BESIDE_A_SERVICE["services"]
    service = start(serve, "--port", str(port))
    try:
        assert answer(f"http://127.0.0.1:{port}/healthz", service)
        first, second = (there(command) for command in BESIDE_A_SERVICE["two robots at a time"])
        robot = start(first)
        assert run(second) == 0
        said = robot.communicate(timeout=PATIENCE_S)[0]
        assert robot.returncode == 0, said
        said += capsys.readouterr().out
        assert said.count("has confirmed all packets") == 2
        fleet = f"http://127.0.0.1:{port}/api/v1/fleet"
        wait_for(lambda: json.loads(answer(fleet, service))["maps"] == 1, PATIENCE_S)
        assert len(downloads(port)) == 3
        for file, url in downloads(port):
            (desk / file).write_bytes(answer(url, service))
        assert cv2.imread("map.png").std() > 0
        assert cv2.imread("map.pgm").std() > 0
    finally:
        said = end(service)
    assert f"http://127.0.0.1:{port}" in said
    assert service.returncode == 130


@pytest.mark.system
def test_the_pages_of_runs_are_served(desk):
    assert main(["map", "robot1.clf", "-o", "runs/sample", "--quiet"]) == 0
    (desk / "runs" / "building").symlink_to("sample")
    for command in BESIDE_A_SERVICE["pages"]:
        page = start(command)
        assert page.stdout is not None
        url = page.stdout.readline().split()[-1]
        assert b"<html" in answer(url, page)
        end(page)
        assert page.returncode == 0


@pytest.mark.slow
def test_the_queries_of_the_page_on_mission_files_run(desk):
    text = (ROOT / "docs" / "reference" / "mission-file.md").read_text(encoding="utf-8")
    queries = re.findall(r'^sqlite3 runs/building/mission.fcslam "(.*)"$', text, re.MULTILINE)
    assert len(queries) == 2
    assert main(["map", "anna=robot1.clf", "-o", "runs/building", "--quiet"]) == 0
    assert main(["edit", "remove", "runs/building", "anna"]) == 0
    with closing(sqlite3.connect("runs/building/mission.fcslam")) as mission:
        counts, edits = (mission.execute(query).fetchall() for query in queries)
    assert {kind for _, kind, _, _ in counts} == {"hello", "keyscan", "constraint", "place"}
    assert [kind for _, _, kind, _ in edits] == ["removal"]
