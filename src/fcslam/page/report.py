"""The page over a finished run as one file: it holds what the page asks for, and asks nobody."""

import base64
import gzip
import hashlib
import itertools
import json
import math
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any
from urllib.parse import quote, unquote

from fcslam.config import StrictModel
from fcslam.errors import InputError
from fcslam.maps.exports import export_map
from fcslam.maps.occupancy_map import OccupancyMap, map_stem
from fcslam.maps.tiles import WORLD_M, finest_zoom, tile_png
from fcslam.page import ASSETS, MODULES
from fcslam.records import ClosureStatus
from fcslam.runs import CONFIG, METRICS, POSE_GRAPH, QUALITY, TRAJECTORIES, open_run
from fcslam.service.map_layers import map_shapes, walls_of
from fcslam.service.summaries import (
    all_edits,
    all_sessions,
    fleet_summary,
    map_joins,
    map_separations,
    map_summaries,
    newest_closures,
    run_of,
    trajectories_zip,
)
from fcslam.service.viewed_mission import ViewedMission
from fcslam.untrusted import read_bytes, read_text

MOST_CLOSURES = 5000
"""Largest number of closures of each status that the page asks for."""
MOST_TILES = 200
"""Most tiles of all maps together: a tile has about 15 kB. For a larger map, the file holds coarser tiles."""
_IMPORT = re.compile(r"^import (\{[^}]*\}) from \"\./(\w+)\.js\";\n", re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)
SCRIPT, STYLE = '<script type="module" src="page.js"></script>', '<link rel="stylesheet" href="page.css">'
"""Elements of the page that the file holds instead."""


