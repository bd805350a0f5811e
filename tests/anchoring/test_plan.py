"""A map is aligned with the plan of its building, in its scale, and with no other; what differs is listed."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from fcslam.anchoring.anchors import Anchors, anchoring_lines, read_anchors
from fcslam.anchoring.plan import BuildingPlan
from fcslam.anchoring.plan_files import read_plan
from fcslam.config import parse_yaml
from fcslam.errors import SourceError
from fcslam.geometry import se2
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, map_yaml, pgm_bytes
from tests.planned_building import OTHER_WALLS, WALLS, anchored_map, mapped, off_m, plan_of

pytestmark = pytest.mark.slow


def placed(result, plan=None, by_hand=()):
    anchors = Anchors(BuildingPlan(plan) if isinstance(plan, OccupancyMap) else plan)
    return anchored_map(result, anchors, by_hand)


def report_of(placing):
    (report,) = json.loads(placing.files["plan.json"])["maps"]
    return report


@pytest.mark.parametrize("T", [(3.0, -2.0, 0.6), (0.0, 0.0, 0.0), (-40.0, 7.0, -2.5)])
def test_a_map_is_given_in_the_coordinates_of_its_plan(T):
    result, true = mapped(T, drift_rad=0.05)
    placing = placed(result, plan_of())
    assert report_of(placing)["aligned"]
    assert off_m(placing, true).max() < 0.05
    assert np.array_equal(placing.result.graph.poses(), placing.result.robots[0].T_map_base)


def test_lines_of_any_width_are_walls():
    result, true = mapped()
    for cells in (4, 14):  # lines of 28 and 68 cm
        lines = cv2.dilate((plan_of().cells == Occupancy.OCCUPIED).astype(np.uint8), np.ones((2 * cells + 1,) * 2))
        wide = replace(plan_of(), cells=np.where(lines, Occupancy.OCCUPIED, Occupancy.FREE).astype(np.uint8))
        assert off_m(placed(result, wide), true).max() < 0.05


@pytest.mark.parametrize(("outer_m", "inner_m"), [(0.4, 0.12), (0.6, 0.12), (0.6, 0.3), (0.8, 0.5), (0.6, 0.6)])
@pytest.mark.parametrize("by_hand", [False, True])
def test_walls_of_two_thicknesses_fit_their_plan(outer_m, inner_m, by_hand):
    thickness_m = np.where(np.arange(len(WALLS)) < 6, outer_m, inner_m)[:, None]  # the first six are the facade
    result, true = mapped((1.1, 2.9, 0.02) if by_hand else (3.0, -2.0, 0.6), thickness_m=thickness_m)
    placing = placed(result, plan_of(thickness_m=thickness_m), {0} if by_hand else ())
    assert report_of(placing)["aligned"]
    assert off_m(placing, true).max() < 0.05


def test_a_plan_drawn_by_hand_places_the_map_and_leaves_its_shape():
    result, _ = mapped()
    by_hand = WALLS + 0.08 * np.sin(2.0 * np.pi * WALLS[:, [1, 0, 3, 2]] / 9.0)
    placing = placed(result, plan_of(by_hand))
    report = report_of(placing)
    assert (report["aligned"], report["bent"]) == (True, False)
    assert report["residuals"][1] > report["residuals"][0]
    assert any("keeps its shape" in line for line in anchoring_lines(placing.files))
    before, after = (one.robots[0].T_map_base for one in (result, placing.result))
    assert se2.between(after[0], after) == pytest.approx(se2.between(before[0], before), abs=1e-9)


@pytest.mark.parametrize("scale", [0.985, 1.01])
def test_lengths_get_the_scale_of_the_plan(scale):
    result, true = mapped(scale=scale)
    placing = placed(result, plan_of())
    assert report_of(placing)["scales"]["anna"] == pytest.approx(1.0 / scale, abs=0.001)
    assert off_m(placing, true).max() < 0.05
    (before,), (after,) = result.robots, placing.result.robots
    assert after.keyscans[0].ranges_m / before.keyscans[0].ranges_m == pytest.approx(1.0 / scale, abs=0.001)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda plan: plan.mirrored(), "it fits mirrored"),
        (lambda plan: plan.scaled(1.1), "the plan is 11.1 m by 17.7 m, and the map 9.9 m by 15.9 m; it fits at 0.909"),
        (
            lambda plan: replace(plan.scaled(25.4), unit_m=0.0254),
            "and the map 9.9 m by 15.9 m; if it is drawn in millimetres and not in inches: --plan-scale 0.001",
        ),
    ],
)
def test_what_makes_a_plan_fit_is_said(change, words):
    result, _ = mapped()
    assert words in report_of(placed(result, change(BuildingPlan(plan_of()))))["reason"]


def test_the_plan_of_another_building_changes_nothing():
    result, _ = mapped()
    placing = placed(result, plan_of(OTHER_WALLS))
    report = report_of(placing)
    assert not report["aligned"]
    assert "needed" in report["reason"] or "allowed" in report["reason"]
    assert np.array_equal(placing.result.robots[0].T_map_base, result.robots[0].T_map_base)


def test_a_building_that_looks_the_same_from_behind_needs_a_placement_by_hand():
    middle = np.array((16.0, 10.0, 16.0, 10.0))
    walls = np.array(
        [(0, 0, 16, 0), (16, 0, 16, 10), (16, 10, 0, 10), (0, 10, 0, 0), (0, 6, 3, 6), (4.2, 6, 8, 6)], float
    )
    walls = np.concatenate((walls, middle - walls))
    unplaced, by_hand = placed(mapped(walls=walls)[0], plan_of(walls)), mapped((1.1, 3.2, 0.02), walls=walls)[0]
    assert "elsewhere" in report_of(unplaced)["reason"]
    assert report_of(placed(by_hand, plan_of(walls), by_hand={0}))["aligned"]


def test_walls_that_moved_are_gone_or_are_new_are_listed():
    walls = WALLS.copy()
    walls[9] += (0.6, 0.0, 0.6, 0.0)  # moved
    extra = np.array([(13.0, 0.0, 13.0, 2.5)])  # in the plan only
    result, _ = mapped()
    plan = np.concatenate((np.delete(walls, 12, axis=0), extra))  # 12 is new
    found = {d["kind"]: d for d in report_of(placed(result, plan_of(plan)))["deviations"]}
    assert set(found) == {"moved", "missing", "new"}
    assert found["moved"]["by_m"] == pytest.approx(0.6, abs=0.05)
    for kind, x, y in (("moved", 5.6, 1.5), ("missing", 13.0, 1.25), ("new", 14.0, 3.8)):
        middle = 0.5 * (np.array(found[kind]["start"]) + found[kind]["end"])
        assert np.hypot(*(middle - (x, y))) < 0.5, kind


def test_walls_of_the_plan_that_stand_are_no_deviations():
    assert report_of(placed(mapped()[0], plan_of()))["deviations"] == []


def picture(folder, colours=((255, 255, 255), (0, 0, 0)), name="plan.png"):
    """A drawing of the walls with a title, seen with the top at the largest y."""
    background, ink = colours
    lines = plan_of().cells[::-1] == Occupancy.OCCUPIED
    pixels = np.full((*lines.shape, 3), background, np.uint8)
    pixels[lines] = ink
    cv2.putText(pixels, "Kitchen", (300, 150), cv2.FONT_HERSHEY_SIMPLEX, 0.6, ink, 1, cv2.LINE_AA)
    cv2.imwrite(str(folder / name), pixels)
    return folder / name


@pytest.mark.parametrize(
    "colours", [((255, 255, 255), (0, 0, 0)), ((90, 40, 10), (255, 230, 200)), ((240, 250, 255), (160, 90, 60))]
)
def test_a_drawing_is_read_in_any_colours_without_its_text(tmp_path, colours):
    plan, true = read_plan(picture(tmp_path, colours), 0.02).drawing, plan_of()
    lines, expected = plan.cells == Occupancy.OCCUPIED, true.cells == Occupancy.OCCUPIED
    assert np.array_equal(lines, expected)
    assert plan.origin_xy == (0.0, 0.0)


@pytest.mark.parametrize("is_picture", [True, False])
def test_a_fleet_manager_gets_the_coordinates_of_plan_and_map(tmp_path, is_picture):
    """Open-RMF counts from the upper left corner of a picture, with y up; a drawing has its own coordinates."""
    assert read_plan(picture(tmp_path), 0.02).is_picture
    assert not read_plan(drawing(tmp_path, 4)).is_picture
    plan, (result, _) = BuildingPlan(plan_of(), is_picture=is_picture), mapped()
    found = parse_yaml(placed(result, plan).files["rmf.yaml"].decode())["reference_coordinates"]
    assert list(found) == ["L1"]
    robot, rmf = np.array(found["L1"]["robot"]), np.array(found["L1"]["rmf"])
    x, y = plan.drawing.origin_xy
    offset = (x, y + plan.drawing.resolution_m * len(plan.drawing.cells)) if is_picture else (0.0, 0.0)
    np.testing.assert_allclose(robot - rmf, np.tile(offset, (4, 1)), atol=1e-9)
    assert np.linalg.matrix_rank(rmf - rmf.mean(axis=0)) == 2
    other = placed(result, plan_of(OTHER_WALLS))
    assert "rmf.yaml" not in other.files


def test_a_map_of_ros_is_a_plan_in_its_own_coordinates(tmp_path):
    true = plan_of()
    (tmp_path / "map.pgm").write_bytes(pgm_bytes(true))
    (tmp_path / "map.yaml").write_text(map_yaml(true, "map.pgm"))
    plan = read_plan(tmp_path / "map.yaml").drawing
    assert np.array_equal(plan.cells, true.cells)
    assert plan.origin_xy == pytest.approx(true.origin_xy)


def drawing(folder, unit):
    ezdxf = pytest.importorskip("ezdxf")
    document = ezdxf.new()
    document.header["$INSUNITS"] = unit
    lengths = 1.0 if unit == 6 else 1000.0
    for x1, y1, x2, y2 in (lengths * WALLS).tolist():
        document.modelspace().add_line((x1, y1), (x2, y2))
    document.modelspace().add_spline([(0.0, 0.0, 0.0)] * 3)  # without a length
    document.modelspace().add_text("Kitchen", height=0.3 * lengths).set_placement((3.0 * lengths, 3.0 * lengths))
    document.saveas(folder / "plan.dxf")
    return folder / "plan.dxf"


def test_a_drawing_that_names_a_wrong_unit_gets_the_scales_that_are_possible(tmp_path):
    assert read_plan(drawing(tmp_path, 4)).unit_m == 0.001
    with pytest.raises(SourceError, match=r"16.0 m by 10.0 m if it is drawn in millimetres: --plan-scale 0.001;"):
        read_plan(drawing(tmp_path, 4), 1.0)


@pytest.mark.parametrize(("unit", "scale"), [(6, None), (4, None), (0, 0.001)])
def test_a_drawing_of_lines_is_read_in_its_unit(tmp_path, unit, scale):
    plan = read_plan(drawing(tmp_path, unit), scale).drawing
    rows, columns = np.nonzero(plan.cells == Occupancy.OCCUPIED)
    at = np.column_stack((columns, rows)) * plan.resolution_m + plan.origin_xy
    assert at.min(axis=0) == pytest.approx((0.0, 0.0), abs=0.03)
    assert at.max(axis=0) == pytest.approx((16.0, 10.0), abs=0.03)


def test_a_plan_that_cannot_be_used_gets_one_line(tmp_path):
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((50, 50), 255, np.uint8))
    (tmp_path / "broken.png").write_bytes(b"no picture")
    (tmp_path / "broken.dxf").write_text("no drawing")
    damaged = drawing(tmp_path, 6)
    damaged.write_text(damaged.read_text().replace("$INSUNITS\n 70\n6\n", "$INSUNITS\n 70\n1e400\n"))
    cases = [
        (picture(tmp_path), None, "--plan-scale 0.02"),
        (picture(tmp_path), -1.0, "above 0"),
        (picture(tmp_path), 10.0, "check the scale"),
        (blank, 0.02, "no lines"),
        (tmp_path / "broken.png", 0.02, "cannot be read as a picture"),
        (tmp_path / "missing.png", 0.02, "cannot be read"),
        (tmp_path / "missing.yaml", None, "cannot be read"),
        (tmp_path / "broken.dxf", None, "cannot be read"),
        (damaged, None, "cannot be read as a DXF drawing"),
    ]
    for path, scale, text in cases:
        with pytest.raises(SourceError, match=text) as caught:
            read_plan(path, scale)
        assert "\n" not in str(caught.value)


def test_a_plan_with_more_walls_than_a_field_holds_gets_one_line(tmp_path):
    pixels = np.full((2000, 2000), 255, np.uint8)
    pixels[::25, 50:-50] = 0
    cv2.imwrite(str(tmp_path / "hatched.png"), pixels)
    placing = placed(mapped()[0], read_anchors(tmp_path / "hatched.png", 0.02).plan)
    assert "the plan has too many walls; at most 1.6 km can be used: check its unit, or" in report_of(placing)["reason"]


def test_a_robot_whose_ranges_stay_with_it_is_placed_with_the_others_of_its_map():
    result, true = mapped()
    (robot,) = result.robots
    silent = replace(robot, robot="bert", keyscans=(), variables=np.array([len(true)]), stamps=robot.stamps[:1],
                     T_map_base=robot.T_map_base[:1], T_local_base=robot.T_local_base[:1])  # fmt: skip
    poses = np.concatenate((result.graph.poses(), robot.T_map_base[:1]))
    joined = Edge(0, len(true), np.zeros(3), np.eye(3) * 1e4, robust=False)
    both = replace(result, robots=(robot, silent), graph=PoseGraph(poses, [*result.graph.edges, joined]))
    placing = placed(both, plan_of())
    assert report_of(placing)["scales"]["bert"] == 1.0
    assert np.hypot(*(placing.result.robots[1].T_map_base[0, :2] - true[0, :2])) < 0.05
    alone = replace(result, robots=(replace(robot, keyscans=()),))
    assert report_of(placed(alone, plan_of()))["reason"] == "the map has no walls"


@pytest.mark.parametrize("unit", [0, 8, 99], ids=["none", "microinches", "none of DXF"])
def test_a_drawing_without_a_known_unit_gets_one_line(tmp_path, unit):
    with pytest.raises(SourceError, match="does not name its unit"):
        read_plan(drawing(tmp_path, unit))
