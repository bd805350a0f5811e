"""`fcslam tools vocabulary`, and robots that send its words: a mission without a range or a descriptor on the wire."""

import json
import shutil

import numpy as np
import pytest
import yaml

from fcslam.cli import main
from fcslam.maps.occupancy_map import OccupancyMap, parse_map
from fcslam.mission.mission_file import read_mission
from fcslam.places.words import read_vocabularies
from fcslam.records import Channel, Constraint, Keyscan, MapTile, WordPlace
from fcslam.wire.messages import Hello

SIMILARITY = {"fusion": "two_point", "matcher": {"decision": "similarity", "delta": 0.4}}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("words")


def read_map(path) -> OccupancyMap:
    return parse_map(path.name, path.with_suffix(".pgm").read_bytes(), path.read_text(encoding="utf-8"))


def mapped(logs, folder, name, settings):
    config = folder / f"{name}.yaml"
    config.write_text(yaml.safe_dump(settings), encoding="utf-8")
    files = [str(log) for log in logs]
    assert main(["map", *files, "--quiet", "--config", str(config), "--output", str(folder / name)]) == 0
    return folder / name


@pytest.fixture(scope="module")
def with_descriptors(logs, folder):
    return mapped(logs, folder, "descriptors", {"robot": {"channels": ["lidar"]}, "fleet": SIMILARITY})


@pytest.fixture(scope="module")
def vocabulary(with_descriptors, folder):
    path = folder / "building.words"
    assert main(["tools", "vocabulary", str(with_descriptors), "--output", str(path), "--words", "1024"]) == 0
    return path


@pytest.fixture(scope="module")
def with_words(logs, folder, vocabulary):
    robot = {"channels": ["lidar"], "sends": "words", "words": {"vocabulary": str(vocabulary)}}
    fleet = {**SIMILARITY, "vocabularies": [str(vocabulary)]}
    return mapped(logs, folder, "words", {"robot": robot, "fleet": fleet})


def test_the_file_has_the_words_of_the_channel(vocabulary):
    (found,) = read_vocabularies(vocabulary)
    assert found.channel is Channel.LIDAR
    assert 900 < len(found.centres) <= 1024


def test_nothing_but_words_and_the_map_leaves_a_robot(with_words):
    bodies = [sized.packet.body for sized in read_mission(with_words).in_order]
    assert {type(body) for body in bodies} == {Hello, Keyscan, Constraint, WordPlace, MapTile}
    assert not any(body.ranges_m.size for body in bodies if isinstance(body, Keyscan))


def test_a_robot_sends_a_fraction_of_the_bytes(with_words, with_descriptors):
    words, descriptors = (
        {row["name"]: row["value"] for row in json.loads((run / "metrics.json").read_text(encoding="utf-8"))}
        for run in (with_words, with_descriptors)
    )
    for robot in (name for name in words if name.startswith("uplink_bytes_")):
        assert words[robot] < 0.4 * descriptors[robot]
    assert words["keyscans"] == descriptors["keyscans"]


def test_the_own_map_of_each_robot_is_that_of_its_ranges(with_words, with_descriptors):
    for path in sorted((with_words / "local").glob("*.yaml")):
        sent, cast = (read_map(run / "local" / path.name) for run in (with_words, with_descriptors))
        assert np.isclose(sent.resolution_m, cast.resolution_m)
        row, column = (
            round((a - b) / cast.resolution_m) for a, b in zip(cast.origin_xy[::-1], sent.origin_xy[::-1], strict=True)
        )
        height, width = cast.cells.shape
        around = np.pad(sent.cells, 256)  # tiles without a known cell are not sent
        same = around[256 + row : 256 + row + height, 256 + column : 256 + column + width] == cast.cells
        assert np.mean(same) > 0.99


