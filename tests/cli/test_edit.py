"""`fcslam edit`: every correction acts on the next map, is undone to the same bytes, and bad input changes nothing."""

import re
import shutil
from multiprocessing import get_context

import numpy as np
import pytest

from fcslam.cli import main
from fcslam.geometry import se2
from fcslam.mission.mission_file import edit_mission, read_mission
from fcslam.records import ClosureStatus, ManualClosure, MapRegion, Pin, RegionUse, Removal, Veto
from fcslam.runs import open_run

pytestmark = pytest.mark.slow


def contents(folder):
    """All files of a run, without the mission, whose log of edits only grows, and what is bound to it."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.stem != "mission")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def mapped(logs, tmp_path_factory):
    """The run of two recordings; no test changes it."""
    folder = tmp_path_factory.mktemp("mapped") / "run"
    assert main(["map", *map(str, logs[:2]), "-o", str(folder), "-q"]) == 0
    return folder


@pytest.fixture
def run(mapped, tmp_path):
    """A copy of it."""
    return shutil.copytree(mapped, tmp_path / "run")


@pytest.fixture(autouse=True)
def user(monkeypatch):
    monkeypatch.setenv("LOGNAME", "anna")


def edit(run, command, *arguments):
    return main(["edit", command, str(run), *map(str, arguments)])


def again(run, name):
    """The run folder of the mission with its edits."""
    folder = run.with_name(name)
    assert main(["map", "--onto", str(run), "-o", str(folder), "-q"]) == 0
    return folder


def ends_of(closure):
    return closure.robot_i, f"{closure.stamp_i:.9f}", closure.robot_j, f"{closure.stamp_j:.9f}"


def between(run):
    """Closures between robots."""
    return [closure for closure in open_run(run).closures if closure.robot_i != closure.robot_j]


def a_closure(run, status):
    return ends_of(next(closure for closure in between(run) if closure.status is status))


def middle(run):
    """A point of the map that robots saw: where one of them stood."""
    poses = next(iter(open_run(run).trajectories.values())).T_map_base
    return poses[len(poses) // 2]


def commands(run):
    """A command of every kind, and whether an edit is what it asks for."""
    trajectories = open_run(run).trajectories
    i, at_i, j, at_j = ends = a_closure(run, ClosureStatus.ACCEPTED)
    last, (name, first) = list(trajectories)[-1], next(iter(trajectories.items()))
    at_s = first.stamps[len(first.stamps) // 2]
    x, y, _ = middle(run)
    corners = [(x, y), (x + 2.0, y), (x, y + 1.0)]
    drawn = " ".join(f"{x:.3f},{y:.3f}" for x, y in corners)

    def pose_at(content):
        trajectory = trajectories[content.session]
        return trajectory.T_map_base[np.abs(trajectory.stamps - content.stamp).argmin()]

    def names_the_closure(kind):
        return lambda content: (type(content), content.robot_i, content.robot_j, *content.stamps) == (
            kind, i, j, pytest.approx(float(at_i), abs=1e-6), pytest.approx(float(at_j), abs=1e-6)
        )  # fmt: skip

    def is_drawn(use, name=""):
        return lambda content: (
            (content.use, content.name) == (use, name)
            and np.allclose(se2.transform(pose_at(content), np.array(content.polygon)), corners, atol=2e-3)
        )

    def is_placed(content):
        return np.allclose(content.pose, se2.compose((10.0, -3.0, np.pi / 2), pose_at(content)), atol=1e-6)

    by_hand = ManualClosure(i, float(at_i), j, float(at_j), (0.5, -0.25, 0.1), (0.001, 0.001))
    return {
        ("veto", *ends): names_the_closure(Veto),
        ("pin", *ends): names_the_closure(Pin),
        ("close", *ends, "--pose", "0.5,-0.25,0.1", "--tolerance", "0.001,0.001"): by_hand.__eq__,
        ("remove", last): Removal(last).__eq__,
        ("remove", name, "--from", at_s): lambda content: (content.session, content.first_s) == (name, at_s),
        ("erase", drawn): is_drawn(RegionUse.ERASE),
        ("free", drawn): is_drawn(RegionUse.FREE),
        ("keep-out", drawn): is_drawn(RegionUse.KEEP_OUT),
        ("area", "Room 12", drawn): is_drawn(RegionUse.AREA, "Room 12"),
        ("place", "--match", "0,0=10,-3", "--match", "1,0=10,-2"): is_placed,
    }


def test_each_command_makes_its_edit_and_changes_nothing_else(mapped, run, capsys):
    for (command, *arguments), is_right in commands(run).items():
        assert edit(run, command, *arguments) == 0
        assert is_right(read_mission(run).edits[-1].content) is True, command
    assert contents(run) == contents(mapped)
    capsys.readouterr()
    assert main(["edit", "list", str(run)]) == 0
    listed = re.sub(r" \(anna, .*|-?\d+\.\d{3}", "", capsys.readouterr().out)
    assert listed.splitlines() == [
        "1: veto: robot_1 at  s and robot_2 at  s",
        "2: pin: robot_1 at  s and robot_2 at  s",
        "3: closure: robot_1 at  s and robot_2 at  s: ( m,  m,  rad)",
        "4: removal: robot_2",
        "5: cut: robot_1 from  s",
        "6: region: erase, 3 corners, by robot_2 at  s",
        "7: region: free, 3 corners, by robot_2 at  s",
        "8: region: keep-out, 3 corners, by robot_2 at  s",
        "9: region: area Room 12, 3 corners, by robot_2 at  s",
        "10: placement: robot_1 at  s: ( m,  m,  rad)",
    ]


def test_edits_of_every_kind_are_undone_to_the_same_bytes(mapped, run):
    for number, (command, *arguments) in enumerate(commands(run)):
        edit(run, command, *arguments)
        assert edit(run, "undo", 2 * number + 1) == 0
    assert contents(again(run, "undone")) == contents(mapped)


def test_a_map_aligns_to_its_walls(run, drawn):
    assert edit(run, "place", "--to-walls") == 0
    straight = open_run(again(run, "straight"))
    for robot in drawn.robots[:2]:
        off = straight.trajectories[robot.name].T_map_base[0, 2] - robot.T_building_base[0, 2]
        assert np.sin(2.0 * off) == pytest.approx(0.0, abs=0.02), "the walls of the building run along its axes"


def test_the_list_says_who_did_what_and_what_was_undone(run, capsys):
    assert main(["edit", "list", str(run)]) == 0
    assert capsys.readouterr().out == "no edits\n"
    first, second = list(open_run(run).trajectories)[:2]
    assert edit(run, "veto", first, second) == 0
    assert f"fcslam map --onto {run}" in capsys.readouterr().err
    assert edit(run, "undo", 1) == 0
    start = open_run(run).trajectories[first].stamps[0]
    assert edit(run, "remove", first, "--from", start) == 0
    capsys.readouterr()
    assert main(["edit", "list", str(run)]) == 0
    shown = capsys.readouterr().out
    assert re.sub(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC", "NOW", shown).splitlines() == [
        f"1: veto: {first} and {second} (anna, NOW; undone by edit 2)",
        "2: undo: edit 1 (anna, NOW)",
        f"3: cut: {first} from {start:.3f} s (anna, NOW)",
    ]


BAD = {
    "a closure that is not there": ("veto", "robot1", "0.001", "robot2", "0.001"),
    "half a closure": ("veto", "robot1", "1.0", "robot2"),
    "a stretch without numbers": ("remove", "robot1", "--from", "nan"),
    "no corner": ("erase", ""),
    "one corner": ("erase", "1,2"),
    "a corner of three numbers": ("erase", "1,2 3,4,5"),
    "a corner that is not a number": ("keep-out", "1,2 nan,3"),
    "a corner far away": ("keep-out", "1,2 3e9,3"),
    "a polygon without an inside": ("erase", "0,0 1,1 2,2"),
    "a map that is not there": ("erase", "1,2 3,4", "--map", "9"),
    "an area with a line break in its name": ("area", "a\nb", "1,2 3,4"),
    "an area without a name": ("area", "", "1,2 3,4"),
    "nothing to do": ("place",),
    "a moment without its pose": ("place", "--at", "robot1,1"),
    "a pose without its moment": ("place", "--at", "=1,2,3"),
    "two ways to place": ("place", "--to-walls", "--at", "robot1,1=1,2,3"),
    "one point": ("place", "--match", "1,2=3,4"),
    "the same point twice": ("place", "--match", "1,2=3,4", "--match", "1,2=3,4"),
    "a point without its target": ("place", "--match", "1,2", "--match", "3,4=5,6"),
    "a point that is not a number": ("place", "--match", "1,nan=0,0", "--match", "3,4=5,6"),
    "no pose": ("close", "robot1", "1", "robot2", "1", "--pose", "0,0"),
}


@pytest.mark.filterwarnings("error")
def test_bad_input_is_one_line_and_changes_nothing(run, refused):
    sessions = list(open_run(run).trajectories)
    names = {f"robot{number}": name for number, name in enumerate(sessions, start=1)}
    mission = (run / "mission.fcslam").read_bytes()
    for what, (command, *arguments) in BAD.items():
        assert refused("edit", command, run, *(arguments_of(argument, names) for argument in arguments))
        assert (run / "mission.fcslam").read_bytes() == mission, what


def arguments_of(argument, names):
    for placeholder, name in names.items():
        argument = argument.replace(placeholder, name)
    return argument


def test_what_is_drawn_needs_the_run_folder(run, tmp_path, refused):
    shutil.copy(run / "mission.fcslam", tmp_path / "alone.fcslam")
    assert "give the run folder" in refused("edit", "erase", tmp_path / "alone.fcslam", "1,2 3,4")


def test_of_people_who_edit_at_once_nobody_loses_an_edit(run):
    session, trajectory = next(iter(open_run(run).trajectories.items()))
    context = get_context("spawn")
    both = context.Barrier(2)
    anna, ben = ((run, name, session, float(trajectory.stamps[0]), both) for name in ("anna", "ben"))
    other = context.Process(target=edit_often, args=anna)
    other.start()
    edit_often(*ben)
    other.join()
    assert other.exitcode == 0
    edits = read_mission(run).edits
    assert [edit.number for edit in edits] == list(range(1, 7))
    assert sorted(edit.author for edit in edits) == [name for name in ("anna", "ben") for _ in range(3)]


def edit_often(run, author, session, stamp, both):
    both.wait(60.0)
    for number in range(3):
        region = MapRegion(RegionUse.AREA, str(number), session, stamp, ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
        edit_mission(run, [region], author, 0.0)
