"""A robot's copy of the maps of a cloud: over real HTTP, and without the cloud."""

import socket
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import uvicorn

from fcslam.cli import main
from fcslam.errors import CloudError, InputError, SourceError
from fcslam.live.served_map import fetch_maps
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, map_stem, map_yaml, pgm_bytes
from fcslam.mission.localization import read_finished, read_map
from fcslam.page.report import ShownRun
from fcslam.page.routes import run_page
from fcslam.runs import RobotTrajectory, Run
from fcslam.wire.fleet_client import FleetClient
from fcslam.wire.keys import Server
from tests.small_fleet import contents

pytestmark = pytest.mark.slow

NOBODY = "http://127.0.0.1:9"


def building(side):
    cells = np.full((side, side), Occupancy.FREE, np.uint8)
    cells[side // 2] = Occupancy.OCCUPIED
    return OccupancyMap(cells, 0.05, (-3.0, -2.0))


def run_of(maps):
    """A run with a robot in each map; ``maps``: map and floor."""
    trajectories, files = {}, {}
    for number, (occupancy, floor) in enumerate(maps):
        robot, stem = f"robot{number}", map_stem(number)
        trajectories[robot] = RobotTrajectory(robot, number, np.arange(2.0), np.zeros((2, 3)), floor)
        files |= {f"{stem}.pgm": pgm_bytes(occupancy), f"{stem}.yaml": map_yaml(occupancy, f"{stem}.pgm").encode()}
    return Run(trajectories, map_files=files)


@contextmanager
def served(folder):
    """The address of a viewer of the run folder."""
    with ShownRun(folder) as shown, socket.create_server(("127.0.0.1", 0)) as listening:
        server = uvicorn.Server(uvicorn.Config(run_page(shown), log_level="critical", ws="none"))
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        while thread.is_alive() and not server.started:
            time.sleep(0.01)
        try:
            yield f"http://127.0.0.1:{listening.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture
def floors(tmp_path):
    run_of([(building(160), "1"), (building(90), "2"), (building(40), "2")]).save(tmp_path / "run")
    with served(tmp_path / "run") as url:
        yield url


@pytest.mark.parametrize(("floor", "side"), [("1", 160), ("2", 90)])
def test_the_copy_has_the_maps_of_the_cloud_with_their_floors(floors, tmp_path, floor, side):
    assert fetch_maps(tmp_path / "copy", Server(floors)) is None
    copied = read_map(tmp_path / "copy", floor)
    assert np.array_equal(copied.cells, building(side).cells)
    assert (copied.resolution_m, copied.origin_xy, copied.floor) == (0.05, (-3.0, -2.0), floor)
    with pytest.raises(SourceError, match="has maps of several floors"):
        read_map(tmp_path / "copy")


def test_the_copy_of_a_map_in_space_has_its_points(tmp_path):
    run = run_of([(building(160), ""), (building(90), "")])
    replace(run, map_files=run.map_files | {"map.ply": b"points"}).save(tmp_path / "run")
    with served(tmp_path / "run") as url:
        assert fetch_maps(tmp_path / "copy", Server(url)) is None
    assert {path.name for path in (tmp_path / "copy").glob("*.ply")} == {"map.ply"}
    assert read_finished(tmp_path / "copy").ply == b"points"


def test_an_earlier_copy_serves_while_the_cloud_cannot_be_reached(floors, tmp_path):
    with pytest.raises(CloudError, match="copy holds no earlier copy of the map"):
        fetch_maps(tmp_path / "copy", Server(NOBODY))
    assert not (tmp_path / "copy").exists()
    fetch_maps(tmp_path / "copy", Server(floors))
    before = contents(tmp_path / "copy")
    assert "127.0.0.1:9" in fetch_maps(tmp_path / "copy", Server(NOBODY))
    assert fetch_maps(tmp_path / "copy", Server(f"{NOBODY},{floors}")) is None
    assert contents(tmp_path / "copy") == before


def test_a_new_copy_replaces_the_earlier_one(tmp_path):
    for side in (40, 60):
        run_of([(building(side), "")]).save(tmp_path / "run", force=True)
        with served(tmp_path / "run") as url:
            fetch_maps(tmp_path / "copy", Server(url))
        assert read_map(tmp_path / "copy").cells.shape == (side, side)


def test_a_folder_with_something_else_stays_as_it_is(floors, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="exists and does not hold a run"):
        fetch_maps(tmp_path / "mine", Server(floors))
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"]


def test_a_run_of_its_own_stays_as_it_is(floors, tmp_path):
    """Also one without a mission file, as of a robot that was localized."""
    run_of([(building(40), "")]).save(tmp_path / "mine")
    with pytest.raises(InputError, match="mine: is a run"):
        fetch_maps(tmp_path / "mine", Server(floors))
    assert read_map(tmp_path / "mine" / "map.yaml").cells.shape == (40, 40)


def test_a_map_that_the_cloud_draws_anew_meanwhile_is_read_again(floors, tmp_path, monkeypatch):
    """The list of maps is older than the files once, then always."""
    answers = []

    def maps(client, original=FleetClient.maps):
        answers.append(original(client))
        is_old = len(answers) == 1 or len(answers) > 2
        return [replaced(one) for one in answers[-1]] if is_old else answers[-1]

    def replaced(one):
        return one.model_copy(update={"extent_m": (one.extent_m[0] - 0.05, *one.extent_m[1:])})

    monkeypatch.setattr(FleetClient, "maps", maps)
    assert fetch_maps(tmp_path / "copy", Server(floors)) is None
    assert len(answers) == 2
    assert "its maps change all the time" in fetch_maps(tmp_path / "copy", Server(floors))


def test_a_cloud_without_a_map_is_told_in_one_line(tmp_path, capsys):
    replace(run_of([]), metrics={}).save(tmp_path / "run")
    with served(tmp_path / "run") as url:
        assert main(["localize", "ros2:/robot1", "--server", url, "--map", str(tmp_path / "copy")]) == 2
    assert capsys.readouterr().err == f"fcslam: {url}: has no map yet; let a robot send its scans first\n"
