"""Features of images of every sort, and the files that hold them."""

import cv2
import numpy as np
import pytest
from evaluation.place_features import read_features

from fcslam.cli import main
from fcslam.errors import FeatureError
from fcslam.features.classical import Orb
from fcslam.features.detector import NO_FEATURES
from fcslam.features.files import extract, read_grey, write_features
from tests.features.networks import tiny_network
from tests.features.pictures import picture
from tests.lidar.worlds import room


@pytest.fixture(scope="module")
def image():
    return picture(np.array([-1.5, -1.0, 0.2]), room())


@pytest.fixture
def images(tmp_path, image):
    """The same picture in every sort of file, and files that are none."""
    folder = tmp_path / "images"
    (folder / "below").mkdir(parents=True)
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    sorts = {
        "grey.png": image,
        "colour.png": colour,
        "below/deep.png": image.astype(np.uint16) * 257,
        "alpha.png": np.dstack((colour, np.full_like(image, 7))),
        "lossy.jpg": image,
        "plain.ppm": colour,
        "tiny.png": image[:3, :5],
        "flat.png": np.full((64, 64), 90, np.uint8),
    }
    for name, pixels in sorts.items():
        assert cv2.imwrite(str(folder / name), pixels)
    (folder / "notes.txt").write_text("no image")
    (folder / "broken.png").write_bytes((folder / "grey.png").read_bytes()[:40])
    (folder / "empty.jpg").write_bytes(b"")
    return folder


def test_every_sort_of_image_gives_the_same_features(images, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["tools", "extract", str(images), "-o", str(out), "--detector", "orb", "--keypoints", "200"]) == 0
    shown = capsys.readouterr()
    assert "features of 8 images, 2 of them without a keypoint, 3 files skipped" in shown.out
    assert shown.err.count("skipped: ") == 3
    grey, size = read_features(out / "grey.npz")
    assert size == (320, 240)
    assert 150 < len(grey.scores) <= 200
    for name in ("colour", "below/deep", "alpha", "plain"):
        other, _ = read_features(out / f"{name}.npz")
        assert np.array_equal(other.descriptors, grey.descriptors)
        assert np.array_equal(other.keypoints_px, grey.keypoints_px)
    for name, size in (("tiny", (5, 3)), ("flat", (64, 64))):
        nothing, stated = read_features(out / f"{name}.npz")
        assert (nothing.keypoints_px.shape, nothing.descriptors.shape, stated) == ((0, 2), (0, 32), size)


def test_the_file_is_as_documented(images, tmp_path):
    main(["tools", "extract", str(images / "grey.png"), "-o", str(tmp_path), "--detector", "orb"])
    with np.load(tmp_path / "grey.npz", allow_pickle=False) as archive:
        assert {name: (archive[name].dtype.str, archive[name].ndim) for name in archive.files} == {
            "keypoints": ("<f4", 2),
            "scores": ("<f4", 1),
            "descriptors": ("|u1", 2),
            "image_size": ("<i4", 1),
        }
        assert np.all(np.diff(archive["scores"]) <= 0)
        assert archive["image_size"].tolist() == [320, 240]


def test_larger_images_are_shrunk_and_keypoints_are_in_their_own_pixels(image):
    large = cv2.resize(image, (1280, 960), interpolation=cv2.INTER_NEAREST)
    small = Orb().detect(image)
    found = extract(large, Orb(), 320)
    assert np.array_equal(found.descriptors, small.descriptors)
    assert np.allclose(found.keypoints_px, 4.0 * small.keypoints_px + 1.5)  # pixel 0 became pixels 0 to 3
    assert extract(image, Orb(), 320).keypoints_px.tolist() == small.keypoints_px.tolist()


def test_networks_extract_as_well(images, tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    tiny_network(tmp_path / "n.onnx")
    detector = ("--detector", str(tmp_path / "n.onnx"))
    assert main(["tools", "extract", str(images), "-o", str(tmp_path / "out"), *detector]) == 0
    assert "tiny-1: features of 8 images, 3 files skipped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{folder}/missing", "-o", "{folder}/out"], "no file there"),
        (["{folder}/images/notes.txt", "-o", "{folder}/out"], "no usable image there"),
        (["{folder}/images", "-o", "{folder}/images/notes.txt"], "cannot be"),
        (["{folder}/images", "-o", "{folder}/out", "--detector", "missing.onnx"], "cannot read the network weights"),
    ],
)
def test_mistakes_are_told(images, tmp_path, capsys, arguments, message):
    assert main(["tools", "extract", *(word.format(folder=tmp_path) for word in arguments)]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_two_images_of_one_name_are_told_apart(tmp_path, image, capsys):
    for name in ("a.png", "a.jpg"):
        cv2.imwrite(str(tmp_path / name), image)
    assert main(["tools", "extract", str(tmp_path), "-o", str(tmp_path / "out"), "--detector", "orb"]) == 0
    assert "a.png: has the features' name in common with" in capsys.readouterr().err
    assert main(["tools", "extract", str(tmp_path), "-o", str(tmp_path / "out"), "--detector", "orb"]) == 0
    assert "features of 1 images, 1 files skipped" in capsys.readouterr().out  # its own output is no input


def test_images_beyond_any_cameras_size_are_not_decoded(tmp_path):
    header = b"\x89PNG\r\n\x1a\n" + b"\x00\x00\x00\rIHDR" + (1 << 20).to_bytes(4, "big") * 2
    (tmp_path / "huge.png").write_bytes(header + bytes(20))
    with pytest.raises(FeatureError, match="cannot be read as an image"):
        read_grey(tmp_path / "huge.png")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"descriptors": np.zeros((3, 32), np.float32)}, "float32"),
        ({"descriptors": np.zeros((3, 16), np.uint8)}, r"\(3, 16\)"),
        ({"scores": np.zeros(2, np.float32)}, r"scores \(2,\)"),
        ({"keypoints": np.full((3, 2), np.nan, np.float32)}, "finite"),
        ({"image_size": np.array(["a", "b"])}, "finite numbers"),
        ({"keypoints": None}, "cannot read the features"),
        ({"keypoints": np.array([object()] * 3)}, "cannot read the features"),
    ],
)
def test_features_of_other_programs_are_checked(tmp_path, change, message):
    arrays = {
        "keypoints": np.zeros((3, 2), np.float32),
        "scores": np.zeros(3, np.float32),
        "descriptors": np.zeros((3, 32), np.uint8),
        "image_size": np.array([64, 48]),
    } | change
    np.savez(tmp_path / "f.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(FeatureError, match=message):
        read_features(tmp_path / "f.npz")


def test_what_is_written_is_read_again_the_strongest_first(tmp_path, image):
    features = Orb().detect(image)
    write_features(tmp_path / "f.npz", features.take(np.arange(len(features.scores))[::-1]), (320, 240))
    again, size = read_features(tmp_path / "f.npz")
    assert size == (320, 240)
    assert np.array_equal(again.scores, features.scores)
    assert sorted(map(bytes, again.descriptors)) == sorted(map(bytes, features.descriptors))


def test_taking_some_takes_all_that_is_known_of_them(image):
    features = Orb().detect(image)
    some = features.take(np.array([5, 2]))
    assert np.array_equal(some.descriptors, features.descriptors[[5, 2]])
    assert np.array_equal(some.scores, features.scores[[5, 2]])
    assert not some.descriptors.flags.writeable
    assert len(NO_FEATURES.take(slice(3)).scores) == 0
