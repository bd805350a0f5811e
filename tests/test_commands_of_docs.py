"""Every command that the documentation shows runs here, or tests/commands_of_docs.yaml gives the reason why not."""

import gzip
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from fcslam import open_run
from fcslam.cli import main
from fcslam.geometry import se2
from tests.test_docs import COMMAND_LINE, PAGES, ROOT

LISTED: dict[str, Any] = yaml.safe_load((ROOT / "tests" / "commands_of_docs.yaml").read_text(encoding="utf-8"))
ANNA, BEN, CLEO = (ROOT / "examples" / "logs" / f"{robot}.clf.xz" for robot in ("anna", "ben", "cleo"))
LOGS = {
    "robot1.clf.gz": ANNA, "robot1.clf": ANNA, "building.clf.gz": ANNA, "monday.clf.gz": ANNA,
    "robot2.log": BEN, "robot2.clf": BEN, "tuesday.clf.gz": BEN,
    "robot3.log": CLEO, "wednesday.clf.gz": CLEO, "today.clf.gz": CLEO,
}  # fmt: skip
"""Names that the pages use, and the sample log that stands for each."""
BAGS = {
    "run1.bag": ANNA, "monday/run.bag": ANNA, "robot2.mcap": BEN, "run2.bag": BEN, "tuesday/run.bag": BEN,
    "robot2.fcslam": BEN, "day.mcap": CLEO,
}  # fmt: skip


def shown() -> set[str]:
    """Every command on a line of its own in the README and docs/."""
    pages = [page for page in PAGES if page.name not in {"CHANGELOG.md", "CONTRIBUTING.md", "commands.md"}]
    lines = (line for page in pages for line in COMMAND_LINE.findall(page.read_text(encoding="utf-8")))
    return {line.partition(" #")[0].strip() for line in lines}


def listed() -> list[str]:
    """Every command of the list."""
    return [command for kind in LISTED.values() for commands in kind.values() for command in commands]


def test_every_command_shown_is_executed_or_has_a_reason():
    assert shown() == set(listed())


def relations(run_folder: Path) -> str:
    """Relations between scans of a run 30 s apart, as the reference files of the SLAM benchmark hold them."""
    (trajectory,) = open_run(run_folder).trajectories.values()
    poses, stamps = trajectory.T_map_base, trajectory.stamps
    lines = []
    for i in range(0, len(stamps) - 120, 10):
        x, y, theta = se2.between(poses[i], poses[i + 120])
        lines.append(f"{stamps[i]:.6f} {stamps[i + 120]:.6f} {x:.6f} {y:.6f} 0 0 0 {theta:.6f}")
    return "\n".join(lines) + "\n"


def run(command: str) -> int:
    words = shlex.split(command.partition(">")[0])
    return main(words[1:])


@pytest.mark.slow
@pytest.mark.parametrize("name", LISTED["executed"])
def test_the_commands_run_in_the_order_of_the_list(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    for alias, log in LOGS.items():
        (tmp_path / alias).symlink_to(log)
    if name == "bags":
        for alias, log in BAGS.items():
            (tmp_path / alias).parent.mkdir(exist_ok=True)
            assert main(["convert", str(log), alias]) == 0
    (tmp_path / "vetoes.csv").write_text("robot_i,stamp_i,robot_j,stamp_j\nrobot1,,robot3,\n")
    for command in LISTED["executed"][name]:
        if "building.relations.gz" in command and not (tmp_path / "building.relations.gz").exists():
            text = relations(tmp_path / "runs" / "in-one")
            (tmp_path / "building.relations.gz").write_bytes(gzip.compress(text.encode()))
        capsys.readouterr()
        again = ["--force"] if any(output in command for output in overwritten(tmp_path, command)) else []
        assert run(" ".join([command.partition(">")[0], *again])) == 0, (command, capsys.readouterr().err)
        if ">" in command:
            (tmp_path / command.partition(">")[2].strip()).write_text(capsys.readouterr().out)


def overwritten(folder: Path, command: str) -> list[str]:
    """Outputs of a command that an earlier command of the list has written."""
    words = shlex.split(command)
    outputs = [words[i + 1] for i, word in enumerate(words) if word == "-o"]
    outputs += words[-1:] if words[1] == "convert" else []
    return [output for output in outputs if (folder / output).exists()]
