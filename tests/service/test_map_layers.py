"""Layers of a map: files of a run folder and days of a mission in, shapes in metres of the map out."""

import json
import os
import re

import numpy as np
import pytest

from fcslam import untrusted
from fcslam.errors import InputError
from fcslam.maps.exports import outlines
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.page.report import ShownRun
from fcslam.service.map_layers import MOST_LAYER_BYTES, MapLayer, layers_of, map_shapes
from tests.mission.test_map_changes import write_run

PLAN = {
    "drawing": "M0.00 0.00L4.00 0.00z",
    "maps": [
        {
            "map": 0, "aligned": True,
            "deviations": [
                {"kind": "moved", "start": [1.0, 2.0], "end": [3.0, 2.0], "length_m": 2.0, "by_m": 0.32},
                {"kind": "missing", "start": [0.0, 0.0], "end": [0.0, 4.0], "length_m": 4.0, "by_m": None},
            ],
        },
        {"map": 1, "aligned": False, "reason": "the map has no walls"},
    ],
}  # fmt: skip
TAGS = {
    "tags": [
        {"family": "4x4_50", "number": 7, "map": 0, "x": 1.0, "y": 2.0, "doubtful": True},
        {"family": "4x4_50", "number": 8, "map": 1, "x": 5.0, "y": 5.0, "doubtful": False},
    ]
}
QUALITY = {"0": {"cell": 1.0, "cells": [{"x": 0.5, "y": 0.5, "good": True}, {"x": 1.5, "y": 0.5, "good": False}]}}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two days; the second one has another box."""
    folder = write_run(tmp_path_factory.mktemp("runs") / "building", (0, 1))
    for name, content in {"plan": PLAN, "tags": TAGS, "quality": QUALITY}.items():
        (folder / f"{name}.json").write_text(json.dumps(content))
    with ShownRun(folder) as shown:
        yield shown


def points(path):
    return np.array([list(map(float, pair)) for pair in re.findall(r"(-?[\d.]+) (-?[\d.]+)", path)])


def test_a_map_names_its_layers(run, tmp_path):
    assert {*layers_of(run, 0)} == {"plan", "tags", "quality", "changes"}
    write_run(tmp_path / "one-day", (0,))
    with ShownRun(tmp_path / "one-day") as shown:
        assert layers_of(shown, 0) == []
        assert map_shapes(shown, 0, MapLayer.CHANGES) == []


def test_a_plan_has_its_lines_and_what_differs_from_them(run):
    plan, moved, missing = map_shapes(run, 0, MapLayer.PLAN)
    assert (plan.kind, plan.path) == ("plan", PLAN["drawing"])
    assert (moved.kind, moved.path, moved.text, moved.x, moved.y) == (
        "moved", "M1.0 2.0L3.0 2.0", "moved by 0.32 m", 2.0, 2.0
    )  # fmt: skip
    assert (missing.kind, missing.text) == ("missing", "")
    assert map_shapes(run, 1, MapLayer.PLAN) == []


def test_tags_and_accuracy_are_those_of_the_map(run):
    (tag,) = map_shapes(run, 0, MapLayer.TAGS)
    assert (tag.kind, tag.text, tag.x, tag.y) == ("tag", "tag 7 (moved, or there twice)", 1.0, 2.0)
    assert [(s.kind, s.path) for s in map_shapes(run, 0, MapLayer.QUALITY)] == [
        ("good", "M0.0 0.0h1.0v1.0h-1.0z"), ("bad", "M1.0 0.0h1.0v1.0h-1.0z")
    ]  # fmt: skip
    assert map_shapes(run, 1, MapLayer.QUALITY) == []


def test_changes_lie_where_boxes_came_and_went(run):
    shapes = {shape.kind: points(shape.path) for shape in map_shapes(run, 0, MapLayer.CHANGES)}
    for kind, box in (("appeared", (1.0, -1.0)), ("disappeared", (1.0, 1.0))):
        assert np.abs(shapes[kind] - box).max() < 0.5


@pytest.mark.attack
def test_packets_that_expand_too_much_are_not_decoded_and_read_once(tmp_path, monkeypatch):
    with ShownRun(write_run(tmp_path / "bomb", (0, 1))) as shown:
        monkeypatch.setattr(untrusted, "FREE_BYTES", -(10**12))
        for _ in range(2):
            with pytest.raises(InputError, match="limit"):
                map_shapes(shown, 0, MapLayer.CHANGES)


@pytest.mark.attack
def test_changes_of_maps_that_are_not_there_read_no_packets(tmp_path, monkeypatch):
    with ShownRun(write_run(tmp_path / "absent", (0, 1))) as shown:
        monkeypatch.setattr(untrusted, "FREE_BYTES", -(10**12))  # whoever reads them is refused
        assert [map_shapes(shown, k, MapLayer.CHANGES) for k in (1, 2, 2**31 - 1)] == [[], [], []]


def test_a_trajectory_without_poses_is_no_session_of_a_map(tmp_path):
    folder = write_run(tmp_path / "empty", (0, 1))
    first, second = (folder / "trajectories" / f"{name}.tum" for name in ("anna", "anna+1"))
    second.write_text("")
    with ShownRun(folder) as shown:
        assert layers_of(shown, 0) == map_shapes(shown, 0, MapLayer.CHANGES) == []
    first.write_text("")
    with ShownRun(folder) as shown:
        assert map_shapes(shown, 0, MapLayer.CHANGES) == []


@pytest.mark.parametrize(
    "content",
    [
        '{"maps": [3]}',
        "[" * 200_000,
        json.dumps(PLAN).replace("missing", "tag"),
        json.dumps(PLAN).replace("[1.0, 2.0]", f"[{10**400}, 2]"),
        "",
    ],
    ids=["wrong", "nested", "unknown kind", "huge number", "too large"],
)
def test_a_broken_file_is_named(tmp_path, content):
    folder = write_run(tmp_path / "broken", (0,))
    (folder / "plan.json").write_text(content)
    if not content:
        os.truncate(folder / "plan.json", MOST_LAYER_BYTES + 1)
    with ShownRun(folder) as shown, pytest.raises(InputError, match=r"plan\.json"):
        map_shapes(shown, 0, MapLayer.PLAN)


def test_a_file_that_is_a_link_is_not_followed(tmp_path):
    folder = write_run(tmp_path / "linked", (0,))
    (tmp_path / "other.json").write_text(json.dumps(TAGS))
    (folder / "tags.json").symlink_to(tmp_path / "other.json")
    with ShownRun(folder) as shown, pytest.raises(InputError, match=r"tags\.json"):
        map_shapes(shown, 0, MapLayer.TAGS)


def test_outlines_run_through_the_middles_of_cells_and_around_holes():
    mask = np.zeros((10, 12), bool)
    mask[2:8, 3:9] = True
    mask[4:6, 5:7] = False
    occupancy = OccupancyMap(np.zeros(mask.shape, np.uint8), 0.5, (-1.0, 2.0))
    path = outlines(mask, occupancy)
    assert path.count("M") == path.count("z") == 2
    found = points(path)
    assert found.min(axis=0).tolist() == [0.75, 3.25]
    assert found.max(axis=0).tolist() == [3.25, 5.75]
