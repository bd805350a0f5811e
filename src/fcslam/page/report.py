"""The page over a finished run as one file: it holds what the page asks for, and asks nobody."""

import asyncio
import base64
import hashlib
import itertools
import json
import math
import re
from collections.abc import Awaitable, Callable, Iterator
from typing import Any
from urllib.parse import quote

import httpx
from fastapi import FastAPI

from fcslam.errors import EvaluationError
from fcslam.maps.tiles import WORLD_M, finest_zoom
from fcslam.page.routes import ASSETS
from fcslam.page.viewer import ReadOnly, viewer_app
from fcslam.records import ClosureStatus
from fcslam.runs import OccupancyMap, open_run
from fcslam.service.http.app import PREFIX
from fcslam.service.viewed_mission import ViewedMission

ASKED = (
    "fleet", "maps", "separations", "robots", "edits", "learning", "metrics.json", "config.yaml",
    *(f"closures?status={status}&limit=5000" for status in ClosureStatus),
)  # fmt: skip
"""Paths that the page requests, besides events, trajectories and tiles."""
MOST_TILES = 200
"""Of all maps together: a tile has about 15 kB. Of a larger map, the file holds coarser tiles."""
SCRIPT, STYLE = '<script type="module" src="page.js"></script>', '<link rel="stylesheet" href="page.css">'
"""Elements of the page that the file holds instead."""

Get = Callable[[str], Awaitable[httpx.Response]]


def report_html(mission: ViewedMission) -> str:
    """The page of a finished run, with all that it shows.

    Raises:
        EvaluationError: something of the run is broken.
    """
    return _page(asyncio.run(_responses(viewer_app(ReadOnly(mission)), _maps(mission))))


def _maps(mission: ViewedMission) -> dict[int, OccupancyMap]:
    return {} if mission.run_folder is None else dict(open_run(mission.run_folder).maps)


async def _responses(app: FastAPI, maps: dict[int, OccupancyMap]) -> dict[str, dict[str, str]]:
    """Responses of the service to the page, by path: texts, and pictures in base64."""
    transport = httpx.ASGITransport(app=app, raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url=f"http://localhost{PREFIX}/") as client:

        async def get(path: str) -> httpx.Response:
            answer = await client.get(path)
            if not answer.is_success:
                raise EvaluationError(f"the run has no {path} that can be shown ({answer.json()['error']})")
            return answer

        texts = {path: (await get(path)).text for path in ASKED}
        sessions = [robot["session"] for robot in json.loads(texts["robots"]) if robot["T_map_base"]]
        for path in (f"trajectories/{quote(session, safe='')}.tum" for session in sessions):
            texts[path] = (await get(path)).text
        zooms = {k: _zoom(occupancy, MOST_TILES // len(maps)) for k, occupancy in maps.items()}
        texts["maps"] = json.dumps([{**one, "zoom": zooms.get(one["map"], 0)} for one in json.loads(texts["maps"])])
        tiles = [path for k, occupancy in maps.items() for path in _tiles(k, occupancy, zooms[k])]
        pictures = {path: base64.b64encode((await get(path)).content).decode() for path in tiles}
    return {"texts": texts, "pictures": pictures}


def _zoom(occupancy: OccupancyMap, most: int) -> int:
    """The deepest zoom down to which a map has at most so many tiles; -1: it is too large even for zoom 0."""
    finest = finest_zoom(occupancy.resolution_m)
    counts = itertools.accumulate(math.prod(map(len, _covered(occupancy, zoom))) for zoom in range(finest + 1))
    return sum(1 for count in counts if count <= most) - 1


def _tiles(k: int, occupancy: OccupancyMap, deepest: int) -> Iterator[str]:
    """The paths of all tiles that show part of a map."""
    for zoom in range(deepest + 1):
        columns, rows = _covered(occupancy, zoom)
        for column, row in itertools.product(columns, rows):
            yield f"maps/{k}/tiles/{zoom}/{column}/{row}.png"


def _covered(occupancy: OccupancyMap, zoom: int) -> tuple[range, range]:
    """Columns and rows of the tiles that show part of a map."""
    side_m, (height, width) = WORLD_M / 2**zoom, occupancy.cells.shape
    x, y = occupancy.origin_xy
    columns, rows = (
        range(math.floor(low / side_m), math.ceil((low + count * occupancy.resolution_m) / side_m))
        for low, count in ((x, width), (y, height))
    )
    return columns, rows


def _page(responses: dict[str, Any]) -> str:
    """The page with script, style and responses in it."""
    html, script, style = (_asset(name) for name in ("index.html", "page.js", "page.css"))
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


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _hash(content: str) -> str:
    """The one script or style that a browser may use."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