def test_the_robots_share_a_map_of_their_maps(with_words, with_descriptors):
    words, descriptors = ((run / "robots.csv").read_text(encoding="utf-8") for run in (with_words, with_descriptors))
    columns = [[line.split(",")[:2] for line in text.splitlines()] for text in (words, descriptors)]
    assert columns[0] == columns[1]
    fused = read_map(with_words / "map.yaml")
    assert np.count_nonzero(fused.cells == 1) > 10_000


def test_a_mission_of_words_goes_on_and_gives_the_same(with_words, folder):
    again = folder / "again"
    assert main(["map", "--onto", str(with_words), "--quiet", "--output", str(again)]) == 0
    for name in ("map.pgm", "robots.csv", "closures.csv"):
        assert (again / name).read_bytes() == (with_words / name).read_bytes()


def test_a_cloud_without_the_vocabulary_refuses_it_by_name(logs, folder, vocabulary, capsys):
    robot = {"channels": ["lidar"], "sends": "words", "words": {"vocabulary": str(vocabulary)}}
    config = folder / "stranger.yaml"
    config.write_text(yaml.safe_dump({"robot": robot, "fleet": SIMILARITY}), encoding="utf-8")
    assert main(["map", str(logs[0]), "--config", str(config), "--output", str(folder / "stranger")]) == 2
    digest = read_vocabularies(vocabulary)[0].digest.hex()[:12]
    refusal = f"sends words of lidar vocabulary {digest}; the cloud has none (fleet.vocabularies)"
    assert refusal in capsys.readouterr().err


@pytest.mark.parametrize("words", ["1", "65537"])
def test_a_number_of_words_beyond_the_format_is_refused(words, tmp_path, capsys):
    assert main(["tools", "vocabulary", str(tmp_path), "-o", str(tmp_path / "x"), "--words", words]) == 2


def test_a_run_without_places_is_one_line(with_words, tmp_path, capsys):
    assert main(["tools", "vocabulary", str(with_words), "-o", str(tmp_path / "x")]) == 2
    assert "no place with descriptors" in capsys.readouterr().err


def test_changes_are_not_found_where_robots_send_words(with_words, tmp_path, capsys):
    assert main(["tools", "changes", str(with_words), "--output", str(tmp_path / "changes")]) == 2
    assert "sent ranges (robot.sends: words)" in " ".join(capsys.readouterr().err.split())


def test_regions_count_in_a_map_of_words_and_a_removed_stretch_stays_in_it(with_words, tmp_path):
    run, edited = tmp_path / "run", tmp_path / "edited"
    shutil.copytree(with_words, run)
    robot = np.loadtxt(sorted((run / "trajectories").glob("*.tum"))[0])
    name = sorted((run / "trajectories").glob("*.tum"))[0].stem
    x, y = robot[0, 1:3]
    assert main(["edit", "erase", str(run), f"{x - 0.5},{y - 0.5} {x + 0.5},{y + 0.5}"]) == 0
    assert main(["edit", "remove", str(run), name, "--from", str(robot[-9, 0]), "--to", str(robot[-1, 0])]) == 0
    assert main(["map", "--onto", str(run), "--quiet", "--output", str(edited)]) == 0
    before, after = (read_map(folder / "map.yaml") for folder in (run, edited))
    row, column = ((np.array([y, x]) - before.origin_xy[::-1]) / before.resolution_m).astype(int)
    assert before.cells[row, column] == 1
    assert after.cells[row, column] == 0
    assert (run / "local" / f"{name}.pgm").read_bytes() == (edited / "local" / f"{name}.pgm").read_bytes()


def test_a_file_of_another_kind_is_not_replaced(with_descriptors, tmp_path, capsys):
    recording = tmp_path / "robot1.bag"
    recording.write_bytes(b"a recording")
    assert main(["tools", "vocabulary", str(with_descriptors), "-o", str(recording)]) == 2
    assert recording.read_bytes() == b"a recording"
    assert "is not a vocabulary, so it stays" in capsys.readouterr().err
    words = tmp_path / "building.words"
    assert [
        main(["tools", "vocabulary", str(with_descriptors), "-o", str(words), "--words", "16"]) for _ in range(2)
    ] == [0, 0]
