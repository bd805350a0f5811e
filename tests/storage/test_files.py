"""A file or a folder is replaced as a whole, whatever ends the process."""

from pathlib import Path

import pytest

from fcslam.storage.files import bring_back, replacing_folder, write_file


class KilledError(BaseException):
    """Ends a process at once."""


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "run [1]"
    place.mkdir()
    (place / "a").write_text("old")
    return place


def replace_content(folder):
    with replacing_folder(folder) as unfinished:
        (unfinished / "a").write_text("new")


def test_a_folder_is_replaced(folder):
    replace_content(folder)
    assert (folder / "a").read_text() == "new"
    assert [entry.name for entry in folder.parent.iterdir()] == [folder.name]


def test_a_folder_comes_back_after_a_kill_between_the_two_steps(folder):
    retired = folder.with_name(f".{folder.name}.4711.retired")
    folder.rename(retired)  # as the process left it
    bring_back(folder)
    assert (folder / "a").read_text() == "old"
    assert not retired.exists()


def test_what_is_there_stays_when_an_older_one_was_left(folder):
    left = folder.with_name(f".{folder.name}.4711.retired")
    left.mkdir()
    bring_back(folder)
    assert (folder / "a").read_text() == "old"


def test_the_old_folder_counts_if_the_next_replacement_fails(folder):
    folder.rename(folder.with_name(f".{folder.name}.4711.retired"))
    with pytest.raises(KilledError), replacing_folder(folder):
        raise KilledError
    assert (folder / "a").read_text() == "old"


def test_a_file_reaches_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    place, synced = tmp_path / "file", []

    def sync(number):
        synced.append((Path(f"/proc/self/fd/{number}").resolve().name, place.exists()))

    monkeypatch.setattr("os.fsync", sync)
    write_file(place, b"content")
    assert synced == [(".file.partial", False)]
    assert place.read_bytes() == b"content"
