"""`fcslam tools train`: one small run from images to files, and what it says of bad input."""

import shutil
import sys

import cv2
import numpy as np
import pytest

from fcslam.cli import BAD_INPUT, main
from tests.learning.textures import textured

pytestmark = pytest.mark.usefixtures("brief_validation")


@pytest.fixture(scope="module")
def some_photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    (folder / "inner").mkdir(parents=True)
    for seed in range(3):
        cv2.imwrite(str(folder / f"{seed}.png"), textured(seed))
    cv2.imwrite(str(folder / "inner" / "colour.jpg"), cv2.applyColorMap(textured(7), cv2.COLORMAP_JET))
    cv2.imwrite(str(folder / "inner" / "deep.png"), textured(8).astype("uint16") * 257)
    (folder / "broken.jpg").write_bytes(b"no image")
    cv2.imwrite(str(folder / "tiny.png"), textured(1)[:20, :20])
    return folder


@pytest.fixture
def photos(some_photos, tmp_path):
    return shutil.copytree(some_photos, tmp_path / "photos")


@pytest.fixture(scope="module")
def first(some_photos, tmp_path_factory, brief_validation):
    """The command of a small run, without its output folder, and the output of one."""
    pytest.importorskip("torch", reason="needs fcslam[train]")
    from fcslam.learning.training_loop import LAST_RATE

    folder = tmp_path_factory.mktemp("first")
    (folder / "settings.yaml").write_text(
        f"{{steps: 2, pairs: 1, side_px: 64, label_copies: 1, learning_rate: {LAST_RATE}}}"
    )
    command = ["tools", "train", str(some_photos), "--config", str(folder / "settings.yaml"), "--output"]
    assert main([*command, str(folder / "first")]) == 0
    return command, folder / "first"


def complaint(capsys, *arguments):
    assert main(["tools", "train", *map(str, arguments)]) == BAD_INPUT
    said = capsys.readouterr().err.splitlines()
    (line,) = (line for line in said if not line.startswith("output: "))  # the heading, if images were read before
    return line


@pytest.mark.slow
def test_images_become_a_detector_and_a_second_call_goes_on(photos, tmp_path, capsys):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    settings = tmp_path / "settings.yaml"
    settings.write_text("{steps: 2, pairs: 1, side_px: 64, label_copies: 1}")
    output = photos / "out"  # what is in there is no image to train on
    arguments = ["tools", "train", str(photos), "-o", str(output), "--config", str(settings)]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    made = ["detector.onnx", "training.png", "card.md"]
    assert captured.out.split() == [str(output / name) for name in made]
    assert "5 images" in captured.err
    assert "2 left out" in captured.err
    card, first = (output / "card.md").read_text(), (output / "detector.onnx").read_bytes()
    assert main(arguments) == 0
    assert (output / "detector.onnx").read_bytes() == first
    assert "Teacher: none" in card
    assert "none was held out" in card
    assert "an image that was trained on" in card
    assert "0 held out" in captured.err
    assert "5 images" in capsys.readouterr().err
    assert main([*arguments, "--config", "steps=3"]) == 0
    assert (output / "detector.onnx").read_bytes() != first
    kept = (output / "detector.onnx").read_bytes(), (output / "card.md").read_text()
    capsys.readouterr()
    assert "has 3 steps already, more than 2" in complaint(capsys, photos, "-o", output, "--config", settings)
    cv2.imwrite(str(photos / "later.png"), textured(9))
    more = [photos, "-o", output, "--config", settings, "--config", "steps=3"]
    assert "was trained on other images" in complaint(capsys, *more)
    assert kept == ((output / "detector.onnx").read_bytes(), (output / "card.md").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("file", ["joint/checkpoint.state", "detector.onnx"])
def test_training_starts_from_given_weights(file, first, photos, tmp_path, capsys):
    from fcslam.learning.federated.initial_weights import read_detector_weights
    from fcslam.learning.federated.networks import weights_version
    from fcslam.learning.training_loop import LAST_RATE
    from fcslam.storage.state_file import read_state

    command, first = first
    second, third = (tmp_path / name for name in ("second", "third"))
    assert main([*command, str(second), "--start", str(first / file)]) == 0
    before = read_detector_weights(first / file, "light")
    # Of an ONNX file, with statistics of the batches.
    before = read_state(second / "start.state", weights_version(before, "light")) or before
    after = read_detector_weights(second / "joint" / "checkpoint.state", "light")
    kernels = [name for name, array in before.items() if array.ndim == 4]
    # A step of Adam changes no weight by more than the rate, once its moments are those of one sign.
    moved = max(np.abs(after[name] - before[name]).max() for name in kernels)
    assert 0.0 < moved <= 2.1 * LAST_RATE
    capsys.readouterr()
    assert "from another start" in complaint(capsys, *command[2:5], "-o", second, "--start", second / file)
    assert "0.png: is damaged" in complaint(capsys, photos, "-o", third, "--start", photos / "0.png")
    assert "holds no body" in complaint(capsys, photos, "-o", third, "--start", "vgg")


def test_bad_input_is_one_line(photos, tmp_path, capsys):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    output = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    assert "is not a folder" in complaint(capsys, tmp_path / "nowhere", "-o", output)
    assert "holds no image" in complaint(capsys, tmp_path / "empty", "-o", output)
    assert "encoder" in complaint(capsys, photos, "-o", output, "--config", "encoder=huge")
    assert "x.npz" not in complaint(capsys, photos, "-o", output, "--teacher", tmp_path / "empty")
    assert not (output / "joint" / "checkpoint.state").exists()


def test_a_folder_of_no_use_is_one_line(tmp_path, capsys):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    folder = tmp_path / "photos"
    folder.mkdir()
    cv2.imwrite(str(folder / "wall.png"), 0 * textured(0))
    teacher = tmp_path / "teacher"
    assert "0 of 1 image files" in complaint(capsys, folder, "-o", tmp_path / "out", "--teacher", teacher)
    assert "no image there is large enough" in complaint(capsys, folder, "-o", tmp_path / "out")


def test_without_torch_it_says_what_to_install(photos, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    assert "pip install 'fcslam[train]'" in complaint(capsys, photos, "-o", tmp_path / "out")
