"""A finished run behind the page: what the service answers, in a viewer or in one file, and nothing can change it."""

import asyncio
import base64
import gzip
import hashlib
import io
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from zipfile import ZipFile

import httpx
import numpy as np
import pytest
from fastapi.routing import iter_route_contexts

from fcslam.cloud.settings import CloudConfig
from fcslam.errors import InputError
from fcslam.geometry import se3
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, map_yaml, pgm_bytes
from fcslam.mission.mission_file import as_stored, mission_bytes
from fcslam.page import ASSETS, MODULES
from fcslam.page.report import MOST_POINTS_BYTES, MOST_TILES, ShownRun, report_html
from fcslam.page.routes import run_page
from fcslam.records import Channel, ClosureStatus, Edit, Reason, ReasonCode, Veto
from fcslam.runs import ClosureRow, Join, Metric, RobotTrajectory, Run
from fcslam.service.http.app import PREFIX
from fcslam.wire.packets import decode, measure
from tests.service.http.desk import A

pytestmark = pytest.mark.slow

ASKED = (
    *("fleet", "maps", "verdicts", "robots", "edits", "learning"),
    *("metrics.json", "config.yaml"),
    *(f"closures?status={status}&limit=5000" for status in ClosureStatus),
)
"""Paths that the page requests, besides events, trajectories and tiles."""
HOSTILE = "</script><script>alert(1)</script>"


def files(stem, side, resolution_m=0.05):
    cells = np.full((side, side), Occupancy.FREE, np.uint8)
    cells[side // 2] = Occupancy.OCCUPIED
    occupancy = OccupancyMap(cells, resolution_m, (-3.0, -2.0))
    return {f"{stem}.pgm": pgm_bytes(occupancy), f"{stem}.yaml": map_yaml(occupancy, f"{stem}.pgm").encode()}


def trajectory(robot, map_index):
    stamps = np.arange(5.0)
    return RobotTrajectory(robot, map_index, stamps, np.column_stack((stamps, stamps / 2.0, np.zeros(5))))


@pytest.fixture
def run():
    closure = ClosureRow(
        "a", 1.0, "a+1", 2.0, Channel.LIDAR, 0.25, np.array([1.0, -2.5, 3.0]), ClosureStatus.ACCEPTED,
        Reason(ReasonCode.FEW_PLACES, 2, 3.5, HOSTILE),
    )  # fmt: skip
    return Run(
        trajectories={t.robot: t for t in (trajectory("a", 0), trajectory("a+1", 0), trajectory("b", 1))},
        closures=(closure,),
        joins=(Join("a", "a+1", 3, 1, *[float("nan")] * 3, float("inf")), Join("a", "b", 3, 1, 9.0, 0.0, 1.0, 0.0)),
        metrics={"error": Metric("error", float("nan"), "m")},
        map_files=files("map", 160) | files("map_1", 40),
        quality=b'{"0":{"bar":0.05,"cell":1.0,"cells":[],"drives":[]}}',
        mission=mission_bytes(
            CloudConfig(),
            [Edit(1, "anna", 1e9, Veto("a", "b"))],
            [as_stored(measure(decode(data))) for data in A],
            [],
            {},
        ),
    )


@pytest.fixture
def shown(run, tmp_path):
    run.save(tmp_path / "run")
    with ShownRun(tmp_path / "run") as shown:
        yield shown


def ask(shown, *paths, method="GET", host="127.0.0.1:80"):
    async def answers():
        transport = httpx.ASGITransport(app=run_page(shown))
        async with httpx.AsyncClient(transport=transport, base_url=f"http://{host}") as client:
            return [await client.request(method, path) for path in paths]

    return asyncio.run(answers())


def test_a_finished_run_answers_as_the_service_does(shown):
    answers = ask(shown, *(f"/api/v1/{path}" for path in (*ASKED, "robots/a", "trajectories/b.tum", "maps/1.yaml")))
    assert [answer.status_code for answer in answers] == [200] * len(answers)
    contents = [answer.json() if "json" in answer.headers["content-type"] else answer.text for answer in answers]
    told = dict(zip((*ASKED, "robots/a"), contents, strict=False))
    fleet, maps, robots, metrics, one = (told[path] for path in ("fleet", "maps", "robots", "metrics.json", "robots/a"))
    closures = told["closures?status=accepted&limit=5000"]
    assert (fleet["read_only"], fleet["packets"], fleet["metrics"]) == (True, len(A), {"error": None})
    assert [(m["map"], m["robots"], m["zoom"]) for m in maps] == [(0, ["a", "a+1"], 5), (1, ["b"], 5)]
    assert [(r["session"], r["packets"], r["map"]) for r in robots] == [("a", len(A), 0), ("a+1", 0, 0), ("b", 0, 1)]
    assert robots[0]["T_map_base"] == [4.0, 2.0, 0.0]
    assert [closure["setting"] for closure in closures] == [HOSTILE]
    assert metrics == [{"name": "error", "value": None, "unit": "m"}]
    assert one["sessions"] == robots[:2]
    assert [(edit["kind"], edit["author"]) for edit in told["edits"]] == [("veto", "anna")]
    first, second = told["verdicts"]
    assert (first["map"], first["use"], first["sentence"]) == (
        0,
        "reserve",
        "use this map, but its accuracy is not known",
    )
    assert first["details"] == [
        "b has another map (no two of their places look alike); drive b through a part of map 0",
        "joined: a and a+1: 3 closures from 1 place; their maps could not be compared",
    ]
    assert (second["use"], second["where"]) == ("wait", [])


def test_every_route_of_viewers_answers_for_a_finished_run(shown):
    app = run_page(shown)
    paths = [route.path for route in iter_route_contexts(app.routes)]
    plain = [path for path in paths if "{" not in path and not path.endswith("/events")]
    assert f"{PREFIX}/closures" in plain
    answers = ask(shown, *plain)
    assert {answer.request.url.path: answer.status_code for answer in answers} == dict.fromkeys(plain, 200)


def test_a_run_without_a_mission_file_is_shown_too(run, tmp_path):
    replace(run, mission=b"").save(tmp_path / "run")
    with ShownRun(tmp_path / "run") as shown:
        (robots,) = ask(shown, "/api/v1/robots")
    assert [(robot["session"], robot["packets"]) for robot in robots.json()] == [("a", 0), ("a+1", 0), ("b", 0)]


def test_nobody_changes_a_shown_run_or_reads_it_by_another_name_of_this_machine(shown):
    before = {path: path.stat().st_mtime_ns for path in shown.run_folder.rglob("*")}
    paths = [f"/api/v1/{path}" for path in ("edits", "edits/1/undo", "finalize", "missions", "robots/a/packets")]
    assert {answer.status_code for answer in ask(shown, *paths, method="POST")} <= {404, 405}
    (page,) = ask(shown, "/")
    assert page.status_code == 200
    (page,) = ask(shown, "/", host="attacker.example")
    assert page.status_code == 421
    assert {path: path.stat().st_mtime_ns for path in shown.run_folder.rglob("*")} == before


class Elements(HTMLParser):
    """Every start tag with its attributes, and the text in it."""

    def __init__(self, html):
        super().__init__()
        self.found = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), []))

    def handle_endtag(self, tag):  # noqa: ARG002
        self.found.append(("", {}, []))  # takes the text between elements

    def handle_data(self, data):
        if self.found:
            self.found[-1][2].append(data)

    def of(self, tag):
        return [(attributes, "".join(texts)) for name, attributes, texts in self.found if name == tag]


