"""`fcslam tools federate`: a whole run of real robots, its resuming, and what bad input is answered."""

import contextlib
import csv
import io

import cv2
import pytest
import yaml

from fcslam.cli import BAD_INPUT, main
from tests.learning.textures import textured

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")
pytest.importorskip("onnx", reason="needs fcslam[federated]")

TINY = {
    "rounds": 2,
    "local_steps": 2,
    "training": {"pairs": 1, "side_px": 64, "label_copies": 1},
}
pytestmark = pytest.mark.usefixtures("brief_validation")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Three robots: two with images, one without."""
    made = tmp_path_factory.mktemp("fleet")
    for robot, seeds in (("one", (1, 2, 3)), ("two", (4, 5)), ("bare", ())):
        (made / robot).mkdir()
        for seed in seeds:
            cv2.imwrite(str(made / robot / f"{seed}.png"), textured(seed, 128, 96))
    (made / "public").mkdir()
    cv2.imwrite(str(made / "public" / "9.png"), textured(9, 128, 96))
    (made / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    return made


def federate(fleet, output, *more, robots=("one", "two", "bare")):
    folders = [str(fleet / robot) for robot in robots]
    settings = ["--config", str(fleet / "tiny.yaml")]
    return main(["tools", "federate", *folders, "--output", str(output), *settings, *more])


@pytest.fixture(scope="module")
def run(fleet, tmp_path_factory, brief_validation):
    """The folder of one round, in which the same command with two rounds went on, and what that command said."""
    output, public = tmp_path_factory.mktemp("run") / "fleet", ("--public", str(fleet / "public"))
    assert federate(fleet, output, *public, "--config", "rounds=1") == 0
    with contextlib.redirect_stderr(io.StringIO()) as said:
        assert federate(fleet, output, *public) == 0
    return output, said.getvalue()


def rows_of(folder):
    with (folder / "rounds.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_a_run_folder_holds_everything(run, fleet):
    run, _ = run
    for name in ("config.yaml", "rounds.csv", "checkpoint.state", "rounds.png", "card.md"):
        assert (run / name).stat().st_size > 100
    rows = rows_of(run)
    assert [row["robots"] for row in rows] == ["one | two"] * 2
    assert all("bare" in row["left_out"] and "holds no image" in row["left_out"] for row in rows)
    assert all(int(row["bytes_up"]) == 2 * int(row["bytes_down"]) / 3 > 1e6 for row in rows)
    assert yaml.safe_load((run / "config.yaml").read_text())["rounds"] == 2


@pytest.mark.slow
def test_the_delivered_detector_runs(run, fleet, tmp_path):
    run, _ = run
    arguments = ["tools", "extract", str(fleet / "one"), "--output", str(tmp_path / "out")]
    assert main([*arguments, "--detector", str(run / "detector.onnx")]) == 0
    assert len(list((tmp_path / "out").rglob("*.npz"))) == 3


@pytest.mark.slow
def test_labels_are_all_that_is_kept_of_images(run):
    run, _ = run
    suffixes = {file.suffix for file in run.rglob("*") if file.is_file()}
    assert suffixes <= {".yaml", ".csv", ".state", ".onnx", ".png", ".md"}
    assert {file.name for file in run.rglob("*.png")} == {"rounds.png"}


@pytest.mark.slow
def test_the_same_command_with_more_rounds_goes_on(run, fleet, tmp_path):
    run, said = run
    assert "round 2/2" in said
    assert "round 1/2" not in said.partition("round 2/2")[2]
    assert [row["round"] for row in rows_of(run)] == ["1", "2"]
    begun = tmp_path / "begun"
    start = ("--start", str(run / "checkpoint.state"), "--config", "rounds=1")
    assert federate(fleet, begun, *start, robots=("one", "two")) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{fleet}/one", "{fleet}/one", "-o", "{out}"], "two folders are called one"),
        (["{fleet}/nobody", "-o", "{out}"], "nobody: is not a folder"),
        (["{fleet}/one", "-o", "{out}", "--config", "strategy=best"], "strategy"),
        (["{fleet}/one", "-o", "{out}", "--public", "{fleet}/bare"], "holds no image"),
        (["{fleet}/one", "-o", "{fleet}/tiny.yaml"], "choose another output folder"),
        (["{fleet}/one", "-o", "{out}", "--start", "{fleet}/tiny.yaml"], "tiny.yaml: is damaged"),
    ],
)
def test_bad_input_is_one_line(arguments, words, fleet, tmp_path, refused):
    given = [word.format(fleet=fleet, out=tmp_path / "out") for word in arguments]
    assert words in refused("tools", "federate", *given)


@pytest.mark.slow
def test_a_fleet_without_images_is_said(run, fleet, tmp_path, capsys):
    start = ("--start", str(run[0] / "checkpoint.state"))
    assert federate(fleet, tmp_path / "run", *start, robots=("bare",)) == BAD_INPUT
    assert "no version can be evaluated: bare: " in capsys.readouterr().err
