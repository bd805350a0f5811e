"""`fcslam show`: what is refused at once, the file, and the real commands."""

import signal
from contextlib import closing

import httpx
import numpy as np
import pytest

from fcslam.cli import main
from fcslam.cli.show import LARGEST_BYTES
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, server_files
from fcslam.runs import RobotTrajectory, Run
from tests.cli.commands import Command

API = "/api/v1"


@pytest.fixture
def run(tmp_path):
    """A small one."""
    occupancy = OccupancyMap(np.full((40, 60), Occupancy.FREE, np.uint8), 0.05, (0.0, 0.0))
    trajectory = RobotTrajectory("a", 0, np.arange(3.0), np.zeros((3, 3)))
    Run({"a": trajectory}, map_files=server_files("map", occupancy)).save(tmp_path / "run")
    return tmp_path / "run"


def test_a_damaged_run_is_told_in_one_line(run, refused):
    (run / "closures.csv").write_text("damaged")
    assert "damaged run folder" in refused("show", run)


def test_a_huge_run_is_refused_before_it_is_read(run, refused):
    with (run / "map.pgm").open("ab") as file:
        file.truncate(LARGEST_BYTES + 1)  # without a block on the disk
    assert "GiB" in refused("show", run)


def test_a_report_is_one_file_and_replaces_another_only_if_told(run, tmp_path, capsys, refused):
    report = tmp_path / "report.html"
    assert main(["show", str(run), "--html", str(report)]) == 0
    assert "report.html" in capsys.readouterr().out
    before = report.read_bytes()
    assert b"maps/0/tiles/5/0/0.png" in before
    assert main(["show", str(run), "--html", str(report), "--force"]) == 0
    assert report.read_bytes() == before
    assert "exists" in refused("show", run, "--html", tmp_path, "--force")


@pytest.mark.system
@pytest.mark.parametrize(("option", "end"), [("--open", signal.SIGINT), ("--no-open", signal.SIGTERM)])
def test_a_browser_opens_if_it_may_and_ctrl_c_ends_the_page_with_success_also_while_somebody_looks(
    run, tmp_path, option, end
):
    browser, opened = tmp_path / "browser", tmp_path / "opened"
    browser.write_text(f"#!/bin/sh\necho $1 > {opened}\n")
    browser.chmod(0o755)
    no_display = {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
    with closing(Command("show", run, option, BROWSER=f"{browser} %s", **no_display)) as command:
        assert "<canvas" in httpx.get(command.url, timeout=30.0).text
        assert opened.exists() == (option == "--open")
        assert httpx.get(f"{command.url}{API}/fleet", timeout=30.0).json()["read_only"]
        with httpx.stream("GET", f"{command.url}{API}/events", timeout=30.0) as events:
            assert events.status_code == 200
            command.process.send_signal(end)
            assert command.process.wait(120.0) == 0