def test_a_report_holds_all_that_the_page_asks_for_and_asks_nobody(shown):
    elements = Elements(asyncio.run(report_html(shown)))
    assert not elements.of("link")
    assert not any({"src", "href"} & set(attributes) for _, attributes, _ in elements.found)
    (data, texts), (module, script) = elements.of("script")
    assert (data, module) == ({"type": "application/json", "id": "responses"}, {"type": "module"})
    ((_, style),) = elements.of("style")
    policy = next(meta["content"] for meta, _ in elements.of("meta") if "http-equiv" in meta)
    for kind, content in (("script-src", script), ("style-src", style)):
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{kind} 'sha256-{digest}';" in policy
    assert policy.startswith("default-src 'none';")
    responses = json.loads(texts)
    trajectories = (f"trajectories/{name}.tum" for name in ("a", "a%2B1", "b"))
    layers = (f"maps/{k}/{part}" for k in (0, 1) for part in ("layers/quality", "walls"))
    paths = [*ASKED, *trajectories, *layers]
    assert set(responses["texts"]) == set(paths)
    for path, answer in zip(paths, ask(shown, *(f"/api/v1/{path}" for path in paths)), strict=True):
        assert responses["texts"][path].splitlines() == answer.text.splitlines() or path == "maps"
    deepest = [path for path in responses["pictures"] if path.startswith("maps/0/tiles/5/")]
    assert len(deepest) == 4  # 8 m from -3 m and -2 m on, in tiles of 16 m
    (tile,) = ask(shown, f"/api/v1/{deepest[0]}")
    assert base64.b64decode(responses["pictures"][deepest[0]]) == tile.content
    files = responses["files"]
    paths = ["maps/0.zip", "maps/1.zip", "maps/0.svg", "trajectories.zip"]
    for path, answer in zip(paths, ask(shown, *(f"/api/v1/{path}" for path in paths)), strict=True):
        assert gzip.decompress(base64.b64decode(files[path])) == answer.content
    with ZipFile(io.BytesIO(gzip.decompress(base64.b64decode(files["maps/1.zip"])))) as archive:
        assert archive.namelist() == ["map_1.pgm", "map_1.yaml"]


