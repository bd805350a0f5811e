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
    "training": {"shape_steps": 2, "pairs": 1, "side_px": 64, "label_copies": 1},
}
pytestmark = pytest.mark.usefixtures("brief_validation")
TLS_ONLY, ALL = ("--credentials", "{fleet}/tls"), ("--credentials", "{fleet}/all")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Three robots: two with images, one without."""
    made = tmp_path_factory.mktemp("fleet")
    for robot, seeds in (("one", (1, 2, 3)), ("two", (4, 5)), ("bare", ())):
        (made / robot).mkdir()
        for seed in seeds:
            cv2.imwrite(str(made / robot / f"{seed}.png"), textured(seed))
    (made / "public").mkdir()
    cv2.imwrite(str(made / "public" / "9.png"), textured(9))
    (made / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    for folder, names in {
        "tls": ("cloud.pem", "cloud.key"),
        "all": ("cloud.pem", "cloud.key", "tokens.yaml"),
        "mine": ("ca.pem",),
    }.items():
        (made / folder).mkdir()
        for name in names:
            (made / folder / name).write_text("x")
    return made


def federate(fleet, output, *more, robots=("one", "two", "bare")):
    folders = [str(fleet / robot) for robot in robots]
    settings = ["--config", str(fleet / "tiny.yaml")]
    return main(["tools", "federate", "local", *folders, "--output", str(output), *settings, *more])


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
    for name in ("config.yaml", "rounds.csv", "checkpoint.npz", "rounds.png", "card.md"):
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
    assert suffixes <= {".yaml", ".csv", ".npz", ".onnx", ".png", ".md"}
    assert {file.name for file in run.rglob("*.png")} == {"rounds.png"}


@pytest.mark.slow
def test_the_same_command_with_more_rounds_goes_on(run, fleet, tmp_path):
    run, said = run
    assert "round 2/2" in said
    assert "round 1/2" not in said.partition("round 2/2")[2]
    assert [row["round"] for row in rows_of(run)] == ["1", "2"]
    begun = tmp_path / "begun"
    start = ("--start", str(run / "checkpoint.npz"), "--config", "rounds=1")
    assert federate(fleet, begun, *start, robots=("one", "two")) == 0
    assert not (begun / "shapes").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["local", "{fleet}/one", "{fleet}/one", "-o", "{out}"], "two folders are called one"),
        (["local", "{fleet}/nobody", "-o", "{out}"], "nobody: is not a folder"),
        (["local", "{fleet}/one", "-o", "{out}", "--config", "strategy=best"], "strategy"),
        (["local", "{fleet}/one", "-o", "{out}", "--public", "{fleet}/bare"], "holds no image"),
        (
            ["local", "{fleet}/one", "-o", "{fleet}/tiny.yaml"],
            "choose another output folder",
        ),
        (
            ["local", "{fleet}/one", "-o", "{out}", "--start", "{fleet}/tiny.yaml"],
            "is not a checkpoint",
        ),
        (["serve", "nowhere", "-o", "{out}", "--insecure"], "nowhere: is not a HOST:PORT"),
        (["serve", "a:1", "-o", "{out}"], "give --credentials"),
        (["serve", "a:1", "-o", "{out}", *TLS_ONLY], "give --credentials"),
        (["serve", "a:1", "-o", "{out}", "--insecure", *ALL], "or --insecure"),
        (["serve", "a:1", "-o", "{out}", *ALL], "no certificate with its key"),
        (["join", "http://a:1", "{fleet}/nobody", "-o", "{out}"], "nobody: is not a folder"),
        (["join", "a", "{fleet}/one", "-o", "{out}"], "is not the address of a cloud"),
        (
            ["join", "https://a:1", "{fleet}/one", "-o", "{out}", "--credentials", "{fleet}/mine"],
            "give a PEM",
        ),
        (
            ["join", "http://a:1", "{fleet}/one", "-o", "{out}", "--name", ""],
            "give another --name",
        ),
        (
            ["join", "http://a:1", "{fleet}/one", "-o", "{out}", "--credentials", "{fleet}/no"],
            "holds no credentials",
        ),
    ],
)
def test_bad_input_is_one_line(arguments, words, fleet, tmp_path, capsys):
    given = [word.format(fleet=fleet, out=tmp_path / "out") for word in arguments]
    assert main(["tools", "federate", *given]) == BAD_INPUT
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert words in said[0]


@pytest.mark.parametrize(
    "arguments",
    [
        ["local"],
        ["local", "{fleet}/one", "--insecure"],
        ["local", "{fleet}/one", "--name", "one"],
        ["serve", "a:1", "{fleet}/one"],
        ["serve", "a:1", "--name", "one"],
        ["join", "a:1"],
        ["join", "a:1", "{fleet}/one", "{fleet}/two", "-o", "{out}"],
        ["join", "a:1", "{fleet}/one", "-o", "{out}", "--public", "{fleet}/public"],
        ["join", "a:1", "{fleet}/one", "-o", "{out}", "--config", "rounds=3"],
        ["--local", "{fleet}/one"],
    ],
)
def test_each_subcommand_has_its_own_options_only(arguments, fleet, tmp_path, capsys):
    given = [word.format(fleet=fleet, out=tmp_path / "out") for word in arguments]
    assert main(["tools", "federate", *given]) == BAD_INPUT
    error = capsys.readouterr().err
    assert "Usage: fcslam tools federate" in error
    assert "Traceback" not in error


@pytest.mark.slow
def test_a_fleet_without_images_is_said(run, fleet, tmp_path, capsys):
    start = ("--start", str(run[0] / "checkpoint.npz"))
    assert federate(fleet, tmp_path / "run", *start, robots=("bare",)) == BAD_INPUT
    assert "no round can be completed: bare: " in capsys.readouterr().err
