"""Places the maps of a result by what is known about the building. Which robots share a map is decided before."""

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.result import FleetResult, MappedRobot
from fcslam.errors import InputError
from fcslam.lidar.field import TOO_MANY_WALLS
from fcslam.lidar.submap import Submap
from fcslam.maps.changes import grown
from fcslam.maps.drawing import highlighted_png
from fcslam.maps.exports import outlines, rmf_yaml
from fcslam.maps.occupancy_map import GEOREFERENCE, RMF_YAML, Occupancy, OccupancyMap, map_stem
from fcslam.records import StrPath

if TYPE_CHECKING:
    from fcslam.anchoring.alignment import PlanAlignment
    from fcslam.anchoring.plan import BuildingPlan
    from fcslam.anchoring.plan_fit import PlanFit
    from fcslam.anchoring.surveyed_tags import Survey

PLAN_JSON, PLAN_PNG = "plan.json", "plan.png"
TAGS_JSON = "tags.json"
FIRST_LEVEL = "L1"
"""Level of a map whose floor has no name."""
ONLY_SCANS, ONLY_PLAN = "only in the scans", "only in the plan"

FuseMembers = Callable[[Sequence[MappedRobot]], OccupancyMap]
"""The occupancy map of robots that share one."""


@dataclass(frozen=True, slots=True)
class Anchors:
    """What is known about the building; ``read_anchors`` makes it."""

    plan: "BuildingPlan | None" = None
    survey: "Survey | None" = None
    """Positions of tags."""


def read_anchors(plan: StrPath | None = None, plan_scale: float | None = None, tags: StrPath | None = None) -> Anchors:
    """Read what is known about the building, for ``map_recordings``.

    Args:
        plan: floor plan: a PNG drawing, a DXF drawing, or the YAML file of a ROS map.
        plan_scale: metres per pixel of a drawing; metres per unit of a DXF file that does not name its unit.
        tags: YAML file with the positions of surveyed tags.

    Raises:
        InputError: a file cannot be read, or the scale is missing or wrong.
    """
    if plan is None and plan_scale is not None:
        raise InputError(
            "--plan-scale (in Python plan_scale=) belongs to --plan; name the plan, or leave the scale out"
        )
    if plan is None and tags is None:  # as most missions
        return Anchors()
    from fcslam.anchoring.plan_files import read_plan
    from fcslam.anchoring.surveyed_tags import read_survey

    building = None if plan is None else read_plan(Path(plan), plan_scale)
    return Anchors(building, None if tags is None else read_survey(Path(tags)))


def anchored(
    result: FleetResult, anchors: Anchors, placed: Collection[int], fuse: FuseMembers
) -> tuple[FleetResult, dict[str, bytes]]:
    """Place each map by the floor plan, else by surveyed tags, else by fixes; and the run folder's files about it.

    Maps that a user ``placed`` stay about there. ``fuse`` draws a map.
    """
    from fcslam.anchoring.alignment import align_to_plan
    from fcslam.anchoring.gnss import georeferenced
    from fcslam.anchoring.part import part_of, with_part
    from fcslam.anchoring.plan_fit import fit_to_plan, map_submap
    from fcslam.anchoring.surveyed_tags import MapTags, placed_by_tags, survey_report

    files: dict[str, bytes] = {}
    reports, pictures = [], []
    tags: list[dict[str, Any]] = []
    distances: dict[str, float] = {}
    surveyed: list[dict[str, Any]] = []
    for k in sorted({robot.map_index for robot in result.robots}):
        part, is_placed = part_of(result, k), k in placed
        alignment = None
        if anchors.plan is not None:
            building = map_submap(part.robots) if any(robot.keyscans for robot in part.robots) else None
            if building is not None and not building.field.is_full and not anchors.plan.submap.field.is_full:
                alignment = align_to_plan(anchors.plan, building, is_placed)
            if alignment is not None and not alignment.refusal:
                fit = fit_to_plan(alignment.plan, part, alignment.T_plan_map)
                part = fit.part
                reports.append(_plan_report(k, alignment, fit))
                pictures.append(fuse(part.robots))
            else:
                reports.append({"map": k, "aligned": False, "reason": _refusal(anchors.plan, building, alignment)})
        in_plan = alignment is not None and not alignment.refusal
        fixed = "it keeps the frame of its plan" if in_plan else "it was placed by hand" if is_placed else ""
        if anchors.survey is not None:
            by_tags = survey_report(fixed)
            if not fixed:
                part, by_tags = placed_by_tags(part, result.sightings, anchors.survey)
                fixed = "" if by_tags["reason"] else "it lies in the survey"
            surveyed.append({"map": k, **by_tags})
        found = georeferenced(part, is_fixed=bool(fixed))
        if found is not None:
            part, report = found
            files[map_stem(k) + GEOREFERENCE] = _json(report)
        result = with_part(result, k, part)
        seen = MapTags(part.robots, result.sightings)
        tags += seen.report(k)
        distances |= {robot: round(scale, 3) for robot, scale in seen.scales().items()}
    if result.sightings or anchors.survey is not None:
        files[TAGS_JSON] = _json({"tags": tags, "distances": distances, "surveyed": surveyed})
    if anchors.plan is not None:
        drawing = anchors.plan.drawing
        floors = [robot.floor for robot in result.robots if reports[robot.map_index]["aligned"]]
        if floors:
            files[RMF_YAML] = rmf_yaml(drawing, anchors.plan.is_picture, floors[0] or FIRST_LEVEL).encode()
        files[PLAN_JSON] = _json({"maps": reports, "drawing": outlines(drawing.cells == Occupancy.OCCUPIED, drawing)})
        files[PLAN_PNG] = _picture(drawing, pictures)
    return result, files