@pytest.mark.parametrize("is_small", [True, False])
def test_points_in_space_are_a_file_of_their_map_and_of_a_report_unless_they_are_too_many(run, tmp_path, is_small):
    points, poses = bytes(10 if is_small else MOST_POINTS_BYTES + 1), trajectory("b", 1).T_map_base
    lifted = se3.compose((0.0, 0.0, 1.4, 0.0, 0.0, 0.0, 1.0), se3.from_plane(poses))
    robots = run.trajectories | {"b": replace(trajectory("b", 1), T_map_base_6d=lifted)}
    replace(run, map_files=run.map_files | {"map_1.ply": points}, trajectories=robots).save(tmp_path / "run")
    with ShownRun(tmp_path / "run") as shown:
        answers = ask(shown, *(f"/api/v1/{path}" for path in ("maps", "robots", "maps/1.ply", "maps/0.ply")))
        maps, robots, sent, missing = answers
        ((_, texts), _) = Elements(asyncio.run(report_html(shown))).of("script")
    assert [one["in_space"] for one in maps.json()] == [False, True]
    assert [robot["z_m"] for robot in robots.json()] == [None, None, 1.4]
    assert (sent.content == points, missing.status_code) == (True, 404)
    held = json.loads(texts)
    assert ("maps/1.ply" in held["files"]) == is_small == json.loads(held["texts"]["maps"])[1]["in_space"]


@pytest.mark.parametrize(("resolution_m", "zoom"), [(2.0, 0), (8.0, 0), (64.0, -1)])
def test_a_report_of_a_huge_map_holds_coarse_tiles_or_none(run, tmp_path, resolution_m, zoom):
    replace(run, map_files=files("map", 400, resolution_m)).save(tmp_path / "run")
    with ShownRun(tmp_path / "run") as shown:
        ((_, texts), _) = Elements(asyncio.run(report_html(shown))).of("script")
    responses = json.loads(texts)
    assert json.loads(responses["texts"]["maps"])[0]["zoom"] == zoom
    assert len(responses["pictures"]) <= MOST_TILES


def test_a_report_of_what_cannot_be_shown_says_what(run, tmp_path):
    (closure,) = run.closures
    replace(run, closures=(replace(closure, T_i_j=np.full(3, np.nan)),)).save(tmp_path / "run")
    with ShownRun(tmp_path / "run") as shown, pytest.raises(InputError, match="closures"):
        asyncio.run(report_html(shown))


def test_what_cannot_be_read_of_a_run_is_not_there(shown, tmp_path):
    folder = tmp_path / "run"
    (folder / "map.yaml").write_bytes(b"\xff")
    (folder / "trajectories" / "c.tum").symlink_to("a.tum")
    assert [a.status_code for a in ask(shown, "/api/v1/maps/0/walls", "/api/v1/trajectories.zip")] == [404, 404]


@pytest.mark.parametrize("name", ["trajectories/c.tum", "map.png", "pose_graph.g2o"])
def test_a_report_of_a_run_with_a_link_says_so(shown, tmp_path, name):
    """A link could take a file of the user into a report that is sent on."""
    (tmp_path / "private").write_text("secret")
    place = tmp_path / "run" / name
    place.unlink(missing_ok=True)
    place.symlink_to(tmp_path / "private")
    with pytest.raises(InputError, match=place.name):
        asyncio.run(report_html(shown))


def test_a_run_without_trajectories_has_no_archive_of_them(tmp_path):
    Run({}, metrics={"maps": Metric("maps", 0, "1")}).save(tmp_path / "run")
    with ShownRun(tmp_path / "run") as shown:
        (answer,) = ask(shown, "/api/v1/trajectories.zip")
        assert (answer.status_code, answer.json()) == (404, {"error": "there are no trajectories"})


CHROMIUM = shutil.which("chromium")


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_a_browser_shows_a_report_from_a_file(shown, tmp_path):
    (tmp_path / "report.html").write_text(asyncio.run(report_html(shown)))
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    command = [CHROMIUM, *options, "--virtual-time-budget=3000", "--dump-dom", f"file://{tmp_path / 'report.html'}"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120.0)
    elements = Elements(done.stdout)
    assert [text for attributes, text in elements.of("p") if attributes.get("id") == "status"] == ["Finished run"]
    assert [text for _, text in elements.of("title")] == ["fcslam: run"]
    tabs = [text for attributes, text in elements.of("button") if "data-map" in attributes]
    assert tabs == ["a and a+1", "b"]
    states = [text for attributes, text in elements.of("p") if attributes.get("class") == "state"]
    assert states[:2] == [
        "Use this map, but its accuracy is not known.",
        "Do not use this map yet: it shows 4.5 m of path; drive at least 5 m.",
    ]
    assert states[2:4] == ["Finished, not joined with the others yet"] * 2


def test_a_report_holds_every_path_that_the_page_names():
    script = "".join((ASSETS / name).read_text(encoding="utf-8") for name in MODULES)
    named = re.findall(r'\b(?:json|ask)\("([^"]+)"\)', script)
    assert "maps" in named
    assert set(named) - {"events"} <= set(ASKED)


def test_a_module_imports_only_modules_before_it():
    for k, name in enumerate(MODULES):
        script = (ASSETS / name).read_text(encoding="utf-8")
        assert set(re.findall(r'from "\./([^"]+)"', script)) <= set(MODULES[:k])
        assert not re.search(r"^(import [^;]*( as |\*)|export (default|let|\{))", script, re.MULTILINE)
