"""The run folder: what is written is read back, and nothing half written ever looks whole."""

import re
from dataclasses import astuple, replace

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.geometry import se2
from fcslam.maps.occupancy_map import OccupancyMap, map_yaml, parse_map, pgm_bytes
from fcslam.records import Channel, ClosureStatus, Reason, ReasonCode
from fcslam.runs import (
    ClosureRow,
    Join,
    LocalMap,
    Metric,
    RobotTrajectory,
    Run,
    open_run,
    prepare_output,
)

CLOSURE_COLUMNS = "robot_i,stamp_i,robot_j,stamp_j,channel,similarity,x,y,theta,status,reason,value,limit,setting"
CLOSURE_REST = "lidar,0.5,0,0,0,accepted,fits_joint_graph,,,"
JOIN_COLUMNS = "robot_i,robot_j,closures,places,seen_m,contradicting_m,likeness,elsewhere"


def trajectory(robot="robot_1", map_index=0, count=40, seed=0):
    rng = np.random.default_rng(seed)
    poses = np.column_stack((rng.normal(0.0, 30.0, (count, 2)), rng.uniform(-np.pi, np.pi, count)))
    return RobotTrajectory(robot, map_index, 976052857.337530 + np.sort(rng.uniform(0, 100, count)), poses)


@pytest.fixture
def run():
    closure = ClosureRow(
        "robot_1", 976052857.33753, "b-2", 976052999.5, Channel.LIDAR, 0.25, np.array([1.0, -2.5, 3.0]),
        ClosureStatus.REJECTED, Reason(ReasonCode.FEW_PLACES, 2, 3.5, 'of, "which"'),
    )  # fmt: skip
    trajectories = (trajectory(), trajectory("b-2", 1, count=1, seed=1), trajectory("étage.0", 2, count=0))
    return Run(
        trajectories={t.robot: t for t in trajectories},
        closures=(closure,),
        joins=(Join("robot_1", "b-2", 7, 3, 141.5, 0.25, 0.9, 0.0), Join("robot_1", "étage.0", 3, 1, *[np.nan] * 4)),
        metrics={"uplink": Metric("uplink", 4.5, "kB/s"), "error": Metric("error", float("nan"), "m")},
        config_yaml="seed: 1\n",
        pose_graph_g2o="VERTEX_SE2 0 0 0 0\n",
        map_files={"map.pgm": b"P5\x00\xff", "map_1.yaml": b"image: map_1.pgm\n"},
        mission=b"packets",
        local_maps={
            t.robot: LocalMap(
                t.robot, t.stamps, t.T_map_base[::-1], b"P5 \x00" + t.robot.encode(), f"image: {t.robot}.pgm\n"
            )
            for t in trajectories
        },
    )


def hidden(folder):
    return [entry.name for entry in folder.iterdir() if entry.name.startswith(".")]


def test_what_is_written_is_read_back(tmp_path, run):
    run.save(tmp_path / "deep" / "run")
    back = open_run(tmp_path / "deep" / "run")
    for given, read in zip(run.trajectories.values(), back.trajectories.values(), strict=True):
        assert (given.robot, given.map_index, len(given.stamps)) == (read.robot, read.map_index, len(read.stamps))
        np.testing.assert_allclose(read.stamps, given.stamps, atol=1e-6, rtol=0)
        np.testing.assert_allclose(se2.between(given.T_map_base, read.T_map_base), 0.0, atol=1e-7)
    closure, given = back.closures[0], run.closures[0]
    np.testing.assert_allclose(closure.T_i_j, given.T_i_j, atol=1e-6)
    for name in ("robot_i", "stamp_i", "robot_j", "stamp_j", "channel", "similarity", "status", "reason"):
        assert getattr(closure, name) == getattr(given, name)
    assert back.joins[0] == run.joins[0]
    np.testing.assert_equal(astuple(back.joins[1]), astuple(run.joins[1]))
    assert back.metrics["uplink"] == run.metrics["uplink"]
    assert np.isnan(back.metrics["error"].value)
    assert (back.config_yaml, back.pose_graph_g2o, back.mission) == (run.config_yaml, run.pose_graph_g2o, run.mission)
    assert dict(back.map_files) == dict(run.map_files)
    for given, read in zip(run.local_maps.values(), back.local_maps.values(), strict=True):
        assert (given.robot, given.pgm, given.yaml) == (read.robot, read.pgm, read.yaml)
        np.testing.assert_allclose(read.stamps, given.stamps, atol=1e-6, rtol=0)
        np.testing.assert_allclose(se2.between(given.T_local_base, read.T_local_base), 0.0, atol=1e-7)


