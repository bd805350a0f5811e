"""`fcslam train`: one small run from images to files, and what it says of bad input."""

import cv2
import pytest

from fcslam.cli import BAD_INPUT, main
from tests.learning.textures import textured

OPTIONS = ["--device", "cpu"]
pytestmark = pytest.mark.usefixtures("brief_validation")


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    (folder / "inner").mkdir(parents=True)
    for seed in range(3):
        cv2.imwrite(str(folder / f"{seed}.png"), textured(seed))
    cv2.imwrite(str(folder / "inner" / "colour.jpg"), cv2.applyColorMap(textured(7), cv2.COLORMAP_JET))
    cv2.imwrite(str(folder / "inner" / "deep.png"), textured(8).astype("uint16") * 257)
    (folder / "broken.jpg").write_bytes(b"no image")
    cv2.imwrite(str(folder / "tiny.png"), textured(1)[:20, :20])
    return folder


def complaint(capsys, *arguments):
    assert main(["train", *map(str, arguments), *OPTIONS, "--quiet"]) == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.slow
def test_images_become_a_detector_and_a_second_call_goes_on(photos, tmp_path, capsys):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    settings = tmp_path / "settings.yaml"
    settings.write_text("{steps: 2, shape_steps: 2, pairs: 1, side_px: 64, points: 32, label_copies: 1}")
    output = photos / "out"  # what is in there is no image to train on
    arguments = ["train", str(photos), "-o", str(output), "--config", str(settings), *OPTIONS]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    made = ["detector.onnx", "detector-int8.onnx", "training.png", "card.md"]
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
    assert main([*arguments, "--steps", "3"]) == 0
    assert (output / "detector.onnx").read_bytes() != first
    kept = (output / "detector.onnx").read_bytes(), (output / "card.md").read_text()
    capsys.readouterr()
    assert "has 3 steps already, more than 2" in complaint(capsys, photos, "-o", output, "--config", settings)
    cv2.imwrite(str(photos / "later.png"), textured(9))
    more = [photos, "-o", output, "--config", settings, "--steps", "3"]
    assert "was trained on other images" in complaint(capsys, *more)
    assert kept == ((output / "detector.onnx").read_bytes(), (output / "card.md").read_text())


def test_bad_input_is_one_line(photos, tmp_path, capsys):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    output = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    assert "is no folder" in complaint(capsys, tmp_path / "nowhere", "-o", output)
    assert "holds no image" in complaint(capsys, tmp_path / "empty", "-o", output)
    assert "encoder" in complaint(capsys, photos, "-o", output, "--encoder", "huge")
    assert "x.npz" not in complaint(capsys, photos, "-o", output, "--teacher", tmp_path / "empty")
    assert not (output / "joint" / "checkpoint.npz").exists()


def test_a_folder_of_no_use_is_one_line(tmp_path, capsys):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    folder = tmp_path / "photos"
    folder.mkdir()
    cv2.imwrite(str(folder / "wall.png"), 0 * textured(0))
    teacher = tmp_path / "teacher"
    assert "0 of 1 image files" in complaint(capsys, folder, "-o", tmp_path / "out", "--teacher", teacher)
    assert "0 of 1 image files" in complaint(capsys, folder, "-o", tmp_path / "out")
    assert not (tmp_path / "out" / "shapes").exists(), "it is said before the training on shapes"


def test_without_torch_it_says_what_to_install(photos, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("fcslam.cli.training_options.find_spec", lambda _: None)
    assert "pip install 'fcslam[train]'" in complaint(capsys, photos, "-o", tmp_path / "out")
