"""A fleet on disk: two simulations give the same bytes; a folder in use and a full disk are one line each."""

from pathlib import Path

import pytest

from fcslam.cli import main
from tests.full_disk import largest_file
from tests.small_fleet import contents

FLEET = ["--building", "flat", "--path-length", "4", "--robots", "2", "--no-camera", "--seed", "2"]
COMMAND = ["tools", "simulate", *FLEET]


@pytest.mark.slow
def test_the_same_command_writes_the_same_bytes_and_no_folder_twice(tmp_path, capsys):
    for name in ("one", "two"):
        assert main([*COMMAND, "--output", str(tmp_path / name)]) == 0
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert main([*COMMAND, "--output", str(tmp_path / "one")]) == 2
    assert "is not empty; choose another place" in capsys.readouterr().err
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_a_full_disk_is_one_line_and_leaves_no_half_recording(tmp_path, capsys):
    with largest_file(50_000):
        assert main([*COMMAND, "--output", str(tmp_path / "full")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "cannot be written (File too large)" in line
    assert contents(tmp_path / "full").keys() == {Path("simulation.yaml")}