def report_html(mission: ViewedMission) -> str:
    """The page of a finished run, with all that it shows."""
    maps = {} if mission.run_folder is None else dict(open_run(mission.run_folder).maps)
    zooms = {k: _zoom(occupancy, MOST_TILES // len(maps)) for k, occupancy in maps.items()}
    try:
        pictures = _pictures(mission, maps, zooms)
        return _page({"texts": _texts(mission, zooms), "pictures": pictures, "files": _files(mission, maps)})
    except (OSError, ValueError) as error:
        raise InputError(f"the run has files that cannot be shown ({error})") from error


def _texts(mission: ViewedMission, zooms: Mapping[int, int]) -> dict[str, str]:
    """Responses of the service to the page, by path. Maps have tiles down to ``zooms``."""
    sessions, maps = all_sessions(mission), map_summaries(mission)
    texts = {
        "fleet": _json(fleet_summary(mission, read_only=True, may_edit=False)),
        "maps": _json(one.model_copy(update={"zoom": zooms.get(one.map, 0)}) for one in maps),
        "separations": _json(map_separations(mission)),
        "joins": _json(map_joins(mission)),
        "robots": _json(sessions),
        "edits": _json(all_edits(mission)),
        "learning": "[]",
    }
    for k, layer in [(one.map, layer) for one in maps for layer in one.layers]:
        texts[f"maps/{k}/layers/{layer}"] = _json(map_shapes(mission, k, layer))
    for status in ClosureStatus:
        try:
            texts[f"closures?status={status}&limit={MOST_CLOSURES}"] = newest_closures(
                run_of(mission), status, MOST_CLOSURES
            ).decode()
        except ValueError as error:
            raise InputError(f"the run has closures that cannot be shown ({error})") from error
    if mission.run_folder is not None:
        texts |= {f"maps/{k}/walls": _json(walls_of(mission.run_folder, k)) for k in zooms}
        located = (quote(one.session, safe="") for one in sessions if one.T_map_base)
        for path in (METRICS, CONFIG, *(f"{TRAJECTORIES}/{name}.tum" for name in located)):
            texts[path] = read_text(mission.run_folder / unquote(path), mission.run_folder)
        certificate = mission.run_folder / f"{QUALITY}.json"
        if certificate.is_file():
            texts[certificate.name] = read_text(certificate, mission.run_folder)
    return texts


def _pictures(mission: ViewedMission, maps: Mapping[int, OccupancyMap], zooms: Mapping[int, int]) -> dict[str, str]:
    folder = mission.run_folder
    return {
        f"maps/{k}/tiles/{zoom}/{column}/{row}.png": base64.b64encode(
            tile_png(folder, map_stem(k), zoom, column, row)
        ).decode()
        for k, occupancy in maps.items()
        if folder is not None
        for zoom, column, row in _tiles(occupancy, zooms[k])
    }


def _files(mission: ViewedMission, maps: Collection[int]) -> dict[str, str]:
    """What the page downloads, compressed with gzip and in base64, by path."""
    if mission.run_folder is None:
        return {}
    named = {f"maps/{k}.png": f"{map_stem(k)}.png" for k in maps}
    named[POSE_GRAPH] = POSE_GRAPH
    files = {path: mission.run_folder / name for path, name in named.items()}
    contents = {path: read_bytes(file, mission.run_folder) for path, file in files.items() if os.path.lexists(file)}
    if (archive := trajectories_zip(mission.run_folder)) is not None:
        contents[f"{TRAJECTORIES}.zip"] = archive
    for k, suffix in itertools.product(maps, ("zip", "svg", "tif")):
        if (exported := export_map(mission.run_folder, k, suffix)) is not None:
            contents[f"maps/{k}.{suffix}"] = exported
    return {path: base64.b64encode(gzip.compress(content, mtime=0)).decode() for path, content in contents.items()}


def _json(content: StrictModel | Iterable[StrictModel]) -> str:
    whole = (
        content.model_dump(mode="json")
        if isinstance(content, StrictModel)
        else [one.model_dump(mode="json") for one in content]
    )
    return json.dumps(whole, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def _zoom(occupancy: OccupancyMap, most: int) -> int:
    """The deepest zoom at which a map has at most this many tiles; -1: it is too large even for zoom 0."""
    finest = finest_zoom(occupancy.resolution_m)
    counts = itertools.accumulate(math.prod(map(len, _covered(occupancy, zoom))) for zoom in range(finest + 1))
    return sum(1 for count in counts if count <= most) - 1


def _tiles(occupancy: OccupancyMap, deepest: int) -> Iterator[tuple[int, int, int]]:
    """Zoom, column and row of all tiles that show part of a map."""
    for zoom in range(deepest + 1):
        columns, rows = _covered(occupancy, zoom)
        for column, row in itertools.product(columns, rows):
            yield zoom, column, row


def _covered(occupancy: OccupancyMap, zoom: int) -> tuple[range, range]:
    side_m, (height, width) = WORLD_M / 2**zoom, occupancy.cells.shape
    x, y = occupancy.origin_xy
    columns, rows = (
        range(math.floor(low / side_m), math.ceil((low + count * occupancy.resolution_m) / side_m))
        for low, count in ((x, width), (y, height))
    )
    return columns, rows


def _page(responses: dict[str, Any]) -> str:
    html, style, script = _asset("index.html"), _asset("page.css"), "".join(map(_inlined, MODULES))
    data = json.dumps(responses).replace("<", "\\u003c")  # what would end the element, whoever named a robot so
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; base-uri 'none'; form-action 'none'"
    )
    parts = {
        STYLE: f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n<style>{style}</style>',
        SCRIPT: f'<script type="application/json" id="responses">{data}</script>\n'
        f'<script type="module">{script}</script>',
    }
    return re.sub("|".join(map(re.escape, parts)), lambda found: parts[found[0]], html)


def _inlined(name: str) -> str:
    """A module of the page as part of one script: an object with its exports, from which later modules take theirs."""
    script = _asset(name)
    exported = ", ".join(name for _, name in _EXPORT.findall(script))
    body = _EXPORT.sub(r"\1", _IMPORT.sub(r"const \1 = \2_js;\n", script))
    return f"const {name.removesuffix('.js')}_js = (() => {{\n{body}return {{ {exported} }};\n}})();\n"


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _hash(content: str) -> str:
    """The one script or style that a browser may use."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
