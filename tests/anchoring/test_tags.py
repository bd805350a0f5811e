"""Surveyed tags place and straighten a map; wrong ones do not count; what is wrong with tags is said in one line."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fcslam.anchoring.anchors import Anchors, anchoring_lines
from fcslam.anchoring.part import ROUNDS, Positions, part_of
from fcslam.anchoring.surveyed_tags import read_survey
from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.records import KeyscanId, Tag, TagFamily, TagSighting, frozen
from tests.planned_building import anchored_map, mapped, off_m

FAMILY = TagFamily.APRILTAG_36H11
WALL_TAGS = {1: (4.9, 1.0, np.pi), 2: (2.0, 5.9, -np.pi / 2), 3: (9.9, 1.0, np.pi), 4: (15.9, 2.0, np.pi),
             5: (8.1, 8.0, 0.0)}  # fmt: skip
SIGMA = np.array((0.02, 0.02, 0.02))
SURVEY = {Tag(FAMILY, number): at for number, at in WALL_TAGS.items()}


def sightings(true, tags=WALL_TAGS, scale=1.0, robot="anna", rows=slice(None)):
    """Every tag from each pose within 5 m, with distances ``scale`` times too long."""
    rng = np.random.default_rng(4)
    found = []
    for k in range(len(true))[rows]:
        for number, at in tags.items():
            T = se2.between(true[k], np.array(at)) * (scale, scale, 1.0)
            if np.hypot(*T[:2]) < 5.0:
                T = frozen(se2.compose(T, rng.normal(0.0, 0.3 * SIGMA)))
                found.append(TagSighting(KeyscanId(robot, k), Tag(FAMILY, number), T, frozen(np.diag(SIGMA**-2.0))))
    return tuple(found)


def placed(result, seen, survey=None, by_hand=()):
    return anchored_map(replace(result, sightings=seen), Anchors(survey=survey), by_hand)


def lines(placing):
    return list(anchoring_lines(placing.files))


def test_points_that_a_robot_sees_show_its_heading():
    result, true = mapped(drift_rad=0.05)
    part, (robot,) = part_of(result, 0), result.robots
    arms = np.tile(((4.0, 0.0), (0.0, 3.0)), (len(true), 1))
    numbers = np.repeat(np.arange(len(true)), 2)
    at = se2.compose(true[numbers], np.column_stack((arms, np.zeros(len(arms)))))[:, :2]
    positions = Positions(robot.variables[numbers], arms, at, np.full(len(arms), 1e-3))
    poses = se2.compose(se2.compose(true[0], se2.inverse(robot.T_map_base[0])), part.graph.poses())
    for _ in range(ROUNDS):
        poses = positions.solved(part.graph, poses)
    np.testing.assert_allclose(se2.between(true, poses[robot.variables]), 0.0, atol=1e-3)


def test_surveyed_tags_place_a_map_and_straighten_it():
    result, true = mapped(drift_rad=0.05)
    placing = placed(result, sightings(true), SURVEY)
    assert off_m(placing, true).max() < 0.05
    assert np.array_equal(placing.result.graph.poses(), placing.result.robots[0].T_map_base)
    assert lines(placing) == ["map 0 is placed by surveyed tags: 1, 2, 3, 4, 5"]


def test_a_tag_that_is_not_where_it_was_surveyed_does_not_count():
    result, true = mapped()
    wrong = SURVEY | {Tag(FAMILY, 3): (9.9, 1.5, np.pi)}
    placing = placed(result, sightings(true), wrong)
    assert off_m(placing, true).max() < 0.05
    assert lines(placing)[1:] == ["tag 3 is 0.50 m from where it was surveyed, and does not count"]


def test_one_tag_places_a_map_by_its_yaw_alone():
    result, true = mapped()
    seen = sightings(true, {1: WALL_TAGS[1]})
    assert off_m(placed(result, seen, SURVEY), true).max() < 0.1
    plain = placed(result, seen, {Tag(FAMILY, 1): (4.9, 1.0, None)})
    assert np.array_equal(plain.result.robots[0].T_map_base, result.robots[0].T_map_base)
    assert lines(plain)[0].startswith("map 0 is not placed by surveyed tags: one tag without yaw")


@pytest.mark.parametrize(
    ("tags", "survey", "reason"),
    [
        # Tags 1 and 4 are 11.05 m apart.
        ((1, 4), SURVEY | {Tag(FAMILY, 4): (16.7, 2.0, np.pi)}, "m apart in the map and 11.84 m in the survey"),
        ((1, 4), SURVEY | {Tag(FAMILY, 4): (19.9, 2.0, np.pi)}, "m apart in the map and 15.03 m in the survey"),
        ((1, 6), {Tag(FAMILY, 1): (4.9, 1.0, None), Tag(FAMILY, 6): (4.9, 1.6, None)}, "are less than 1 m apart"),
    ],
)
def test_two_tags_that_contradict_each_other_or_fix_no_heading_place_nothing(tags, survey, reason):
    result, true = mapped()
    hung = WALL_TAGS | {6: (4.9, 1.6, np.pi)}
    placing = placed(result, sightings(true, {number: hung[number] for number in tags}), survey)
    assert np.array_equal(placing.result.robots[0].T_map_base, result.robots[0].T_map_base)
    (line,) = lines(placing)
    assert reason in line


def test_two_tags_place_a_map():
    result, true = mapped()
    seen = sightings(true, {1: WALL_TAGS[1], 4: WALL_TAGS[4]})
    plain = {Tag(FAMILY, number): (*WALL_TAGS[number][:2], None) for number in (1, 4)}
    assert off_m(placed(result, seen, plain), true).max() < 0.1


def test_a_map_without_surveyed_tags_or_placed_by_hand_stays():
    result, true = mapped()
    for seen, by_hand in (((), ()), (sightings(true), (0,))):
        placing = placed(result, seen, SURVEY, by_hand)
        assert np.array_equal(placing.result.robots[0].T_map_base, result.robots[0].T_map_base)
        assert "not placed" in lines(placing)[0]


def test_tags_are_listed_where_they_are():
    result, true = mapped((0.0, 0.0, 0.0))
    placing = placed(result, sightings(true))
    (robot,) = placing.result.robots
    T = se2.compose(robot.T_map_base[0], se2.inverse(true[0]))
    for row in json.loads(placing.files["tags.json"])["tags"]:
        at = se2.compose(T, np.array(WALL_TAGS[row["number"]]))
        assert (row["x"], row["y"]) == pytest.approx(tuple(at[:2]), abs=0.02)
        assert not row["doubtful"]
    assert lines(placing) == []


def test_a_tag_seen_at_two_places_is_named():
    result, true = mapped()
    middle = len(true) // 2
    before = sightings(true, rows=slice(0, middle))
    moved = WALL_TAGS | {1: (4.9, 1.5, np.pi)}
    after = sightings(true, moved, rows=slice(middle, None))
    assert {1} <= {one.tag.number for one in before} & {one.tag.number for one in after}
    (line,) = lines(placed(result, (*before, *after)))
    assert line.startswith("tag apriltag_36h11 1 was moved or hangs twice")
    assert line.endswith("0.50 m apart")


@pytest.mark.parametrize("scale", [1.15, 1.5])
def test_a_wrong_size_is_named_and_no_tag_is_blamed_for_it(scale):
    result, true = mapped()
    said = lines(placed(result, sightings(true, scale=scale)))
    assert any(f"anna measures tags at {scale:.1f}" in line and "robot.tags.size_m" in line for line in said)
    assert not any("was moved" in line for line in said)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "valid dictionary"),
        ("tags: {}", "tags: Dictionary should have at least 1 item"),
        ("tags: [1, 2]", "tags: Input should be a valid dictionary"),
        ("families: x\ntags: {1: {x: 0, y: 0}}", "families: Extra inputs are not permitted"),
        ("family: apriltag_99\ntags: {1: {x: 0, y: 0}}", "family: Input should be 'apriltag_16h5'"),
        ("family: [1]\ntags: {1: {x: 0, y: 0}}", "family: Input should be"),
        ("tags: {door: {x: 0, y: 0}}", "tags: door: .*valid integer"),
        ("tags: {-1: {x: 0, y: 0}}", "tags: -1: .*greater than or equal to 0"),
        ("tags: {1: {x: 0}}", "tags: 1: y: Field required"),
        ("tags: {1: {x: 0, y: 0, z: 1}}", "tags: 1: z: Extra inputs are not permitted"),
        ("tags: {1: {x: 0, y: north}}", "tags: 1: y: .*valid number"),
        ("tags: {1: {x: .nan, y: 0}}", "tags: 1: x: .*finite number"),
        ("tags: {1: {x: 0, y: 0, yaw: .inf}}", "tags: 1: yaw: .*finite number"),
        ("tags: {1: {x: 0, y: 0", "not valid YAML"),
    ],
)
def test_a_bad_file_of_tags_gets_one_line(tmp_path, text, reason):
    path = tmp_path / "tags.yaml"
    path.write_text(text)
    with pytest.raises(SourceError, match=reason) as error:
        read_survey(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_a_file_of_tags_is_read(tmp_path):
    path = tmp_path / "tags.yaml"
    path.write_text("family: 4x4_50\ntags:\n  7: {x: 1, y: -2.5}\n  8: {x: 0, y: 0, yaw: 1.57}\n")
    family = TagFamily("4x4_50")
    assert read_survey(path) == {Tag(family, 7): (1.0, -2.5, None), Tag(family, 8): (0.0, 0.0, 1.57)}
