"""`fcslam map` of a recording with a ride in a lift: a map for each floor, and a line with the remedy."""

import pytest

from fcslam.cli import main
from fcslam.runs import open_run
from tests.carmen_logs import write_carmen
from tests.robot.lifting import ride
from tests.robot.test_lifts import SHORT

pytestmark = pytest.mark.slow


def test_a_ride_in_a_lift_gives_two_maps_and_the_option_that_names_the_floor(tmp_path, capsys):
    scans, _, (opening,) = ride(3, 4, laser=SHORT)
    write_carmen(tmp_path / "anna.clf", scans)
    assert main(["map", str(tmp_path / "anna.clf"), "--output", str(tmp_path / "run")]) == 0
    run, out = open_run(tmp_path / "run"), capsys.readouterr().out
    assert {name: each.map_index for name, each in run.trajectories.items()} == {"anna": 0, "anna+1": 1}
    assert run.trajectories["anna+1"].stamps[0] == pytest.approx(opening, abs=1.0)
    assert "anna+1: anna was lost or rode in a lift; this session begins at" in out
    option = out.partition("give --floor ")[2].partition("=FLOOR")[0]
    assert main(["map", str(tmp_path / "anna.clf"), "--floor", f"{option}=2", "--output", str(tmp_path / "named")]) == 0
    named = open_run(tmp_path / "named")
    assert [(name, each.floor) for name, each in named.trajectories.items()] == [("anna", ""), ("anna+1", "2")]
    assert len(named.trajectories["anna+1"].stamps) == pytest.approx(len(run.trajectories["anna+1"].stamps), abs=1)
    assert "anna+1: anna came to floor 2" in capsys.readouterr().out
