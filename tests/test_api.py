"""The public Python API: what it offers, how it fails, and that a run that was opened offers what was mapped."""

import contextlib
import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fcslam
from fcslam import api, errors
from fcslam.sources import open_source
from tests.sources.test_clouds_in_space import drive as drive_in_space
from tests.sources.test_clouds_in_space import opened as opened_in_space

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("runs") / "building"


@pytest.fixture(scope="module")
def mapped(logs, folder):
    return fcslam.map_recordings(logs, output=folder, config={"seed": 3})


@pytest.fixture(scope="module")
def opened(mapped, folder):
    return fcslam.open_run(folder)


def test_all_holds_every_exception_and_every_name_in_it_exists():
    exceptions = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
    assert exceptions < set(fcslam.__all__)
    assert all(hasattr(fcslam, name) for name in fcslam.__all__)
    with pytest.raises(AttributeError, match="no attribute 'map_recording'"):
        _ = fcslam.map_recording


def test_the_reference_lists_every_public_name():
    page = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    listed = {path.rpartition(".")[2] for path in re.findall(r"^::: (\S+)", page, re.MULTILINE)}
    named = {name for name in fcslam.__all__ if getattr(getattr(fcslam, name), "__module__", "") != "fcslam.errors"}
    assert listed == {"errors", *named} - {"__version__"}


def test_names_load_their_modules_at_the_first_use():
    program = (
        "import sys, fcslam; before = set(sys.modules); fcslam.Veto; after = set(sys.modules)\n"
        "assert not {'numpy', 'fcslam.records', 'fcslam.mission.mission'} & before\n"
        "assert 'fcslam.records' in after and 'fcslam.mission.mission' not in after\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=ROOT / "src", check=True)


def test_what_a_map_in_space_does_not_use_is_named(logs, tmp_path):
    whole, planar = opened_in_space(tmp_path, drive_in_space()), open_source(logs[0])
    plain = {"fleet": {"dimensions": 3}}
    tuned = api.settings_of({**plain, "robot": {"lost": {"doubted": 0.9}}})
    assert api.notes_in_space([whole], api.settings_of(plain)) == []
    assert api.notes_in_space([whole], tuned) == ["robot.lost: only robots with 2D LiDARs use these settings"]
    (note,) = api.notes_in_space([planar], tuned)
    assert "no point clouds" in note
    assert len(api.notes_in_space([whole, planar], tuned)) == 2
    assert api.notes_in_space([whole, planar], api.settings_of({"robot": {"lost": {"doubted": 0.9}}})) == []


def test_a_run_that_was_opened_can_be_saved_again(opened, tmp_path):
    opened.save(str(tmp_path / "copy"))
    assert fcslam.open_run(str(tmp_path / "copy")).map_files == opened.map_files
    with pytest.raises(fcslam.InputError, match="force=True"):
        opened.save(tmp_path / "copy")


def test_robots_stand_in_free_cells_of_their_map(opened):
    """Ties the array to its origin, resolution and order of rows."""
    for trajectory in opened.trajectories.values():
        drawn = opened.maps[trajectory.map_index]
        column, row = np.floor((trajectory.T_map_base[:, :2] - drawn.origin_xy) / drawn.resolution_m).astype(int).T
        assert np.mean(drawn.cells[row, column] == fcslam.Occupancy.FREE) > 0.99


def test_arrays_are_read_only(mapped, opened):
    for run in (mapped, opened):
        arrays = [
            *(array for t in run.trajectories.values() for array in (t.stamps, t.T_map_base)),
            *(array for own in run.local_maps.values() for array in (own.stamps, own.T_local_base)),
            *(closure.T_i_j for closure in run.closures),
            *(drawn.cells for drawn in run.maps.values()),
        ]
        assert not any(array.flags.writeable for array in arrays)


def test_recordings_may_be_one_path_named_paths_or_sources(logs):
    quick = {"config": {"fleet": {"join_maps": False}}}
    (log, *_) = logs
    runs = [
        fcslam.map_recordings(str(log), **quick),
        fcslam.map_recordings([open_source(log)], **quick),
        fcslam.map_recordings({"anna": log}, **quick),
    ]
    assert [list(run.trajectories) for run in runs] == [["robot_1"], ["robot_1"], ["anna"]]
    assert len({run.maps[0].cells.tobytes() for run in runs}) == 1
    assert runs[0].config_yaml == runs[1].config_yaml


def test_split_cuts_one_recording_and_progress_is_called(logs):
    seen = []
    run = fcslam.map_recordings(logs[0], split=2, config={"fleet": {"join_maps": False}}, progress=seen.append)
    assert list(run.trajectories) == ["robot_1_1", "robot_1_2"]
    assert isinstance(seen[-1], fcslam.Progress)
    assert seen[-1].fusing


def test_settings_come_from_a_model_a_mapping_or_a_file(tmp_path):
    path = tmp_path / "mission.yaml"
    path.write_text("seed: 7\n")
    for config in (fcslam.MissionConfig(seed=7), {"seed": 7}, path, str(path)):
        assert api.settings_of(config) == fcslam.MissionConfig(seed=7)


@pytest.mark.parametrize(
    ("arguments", "kind", "said"),
    [
        ({"recordings": []}, fcslam.SourceError, "no recording"),
        ({"recordings": ["LOG", "LOG"]}, fcslam.SourceError, "robot_1"),
        ({"split": 0}, fcslam.SourceError, "0 parts"),
        ({"processes": 0}, fcslam.InputError, "give 1 or more"),
        ({"config": {"sed": 1}}, fcslam.InputError, "did you mean 'seed'"),
        ({"config": "none.yaml"}, fcslam.InputError, "none.yaml"),
        ({"vetoes": [fcslam.Veto("nobody", "robot_1")]}, fcslam.InputError, "nobody"),
        ({"output": "LOG"}, fcslam.InputError, "does not hold a run"),
        ({"bag_options": fcslam.BagOptions(scan_topics=("/scan",))}, fcslam.SourceError, "ROS bags only"),
    ],
)
def test_what_is_wrong_is_an_input_error_of_one_line_before_the_work(arguments, kind, said, logs):
    def filled(value):
        known = {"LOG": logs[0], "TWIN": logs[1]}
        return [filled(item) for item in value] if isinstance(value, list) else known.get(str(value), value)

    given = {"recordings": "LOG", **arguments}
    with pytest.raises(fcslam.InputError, match=re.escape(said)) as raised:
        fcslam.map_recordings(
            **{name: filled(value) for name, value in given.items()}, progress=lambda _: pytest.fail("worked")
        )
    assert raised.type is kind
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("pose", "said"), [((1.0, 2.0), "give (x, y, theta)"), ((1e3, 0.0, 0.0), "is outside of the map")]
)
def test_a_start_that_no_map_has_is_refused_before_the_work(pose, said, logs, opened):
    with pytest.raises(fcslam.InputError, match=re.escape(said)) as raised:
        fcslam.localize(logs[0], opened.maps[0], initial_pose=pose, progress=lambda _: pytest.fail("worked"))
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_the_example_of_the_readme_prints_what_it_says(tmp_path, monkeypatch):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    ((example, said),) = re.findall(r"```python\n(.*?)```\n+```text\n(.*?)```", text, re.DOTALL)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(example, "README.md", "exec"), {})
    number = re.compile(r"-?\d+(?:\.\d+)?")
    assert number.sub("#", printed.getvalue()) == number.sub("#", said)
    numbers = [[float(text) for text in number.findall(words)] for words in (printed.getvalue(), said)]
    assert numbers[0] == pytest.approx(numbers[1], rel=0.1, abs=0.1)