def test_a_run_folder_without_joins_csv_is_read(tmp_path, run):
    run.save(tmp_path / "run")
    (tmp_path / "run" / "joins.csv").unlink()
    assert open_run(tmp_path / "run").joins == ()


def test_tables_have_the_columns_promised(tmp_path, run):
    run.save(tmp_path / "run")
    robots = (tmp_path / "run" / "robots.csv").read_text().splitlines()
    assert robots[0] == "robot,map,path_length_m,scans"
    assert robots[2] == "b-2,1,0.000,1"
    closures = (tmp_path / "run" / "closures.csv").read_text().splitlines()
    assert closures[0] == CLOSURE_COLUMNS
    joins = (tmp_path / "run" / "joins.csv").read_text().splitlines()
    assert joins[0] == JOIN_COLUMNS
    assert joins[2] == "robot_1,étage.0,3,1,,,,"
    line = (tmp_path / "run" / "trajectories" / "robot_1.tum").read_text().splitlines()[0].split()
    assert line[3:6] == ["0", "0", "0"]
    assert [len(line[i].split(".")[1]) for i in (0, 1, 2, 6, 7)] == [9] * 5


def test_robots_name_their_floors_if_one_has_a_floor(tmp_path):
    Run({"a": trajectory("a"), "b": replace(trajectory("b", 1), floor="-1")}).save(tmp_path / "run")
    header, *rows = (tmp_path / "run" / "robots.csv").read_text().splitlines()
    assert header == "robot,map,path_length_m,scans,floor"
    assert [row.split(",")[-1] for row in rows] == ["", "-1"]
    assert [robot.floor for robot in open_run(tmp_path / "run").trajectories.values()] == ["", "-1"]


def test_path_length_is_that_of_the_polygon():
    square = RobotTrajectory(
        "r", 0, np.arange(5.0), np.array([[0, 0, 0], [3, 0, 1], [3, 4, 2], [0, 4, 3], [0, 0, 0.0]])
    )
    assert square.path_length_m == 14.0


def test_a_second_run_needs_force_and_leaves_nothing_of_the_first(tmp_path, run):
    run.save(tmp_path / "run")
    with pytest.raises(InputError, match="--force"):
        run.save(tmp_path / "run")
    Run({"other": trajectory("other")}).save(tmp_path / "run", force=True)
    assert [t.robot for t in open_run(tmp_path / "run").trajectories.values()] == ["other"]
    assert not (tmp_path / "run" / "map.pgm").exists()
    assert hidden(tmp_path) == []


@pytest.mark.parametrize("force", [False, True])
def test_a_folder_that_is_no_run_is_never_replaced(tmp_path, run, force):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    with pytest.raises(InputError, match="does not hold a run"):
        run.save(tmp_path / "thesis", force=force)
    assert (tmp_path / "thesis" / "chapter1.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    ("where", "why"),
    [
        ("file", "does not hold"),
        ("file/below", "used as"),
        ("/", "inside it"),
        ("/proc/nowhere/run", "used as"),
        ("loop", "does not hold"),
        (".", "inside it"),
    ],
)
def test_impossible_places_are_refused_in_one_line(tmp_path, monkeypatch, where, why):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError, match=f"{why}[^\n]*$"):
        prepare_output(tmp_path / where, force=True)


class Interrupting(dict):
    """Maps whose writing ends with an error."""

    def __init__(self, failure):
        super().__init__({"map.pgm": b""})
        self.failure = failure

    def items(self):
        raise self.failure


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError, MemoryError])
def test_an_interrupted_writer_leaves_the_place_as_it_was(tmp_path, run, failure):
    Run({"first": trajectory("first")}).save(tmp_path / "run")
    for place in ("run", "fresh"):
        with pytest.raises(InputError if failure is OSError else failure):
            replace(run, map_files=Interrupting(failure)).save(tmp_path / place, force=True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]
    assert [t.robot for t in open_run(tmp_path / "run").trajectories.values()] == ["first"]


