"""Folders that commands make up when none is named."""

from datetime import datetime
from pathlib import Path

import pytest

from fcslam.cli import BAD_INPUT, main
from fcslam.cli.output import new_folder, verdict_lines
from fcslam.runs import open_run
from tests.sources.carmen_text import drive, save

pytestmark = pytest.mark.slow

NOW = datetime(2026, 2, 3, 14, 5, 6)


def test_a_new_folder_is_called_by_the_time_and_never_taken(tmp_path):
    parent = str(tmp_path)
    assert new_folder(parent, NOW) == tmp_path / "2026-02-03-140506"
    assert list(tmp_path.iterdir()) == []
    for name in ("2026-02-03-140506", "2026-02-03-140506-2"):
        (tmp_path / name).mkdir()
    assert new_folder(parent, NOW) == tmp_path / "2026-02-03-140506-3"


def test_map_makes_a_run_folder_and_prints_where(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "robot.log", drive(40))
    for runs in (1, 2):
        assert main(["map", "robot.log"]) == 0
        (picture,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("map: ")]
        assert Path(picture.removeprefix("map: ")).is_file()
        assert len(list(Path("runs").iterdir())) == runs


def test_quiet_map_prints_its_answer_only(tmp_path, capsys):
    log = save(tmp_path / "robot.log", [*drive(40), "ODOM x"])
    assert main(["map", str(log), "-o", str(tmp_path / "loud")]) == 0
    assert "broken lines" in capsys.readouterr().err
    assert main(["map", str(log), "-o", str(tmp_path / "run"), "--quiet"]) == 0
    out, error = capsys.readouterr()
    assert error == ""
    assert f"map: {tmp_path / 'run' / 'map.png'}\nmap 0 (robot): do not use this map yet: it shows" in out


def test_the_last_lines_are_the_verdict_after_the_names_of_every_picture(tmp_path, capsys):
    drives = {"a": drive(40), "b": drive(19, start_stamp=200.0)}
    logs = [str(save(tmp_path / f"{name}.log", lines)) for name, lines in drives.items()]
    assert main(["map", *logs, "-o", str(tmp_path / "run"), "--quiet"]) == 0
    lines = capsys.readouterr().out.splitlines()
    pictures = sorted((tmp_path / "run").glob("map*.png"))  # a map of few keyscans gets none
    assert pictures
    after = lines[lines.index(f"map: {pictures[0]}") :]
    assert after[: len(pictures)] == [f"map: {path}" for path in pictures]
    assert after[len(pictures) :] == [*verdict_lines(open_run(tmp_path / "run").verdict)]
    assert "b has another map" in "\n".join(after)
    assert main(["evaluate", "quality", str(tmp_path / "run")]) == 0
    assert capsys.readouterr().out.splitlines() == after[len(pictures) :]
    assert main(["map", *logs, "-o", str(tmp_path / "alone"), "--quiet", "-c", "fleet.join_maps=false"]) == 0
    assert "another map" not in capsys.readouterr().out


@pytest.mark.attack
@pytest.mark.parametrize(
    "command",
    [
        "map {log} -o /sys/run",
        "tools simulate --robots 1 -o /sys/fleet", "serve --data /sys/data --port 0",
        "play {log} --server http://127.0.0.1:1 --state /sys/state",
    ],
)  # fmt: skip
def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, capsys, command):
    """Nobody makes a file in /sys, the administrator neither."""
    log = save(tmp_path / "robot.log", drive(40))
    assert main(command.format(log=log).split()) == BAD_INPUT
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith("fcslam: /sys/")
