"""A finished run as viewers see it, and the page over it as one file.

The file holds what the service answers to the page, and asks nobody.
"""

import base64
import gzip
import hashlib
import itertools
import json
import math
import re
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import httpx
from fastapi import FastAPI
from fastapi.params import Depends as Dependency

from fcslam.cloud.sessions import robot_and_epoch
from fcslam.errors import InputError
from fcslam.maps.occupancy_map import map_stem
from fcslam.maps.tiles import WORLD_M
from fcslam.mission.mission_file import opened_copy
from fcslam.page import ASSETS, MODULES
from fcslam.records import ClosureStatus
from fcslam.runs import CONFIG, METRICS, POSE_GRAPH, TRAJECTORIES
from fcslam.runs.folder import MISSION
from fcslam.service.authentication import Role
from fcslam.service.http.app import PREFIX, VIEWER_ROUTERS
from fcslam.service.http.problems import add_handlers
from fcslam.service.http.state import EventStream
from fcslam.service.intake import Agents, SessionState
from fcslam.service.viewed_mission import PacketCounts, ViewedMission, viewed_run

MOST_CLOSURES = 5000
"""Largest number of closures of each status that the page asks for."""
MOST_POINTS_BYTES = 32_000_000
"""Largest file of points that the report holds: about a million points."""
MOST_TILES = 200
"""Most tiles of all maps together: a tile has about 15 kB. For a larger map, the file holds coarser tiles."""
_IMPORT = re.compile(r"^import (\{[^}]*\}) from \"\./(\w+)\.js\";\n", re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)
SCRIPT, STYLE = '<script type="module" src="page.js"></script>', '<link rel="stylesheet" href="page.css">'
"""Elements of the page that the file holds instead."""


class ShownRun:
    """A ``ViewedMission`` that nobody can change. Any thread may call; its end removes its copy of the mission file."""

    def __init__(self, folder: Path) -> None:
        self.run_folder = folder.resolve()
        self.name = self.run_folder.name
        mission = folder / MISSION
        self._copy = ExitStack()
        self.store = self._copy.enter_context(opened_copy(mission if mission.is_file() else None))
        """The run folder's mission file; without packets if it has none."""
        self.agents = Agents(time.monotonic)  # no robot sends anything here
        self._packets = Counter((envelope.robot, envelope.epoch) for envelope in self.store.envelopes())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._copy.close()

    def sessions(self, robot: str | None = None) -> list[SessionState]:
        """Sessions of one robot or of all, by robot and epoch."""
        known = sorted({*self._packets, *map(robot_and_epoch, viewed_run(self.run_folder).trajectories)})
        return [SessionState(*session, self._packets[session]) for session in known if robot in (None, session[0])]

    def packet_counts(self) -> PacketCounts:
        """All packets of a finished run took effect."""
        count = self._packets.total()
        return PacketCounts(count, count, 0)


@dataclass(frozen=True, slots=True)
class ReadOnly:
    """A ``ViewerState`` without roles: whoever reaches it may read, and nobody may change anything."""

    mission: ViewedMission
    events: EventStream = field(default_factory=EventStream)
    read_only: bool = True
    learning: None = None

    def require(self, *_: Role) -> list[Dependency]:
        """Nothing."""
        return []

    def admits(self, *_: object) -> bool:
        """Everybody."""
        return True


def viewer_app(state: ReadOnly) -> FastAPI:
    """The routes of viewers."""
    app = FastAPI(title="fcslam", openapi_url=None, redirect_slashes=False)
    add_handlers(app)
    for make in VIEWER_ROUTERS:
        app.include_router(make(state), prefix=PREFIX)
    return app


async def report_html(mission: ViewedMission) -> str:
    """The page of a finished run, with all that it shows.

    Raises:
        InputError: the run has files that cannot be shown.
    """
    transport = httpx.ASGITransport(viewer_app(ReadOnly(mission)), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url=f"http://localhost{PREFIX}/") as client:

        async def get(path: str) -> bytes:
            answer = await client.get(path)
            if answer.status_code != httpx.codes.OK:
                raise InputError(f"the run has files that cannot be shown: {path}: {answer.json()['error']}")
            return answer.content

        robots, maps = json.loads(await get("robots")), json.loads(await get("maps"))
        drawn = [one for one in maps if one["extent"] is not None]
        for one in maps:
            one["zoom"] = _zoom(one["extent"], one["zoom"], MOST_TILES // len(drawn)) if one in drawn else 0
        found = set() if mission.run_folder is None else {path.name for path in mission.run_folder.iterdir()}
        texts = ["fleet", "verdicts", "robots", "edits", "learning"]
        texts += [f"maps/{one['map']}/layers/{layer}" for one in maps for layer in one["layers"]]
        texts += [f"closures?status={status}&limit={MOST_CLOSURES}" for status in ClosureStatus]
        texts += [f"maps/{one['map']}/walls" for one in drawn]
        texts += [f"{TRAJECTORIES}/{quote(one['session'], safe='')}.tum" for one in robots if one["T_map_base"]]
        texts += sorted(found & {METRICS, CONFIG})
        for one in maps:
            one["in_space"] = one["in_space"] and len(await get(f"maps/{one['map']}.ply")) <= MOST_POINTS_BYTES
        files = [f"maps/{one['map']}.png" for one in drawn if f"{map_stem(one['map'])}.png" in found]
        files += [f"maps/{one['map']}.{suffix}" for one in drawn for suffix in ("zip", "svg")]
        files += [f"maps/{one['map']}.tif" for one in drawn if one["georeferenced"]]
        files += [f"maps/{one['map']}.ply" for one in maps if one["in_space"]]
        files += sorted(found & {POSE_GRAPH}) + [f"{TRAJECTORIES}.zip"] * bool(robots)
        tiles = [path for one in drawn for path in _tiles(one)]
        responses = {
            "texts": {path: (await get(path)).decode() for path in texts} | {"maps": json.dumps(maps)},
            "pictures": {path: _base64(await get(path)) for path in tiles},
            "files": {path: _base64(gzip.compress(await get(path), mtime=0)) for path in files},
        }
    return _page(responses)


def _zoom(extent: list[float], finest: int, most: int) -> int:
    """The deepest zoom at which a map has at most this many tiles; -1: it is too large even for zoom 0."""
    counts = itertools.accumulate(math.prod(map(len, _covered(extent, zoom))) for zoom in range(finest + 1))
    return sum(1 for count in counts if count <= most) - 1


def _tiles(one: dict[str, Any]) -> Iterator[str]:
    for zoom in range(one["zoom"] + 1):
        for column, row in itertools.product(*_covered(one["extent"], zoom)):
            yield f"maps/{one['map']}/tiles/{zoom}/{column}/{row}.png"


def _covered(extent: list[float], zoom: int) -> tuple[range, range]:
    """Columns and rows of the tiles that show part of a map."""
    side_m, (left, low, right, high) = WORLD_M / 2**zoom, extent
    columns, rows = (
        range(math.floor(first / side_m), math.ceil(last / side_m)) for first, last in ((left, right), (low, high))
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
    return f"'sha256-{_base64(hashlib.sha256(content.encode()).digest())}'"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