def _refusal(plan: "BuildingPlan", building: Submap | None, alignment: "PlanAlignment | None") -> str:
    from fcslam.anchoring.alignment import misfit

    if building is None or not len(building.surface):
        return "the map has no walls"
    if building.field.is_full:
        return f"it {TOO_MANY_WALLS}"
    reason = f"the plan {TOO_MANY_WALLS}: check its unit, or crop it" if alignment is None else alignment.refusal
    return f"{reason}; {misfit(plan, building)}"


def _plan_report(k: int, alignment: "PlanAlignment", fit: "PlanFit") -> dict[str, object]:
    compared = fit.compared[fit.is_bent]
    deviations = [
        {
            "kind": deviation.kind,
            "start": [round(value, 3) for value in deviation.start],
            "end": [round(value, 3) for value in deviation.end],
            "length_m": round(deviation.length_m, 3),
            "by_m": None if deviation.by_m is None else round(deviation.by_m, 3),
        }
        for deviation in compared.deviations
    ]
    return {
        "map": k,
        "aligned": True,
        "walls_seen": round(alignment.explained, 3),
        "confirmed_m": round(compared.confirmed_m, 1),
        "mean_off_m": round(compared.mean_off_m, 4) if compared.confirmed_m else None,
        "scales": {robot: round(scale, 5) for robot, scale in fit.scales.items()},
        "bent": fit.is_bent,
        "off_m": [round(one.mean_off_m, 4) if one.confirmed_m else None for one in fit.compared],
        "residuals": [round(residual, 4) for residual in fit.residuals],
        "deviations": deviations,
    }


def _json(content: object) -> bytes:
    return (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()


def _picture(plan: OccupancyMap, maps: Sequence[OccupancyMap]) -> bytes:
    """The maps in the plan, with walls that only one of both has in colours."""
    side = maps[0].resolution_m if maps else max(plan.resolution_m, 0.05)
    shown = (plan, *maps)
    lows = np.array([one.origin_xy for one in shown])
    highs = lows + [one.resolution_m * np.array(one.cells.shape[::-1]) for one in shown]
    low = np.floor(lows.min(axis=0) / side) * side
    width, height = np.ceil((highs.max(axis=0) - low) / side).astype(int) + 1

    def drawn(state: Occupancy, *maps: OccupancyMap) -> NDArray[np.bool_]:
        mask = np.zeros((height, width), bool)
        for one in maps:
            rows, columns = np.nonzero(one.cells == state)
            at = (np.column_stack((columns, rows)) + 0.5) * one.resolution_m + one.origin_xy - low
            column, row = np.floor(at / side).astype(np.int64).T
            mask[row, column] = True
        return mask

    lines, walls = drawn(Occupancy.OCCUPIED, plan), drawn(Occupancy.OCCUPIED, *maps)
    cells = np.where(drawn(Occupancy.FREE, *maps), Occupancy.FREE, Occupancy.UNKNOWN).astype(np.uint8)
    cells[walls] = Occupancy.OCCUPIED
    near = max(1, round(0.1 / side))
    union = OccupancyMap(cells, side, (float(low[0]), float(low[1])))
    return highlighted_png(union, walls & ~grown(lines, near), lines & ~grown(walls, near), (ONLY_SCANS, ONLY_PLAN))


def anchoring_lines(files: Mapping[str, bytes]) -> Iterator[str]:
    """What the files of a run folder say about plan, tags and fixes, a sentence each."""
    for report in json.loads(files[PLAN_JSON])["maps"] if PLAN_JSON in files else ():
        if not report["aligned"]:
            yield f"map {report['map']} is not aligned with the plan: {report['reason']}"
            continue
        scales = [f"lengths of {robot} x {scale:.4f}" for robot, scale in report["scales"].items() if scale != 1.0]
        count = len(report["deviations"])
        yield (
            f"map {report['map']} is aligned with the plan: {report['confirmed_m']:.0f} m of walls confirmed, "
            f"{', '.join([*scales, f'{count} deviations of walls ({PLAN_JSON})'])}"
        )
        if not report["bent"]:
            (placed, bent), (was, becomes) = report["off_m"], report["residuals"]
            yield (
                f"map {report['map']} keeps its shape, which the plan would bend: its walls would be {bent} m from the "
                f"plan instead of {placed} m, and its residuals {becomes} instead of {was}"
            )
    if TAGS_JSON in files:
        from fcslam.anchoring.surveyed_tags import tag_lines

        yield from tag_lines(json.loads(files[TAGS_JSON]))
    for name, content in files.items():
        if name.endswith(GEOREFERENCE):
            report = json.loads(content)
            count, ignored = report["fixes"], report["ignored"]
            where = name.removesuffix(GEOREFERENCE)
            if report["georeferenced"]:
                at = f"{report['latitude_deg']:.7f}, {report['longitude_deg']:.7f}"
                yield f"{where} has its origin at {at}; {count - ignored} of {count} fixes agree"
                if report["sigma_m"] > report["stated_sigma_m"]:
                    differ, said = f"{report['sigma_m']:.2g} m", f"{report['stated_sigma_m']:.2g} m"
                    yield f"the fixes of {where} differ by {differ}, their covariance says {said}; {differ} is used"
            else:
                yield f"{where} is not placed on the earth: {report['reason']}"
