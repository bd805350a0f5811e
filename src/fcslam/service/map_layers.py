"""What is known about a map besides its cells, as shapes that the page draws over it."""

import json
from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field

from fcslam.anchoring.anchors import PLAN_JSON, TAGS_JSON
from fcslam.anchoring.deviations import DeviationKind
from fcslam.anchoring.walls import wall_direction
from fcslam.config import StrictModel
from fcslam.errors import InputError, SourceError
from fcslam.maps.changes import APPEARED, DISAPPEARED
from fcslam.maps.exports import outlines
from fcslam.maps.occupancy_map import map_stem, parse_map
from fcslam.mission.map_changes import changes_of
from fcslam.mission.mission_file import check_packets, stored_mission
from fcslam.mission.mission_store import MissionStore
from fcslam.runs import QUALITY, Run
from fcslam.service.viewed_mission import ViewedMission, viewed_run
from fcslam.untrusted import LimitError, read_bytes, read_text

TAG_M: Final = 0.15
"""Half a side of the square that stands for a tag."""
MOST_LAYER_BYTES: Final = 1 << 26
"""Largest file that is shown as a layer; as objects, it takes many times as much memory."""


class MapLayer(StrEnum):
    """What is drawn over a map."""

    PLAN = "plan"
    CHANGES = "changes"
    TAGS = "tags"
    QUALITY = "quality"


class MapShape(StrictModel):
    """A shape that is drawn over a map, and its label."""

    kind: Literal["plan", "missing", "new", "moved", "appeared", "disappeared", "tag", "good", "bad"] = Field(
        description="line of the floor plan; wall that only the plan or only the scans have, or that moved; surface "
        "that appeared or disappeared since the first day; tag; square metre as accurate as the certificate asks, "
        "or not"
    )
    path: str = Field(description="data of an SVG path, metres of the map")
    text: str = ""
    x: float = Field(default=0.0, description="of the label, metres of the map")
    y: float = Field(default=0.0, description="of the label, metres of the map")


_FILES: Final = {MapLayer.PLAN: PLAN_JSON, MapLayer.TAGS: TAGS_JSON, MapLayer.QUALITY: QUALITY}


def layers_of(mission: ViewedMission, k: int) -> list[MapLayer]:
    """The layers that map ``k`` may have; floor plan and tags are of finished runs."""
    folder = mission.run_folder
    if folder is None:
        return []
    found = [layer for layer, name in _FILES.items() if (folder / name).is_file()]
    ended_s = float("inf")
    for first_s, last_s in sorted(
        (float(robot.stamps.min()), float(robot.stamps.max()))
        for robot in viewed_run(folder).trajectories.values()
        if robot.map_index == k and len(robot.stamps)
    ):
        if first_s > ended_s:
            return [*found, MapLayer.CHANGES]
        ended_s = last_s if ended_s == float("inf") else max(ended_s, last_s)
    return found


def map_shapes(mission: ViewedMission, k: int, layer: MapLayer) -> list[MapShape]:
    """A layer of map ``k``; empty if there is nothing to draw."""
    folder = mission.run_folder
    if folder is None or layer not in layers_of(mission, k):
        return []
    if layer is MapLayer.CHANGES:
        found = _changes(viewed_run(folder), mission.store, k)
        if isinstance(found, str):
            raise InputError(found)
        return [*found]
    try:
        content = json.loads(read_text(folder / _FILES[layer], folder, MOST_LAYER_BYTES))
        return _DRAWN[layer](content, k)
    except FileNotFoundError:
        return []
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"{_FILES[layer]} cannot be shown ({error})") from error


def walls_of(folder: Path, k: int) -> dict[str, float]:
    """The direction of the walls of map ``k`` of a run folder, which has it.

    Raises:
        InputError: the files of the map are broken.
    """
    stem = map_stem(k)
    try:
        pgm, description = read_bytes(folder / f"{stem}.pgm", folder), read_text(folder / f"{stem}.yaml", folder)
    except (OSError, ValueError) as error:
        raise InputError(f"{stem} cannot be read ({error})") from error
    return {"direction_rad": wall_direction(parse_map(stem, pgm, description))}


@lru_cache(maxsize=8)  # each takes all packets of the mission; a run that is replaced is another one
def _changes(run: Run, store: MissionStore, k: int) -> tuple[MapShape, ...] | str:
    """The changes, or why they are refused: an exception would not be kept."""
    mission = stored_mission(store)
    try:
        check_packets(mission)
        found = changes_of(run, mission, None, None, k, "the run")
    except SourceError:  # there is no earlier day, or its robots sent no ranges
        return ()
    except LimitError as error:
        return f"the changes cannot be shown ({error})"
    masks = {APPEARED: found.appeared, DISAPPEARED: found.disappeared}
    return tuple(_shape(kind, outlines(mask, found.now)) for kind, mask in masks.items() if mask.any())


def _plan(content: Mapping[str, Any], k: int) -> list[MapShape]:
    (report,) = [one for one in content["maps"] if one["map"] == k and one["aligned"]] or (None,)
    if report is None:
        return []
    shapes = [_shape("plan", content["drawing"])] if "drawing" in content else []
    for one in report["deviations"]:
        (a, b), (c, d), kind = one["start"], one["end"], DeviationKind(one["kind"])
        text = f"moved by {one['by_m']:.2f} m" if kind is DeviationKind.MOVED else ""
        shapes.append(_shape(kind.value, f"M{a} {b}L{c} {d}", text, (a + c) / 2, (b + d) / 2))
    return shapes


def _tags(content: Mapping[str, Any], k: int) -> list[MapShape]:
    side = 2.0 * TAG_M
    return [
        _shape(
            "tag",
            f"M{one['x'] - TAG_M} {one['y'] - TAG_M}h{side}v{side}h{-side}z",
            f"tag {one['number']}{' (moved, or there twice)' if one['doubtful'] else ''}",
            one["x"],
            one["y"],
        )
        for one in content["tags"]
        if one["map"] == k
    ]


def _quality(content: Mapping[str, Any], k: int) -> list[MapShape]:
    """A square for each cell of the certificate."""
    certificate = content.get(str(k))
    if certificate is None:
        return []
    side, squares = certificate["cell"], dict[str, list[str]](good=[], bad=[])
    for cell in certificate["cells"]:
        corner = f"M{cell['x'] - side / 2} {cell['y'] - side / 2}"
        squares["good" if cell["good"] else "bad"].append(f"{corner}h{side}v{side}h{-side}z")
    return [_shape(kind, "".join(paths)) for kind, paths in squares.items() if paths]


def _shape(kind: str, path: str, text: str = "", x: float = 0.0, y: float = 0.0) -> MapShape:
    return MapShape.model_validate({"kind": kind, "path": path, "text": text, "x": x, "y": y})


_DRAWN: Final[Mapping[MapLayer, Callable[[Mapping[str, Any], int], list[MapShape]]]] = {
    MapLayer.PLAN: _plan,
    MapLayer.TAGS: _tags,
    MapLayer.QUALITY: _quality,
}