@pytest.mark.parametrize("name", ["", "..", ".hidden", "a/b", "../../etc/passwd", "a\nb", "-"])
def test_names_that_are_no_file_names_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="file name"):
        Run({name: trajectory(name)}).save(tmp_path / "run")
    with pytest.raises(InputError, match="file name"):
        Run({}, map_files={name: b""}).save(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_what_is_no_run_folder_is_refused(tmp_path):
    for path, said in ((tmp_path, "not a run folder"), (tmp_path / "missing", "no such folder")):
        with pytest.raises(InputError, match=said):
            open_run(path)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("trajectories/robot_1.tum", "1 2 3\n", "8"),
        ("trajectories/robot_1.tum", "1 2 3 0 0 0 0 nan\n", "not finite"),
        ("trajectories/robot_1.tum", "1 2 3 0 0 0 0 x\n", "robot_1.tum"),
        ("trajectories/robot_1.tum", None, "robot_1.tum"),
        ("robots.csv", "robot,map\nrobot_1,0\n", "line 2"),
        ("robots.csv", "robot,map,path_length_m,scans\n../../x,0,1,1\n", "is not a robot's name"),
        ("robots.csv", "robot,map,path_length_m,scans\nrobot_1,zero,1,1\n", "zero"),
        ("robots.csv", "robot,map,path_length_m,scans,floor\nrobot_1,0,1,1,<b>\n", "'<b>' is not a floor"),
        ("closures.csv", "robot_i\nrobot_1\n", "closures.csv, line 2"),
        ("closures.csv", None, "closures.csv"),
        ("closures.csv", f"{CLOSURE_COLUMNS}\nzoe,1,b-2,2,{CLOSURE_REST}\n", "'zoe' has no trajectory"),
        ("trajectories/b-2.tum", "", "'b-2' has no trajectory"),
        ("joins.csv", "robot_i,robot_j\na,b\n", "joins.csv, line 2"),
        ("joins.csv", f"{JOIN_COLUMNS}\na,b,x,1,,,,\n", "'x'"),
        ("local/robot_1.tum", None, "robot_1.tum"),
        ("local/b-2.pgm", None, "b-2.pgm"),
        ("local/b-2.yaml", "image: \xff\n", "broken"),
        ("metrics.json", "{", "broken"),
        ("metrics.json", '{"a": 1}', "metrics.json"),
        ("metrics.json", "[3]", "metrics.json"),
        ("metrics.json", f'[{{"name": "a", "value": 1{"0" * 400}, "unit": "m"}}]', "metrics.json"),
        ("config.yaml", None, "config.yaml"),
        ("robots.csv", "\x00\xff", "broken"),
        ("robots.csv", "robot,map,path_length_m,scans\n" + "x" * 200_000 + ",0,1,1\n", "broken"),
    ],
)
def test_a_broken_run_folder_is_refused_in_one_line(tmp_path, run, file, content, message):
    run.save(tmp_path / "run")
    path = tmp_path / "run" / file
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content.encode("latin-1"))
    with pytest.raises(InputError, match=message) as caught:
        open_run(tmp_path / "run")
    assert "\n" not in str(caught.value)


MAP = OccupancyMap(np.random.default_rng(0).integers(0, 3, (7, 4)).astype(np.uint8), 0.05, (-1.25, 3.5))
PGM, DESCRIPTION = pgm_bytes(MAP), map_yaml(MAP, "map.pgm")


def test_a_map_that_is_written_is_read_back():
    read = parse_map("map.pgm", PGM, DESCRIPTION)
    assert np.array_equal(read.cells, MAP.cells)
    assert (read.resolution_m, read.origin_xy) == (MAP.resolution_m, MAP.origin_xy)
    assert not read.cells.flags.writeable


@pytest.mark.parametrize(
    "pgm",
    [b"", b"P5", b"P2" + PGM[2:], PGM[:-1], PGM + b"\0", PGM.replace(b"4 7", b"0 7"), PGM.replace(b"4 7", b"-4 -7"),
     PGM.replace(b"4 7", b"4000000 7000000"), PGM.replace(b"4 7", b"9" * 5000 + b" 7"), PGM.replace(b"255", b"65535")],
)  # fmt: skip
def test_a_broken_image_of_a_map_is_refused(pgm):
    with pytest.raises(InputError, match=r"map\.pgm is broken") as raised:
        parse_map("map.pgm", pgm, DESCRIPTION)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [("resolution: 0.05", "res: 0.05", "`resolution` in the description is missing"),
     ("0.05", "fine", "`resolution` in the description is not a finite number"),
     ("0.65", "[1]", "`occupied_thresh` in the description is not a finite number"),
     ("3.5, 0.0", "3.5", "`origin` in the description must be"), ("negate: 0", "negate: 1", "needs `negate` 0")],
)  # fmt: skip
def test_the_message_names_the_key_that_is_wrong(old, new, message):
    assert old in DESCRIPTION
    with pytest.raises(InputError, match=re.escape(message)):
        parse_map("map.pgm", PGM, DESCRIPTION.replace(old, new))


@pytest.mark.parametrize(("name", "line"), [("robots.csv", "robot_1,0,1.0,1\n"), ("metrics.json", "")])
def test_what_occurs_twice_is_refused(tmp_path, run, name, line):
    run.save(tmp_path / "run")
    path = tmp_path / "run" / name
    text = path.read_text()
    path.write_text(text + line if line else text.replace('"error"', '"uplink"'))
    with pytest.raises(InputError, match="occurs twice"):
        open_run(tmp_path / "run")
