"""Images of a folder: which are found, which are used, which are held out."""

import cv2
import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.learning.images import LARGEST_SIDE_PX, find_images, is_held_out, is_usable, read_image
from tests.learning.textures import textured


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def test_images_of_all_folders_are_found_under_their_names(tmp_path):
    write(tmp_path / "x" / "a" / "1.png", textured(1))
    write(tmp_path / "x" / "0.JPG", textured(2))
    write(tmp_path / "y" / "1.png", textured(3))
    (tmp_path / "x" / "notes.txt").write_text("no image")
    names = [file.name for file in find_images([tmp_path / "y", tmp_path / "x"])]
    assert names == ["x/0.JPG", "x/a/1.png", "y/1.png"]


def test_images_of_no_use_are_counted(tmp_path):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    from fcslam.learning.stages import read_images

    write(tmp_path / "x" / "0.png", textured(0)[:20, :20])
    for seed in range(1, 6):
        write(tmp_path / "x" / f"{seed}.png", textured(seed))
    images, skipped = read_images(find_images([tmp_path / "x"]))
    assert (len(images), skipped) == (5, 1)


def teach(folder, name, size=8, seed=0):
    """A file of a teacher with descriptors of this size."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    keypoints, scores = rng.uniform(10, 100, (20, 2)), rng.uniform(size=20)
    np.savez(folder / f"{name}.npz", keypoints=keypoints, scores=scores, descriptors=rng.normal(size=(20, size)))


def labelled(folder, teacher=None, copies=0, cache="labels"):
    from fcslam.learning.settings import TrainingSettings
    from fcslam.learning.stages import label_images, read_images

    found, settings = read_images(find_images([folder / "x"])), TrainingSettings(label_copies=copies)
    return label_images(found, folder / cache, settings, None, teacher).train


def test_files_of_two_teachers_are_refused(tmp_path):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    for seed, size in ((1, 8), (2, 8), (3, 16)):
        write(tmp_path / "x" / f"{seed}.png", textured(seed))
        teach(tmp_path / "teacher" / "x", f"{seed}.png", size)
    with pytest.raises(InputError, match=r"3\.png\.npz: has descriptors of another size .*8 and 16"):
        labelled(tmp_path, tmp_path / "teacher")


def test_another_teacher_gives_other_labels(tmp_path):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    for seed in (1, 2):
        write(tmp_path / "x" / f"{seed}.png", textured(seed))
        teach(tmp_path / "teacher" / "x", f"{seed}.png", seed=1)
    first, again = (labelled(tmp_path, tmp_path / "teacher")[0].labels.keypoints for _ in range(2))
    teach(tmp_path / "teacher" / "x", "1.png", seed=2)
    other = labelled(tmp_path, tmp_path / "teacher")[0].labels.keypoints
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_other_settings_of_labels_give_other_labels(tmp_path):
    pytest.importorskip("torch", reason="needs fcslam[train]")
    for seed in (1, 2):
        write(tmp_path / "x" / f"{seed}.png", textured(seed))

    def keypoints(copies, cache):
        return labelled(tmp_path, copies=copies, cache=cache)[0].labels.keypoints

    first = keypoints(0, "labels")
    assert np.array_equal(keypoints(3, "labels"), keypoints(3, "new"))
    assert not np.array_equal(first, keypoints(3, "labels"))


def test_folders_of_one_name_with_the_same_files_are_refused(tmp_path):
    for place in ("here", "there"):
        write(tmp_path / place / "photos" / "1.png", textured(1))
    with pytest.raises(InputError, match="same name"):
        find_images([tmp_path / "here" / "photos", tmp_path / "there" / "photos"])


@pytest.mark.parametrize("kind", ["grey", "colour", "alpha", "deep"])
def test_every_kind_of_image_becomes_grey(tmp_path, kind):
    grey = textured(5)
    image = {
        "grey": grey,
        "colour": cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR),
        "alpha": cv2.cvtColor(grey, cv2.COLOR_GRAY2BGRA),
        "deep": grey.astype(np.uint16) * 257,
    }[kind]
    write(tmp_path / "1.png", image)
    assert read_image(tmp_path / "1.png").astype(int) == pytest.approx(grey.astype(int), abs=1)


def test_huge_images_are_shrunk_and_others_are_not(tmp_path):
    write(tmp_path / "huge.png", textured(1, 1600, 800))
    assert read_image(tmp_path / "huge.png").shape == (LARGEST_SIDE_PX // 2, LARGEST_SIDE_PX)
    assert read_image(tmp_path / "nowhere.png") is None


def test_what_teaches_nothing_is_not_used():
    assert is_usable(textured(1))
    assert not is_usable(textured(1)[:90])
    assert not is_usable(np.full((200, 200), 90, np.uint8))


def test_a_small_share_is_held_out_by_name_alone():
    share = np.mean([is_held_out(f"photos/{number}.jpg") for number in range(5000)])
    assert 0.03 < share < 0.05
