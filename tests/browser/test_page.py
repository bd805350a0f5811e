"""The page in a real browser, in front of a real service: what a person sees, clicks and types."""

import asyncio
import json
import os
import re
import signal
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit
from zipfile import ZipFile

import httpx
import numpy as np
import pytest
import yaml

from fcslam.cli import main
from fcslam.geometry import se3
from fcslam.maps.joint_voxels import ply_of
from fcslam.maps.occupancy_map import parse_map
from fcslam.maps.palette import APPEARED, FLOOR, ROBOTS, WALL
from fcslam.page.report import ShownRun, report_html
from fcslam.records import KeyscanId, VoxelMap
from tests.cli.test_serve import API, Service, send
from tests.mission.test_map_changes import write_run
from tests.postgres import free_port

pytestmark = pytest.mark.system

playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright: make browser-test")

AXE = Path(os.environ.get("FCSLAM_AXE", ".venv/axe/package/axe.min.js"))
"""axe-core, which looks for faults of accessibility; it comes from npm."""
MOVED = 0x6A1B9A
"""Colour of a wall that is elsewhere in the floor plan, on a light page."""
WAIT_MS = 60_000
ROUNDS = """round,version,released,robots,left_out,loss_triplet,mma_3px
1,a,0,anna | bob,,0.5,0.25
2,b,1,anna,bob: too late,0.25,0.375
"""


@pytest.fixture
def page(browser):
    """A page whose requests to other hosts fail, as does a test in which a script fails."""
    errors, hosts = [], set()
    with closing(browser.new_page(viewport={"width": 1200, "height": 900})) as opened:
        opened.set_default_timeout(WAIT_MS)
        opened.on("pageerror", lambda error: errors.append(str(error)))
        opened.on("request", lambda request: hosts.add(urlsplit(request.url).hostname))
        yield opened
        assert hosts <= {"127.0.0.1"}
        assert errors == []


def play(url, packets, robots, **headers):
    with httpx.Client(base_url=url, timeout=300.0) as client:
        for robot in robots:
            send(client, robot, [packet for packet in packets if packet.robot == robot], **headers)


def says(page, selector, text):
    playwright.expect(page.locator(selector)).to_contain_text(text, timeout=WAIT_MS)


def maps(page):
    """Titles of the maps; the page hides them while there is one."""
    return page.locator("#tabs button").all_text_contents()


def view(page, name):
    page.locator(f"nav [data-view={name}]").click()


def until(page, condition, what):
    for _ in range(WAIT_MS // 100):
        if condition():
            return
        page.wait_for_timeout(100)
    pytest.fail(f"the page never came to it: {what}")


def pixels(page, colours):
    """Number of pixels of the map's canvas in each of these colours."""
    return page.evaluate(
        """(colours) => {
            const canvas = document.getElementById("map"), pen = canvas.getContext("2d");
            const shown = new Uint32Array(pen.getImageData(0, 0, canvas.width, canvas.height).data.buffer);
            const counts = new Map(colours.map((rgb) => [((rgb & 255) << 16) | (rgb & 0xff00) | (rgb >> 16), 0]));
            for (const abgr of shown) {
                const colour = abgr & 0xffffff, count = counts.get(colour);
                if (count !== undefined) counts.set(colour, count + 1);
            }
            return [...counts.values()];
        }""",
        colours,
    )


def has_map(page):
    """Whether walls and floor are drawn, in the colours of a light page."""
    return min(pixels(page, [WALL, FLOOR])) > 100


@pytest.fixture(scope="module")
def mapped(packets, tmp_path_factory):
    """A service that anybody may change, with three robots in one map and two rounds of training."""
    data = tmp_path_factory.mktemp("mapped") / "data"
    (data / "learning").mkdir(parents=True)
    (data / "learning" / "rounds.csv").write_text(ROUNDS)
    with closing(Service(data)) as service:
        play(service.url, packets, ("robot_1", "robot_2", "robot_3"))
        with httpx.Client(base_url=service.url, timeout=60.0) as client:
            while client.get("/readyz").status_code != 200 or len(client.get(f"{API}/maps").json()) != 1:
                time.sleep(0.2)
        yield service


def test_robots_join_before_the_eyes_of_a_viewer_although_the_service_is_killed(page, packets, tmp_path):
    again = tmp_path / "data", "--port", str(free_port())
    service = Service(*again)
    page.goto(service.url)
    says(page, "#empty", "No robot has sent anything yet")
    play(service.url, packets, ("robot_1",))
    says(page, "#robots", "robot_1")
    until(page, lambda: has_map(page), "the map of the first robot")
    assert not page.locator("#empty").is_visible()
    service.kill()
    says(page, "#status", "No connection to the service; trying again")
    with closing(Service(*again)) as service:
        says(page, "#status", "Live")
        play(service.url, packets, ("robot_2", "robot_3"))
        says(page, "#robots", "robot_3")
        until(page, lambda: maps(page) == ["robot_1, robot_2 and robot_3"], "one map")
        view(page, "history")
        says(page, "#events", "robot_2 begins to map")
        says(page, "#events", "saw the same place for the first time")
        says(page, "#status", "Live")


def colours_in(page, selector):
    return page.locator(f"{selector} .swatch").evaluate_all("all => all.map((one) => one.style.background)")


def test_edits_show_at_once_a_veto_its_undo_and_a_removed_robot(page, packets, tmp_path):
    tiles = []
    page.on("request", lambda request: tiles.append(request.url) if "/tiles/" in request.url else None)
    with closing(Service(tmp_path / "data")) as service:
        play(service.url, packets, ("robot_2",))
        page.goto(service.url)
        says(page, "#robots", "robot_2")
        (colour,) = colours_in(page, "#robots")
        play(service.url, packets, ("robot_1",))
        until(page, lambda: maps(page) == ["robot_2 and robot_1"], "one map")
        until(page, lambda: colours_in(page, "#robots")[1:] == [colour], "a robot keeps its colour")
        view(page, "evidence")
        pairs, vetoes = page.locator("#list tr"), 0
        while len(maps(page)) == 1:
            until(page, lambda: pairs.count() or len(maps(page)) == 2, "a pair or two maps")
            if not pairs.count():
                break
            key = pairs.first.get_attribute("data-key")
            pairs.first.locator("button").click()
            page.locator("#veto").click()
            vetoes += 1
            says(page, "#message", f"Saved as edit {vetoes}")
            vetoed = page.locator(f'#list tr[data-key="{key}"]')
            until(page, lambda: not vetoed.count() or len(maps(page)) == 2, "the veto")  # noqa: B023
        view(page, "attention")
        says(page, "#verdicts", "has another map")
        tabs = page.locator("#tabs button")
        for number in (1, 0):
            tabs.nth(number).click()
            assert page.locator('#tabs [aria-pressed="true"]').get_attribute("data-map") == str(number)
        view(page, "edits")
        for number in range(1, vetoes + 1):
            page.get_by_role("button", name=f"Undo edit {number}", exact=True).click()
        until(page, lambda: maps(page) == ["robot_2 and robot_1"], "one map again")
        view(page, "evidence")
        page.locator("#list button").first.click()
        until(page, lambda: colour in colours_in(page, "#sides"), "the same colour")
        until(page, lambda: has_map(page), "the map")
        before = len(tiles)
        removal = {"kind": "removal", "content": {"robot": "robot_2"}}
        assert httpx.post(f"{service.url}{API}/edits", json=removal, timeout=60.0).status_code == 201
        says(page, "#robots", "Removed by hand")
        says(page, "#message", "The chosen pair is no longer there")
        assert not page.locator("#closure").is_visible()
        until(page, lambda: len(tiles) > before, "the tiles of the edited map")


def test_a_line_on_the_map_is_selected_and_shows_what_both_robots_saw(page, mapped):
    page.goto(mapped.url)
    until(page, lambda: has_map(page), "the map")
    page.locator("#layers summary").click()
    page.locator("#layer-closures").check()
    box = page.locator("#map").bounding_box()
    for across in range(300, int(box["width"]), 7):
        page.mouse.click(box["x"] + across, box["y"] + box["height"] / 2)
        if page.locator("#closure").is_visible():
            break
    says(page, "#facts-of-closure", "Off by")
    playwright.expect(page.locator("#overlay")).to_be_visible(timeout=WAIT_MS)


def test_the_evidence_is_sorted_and_filtered(page, mapped):
    page.goto(f"{mapped.url}#view=evidence")
    cells = page.locator("#list tr td:nth-child(6)")
    until(page, lambda: cells.count() > 3, "pairs")
    for down in (False, True):
        page.get_by_role("button", name="Off by").click()
        shown = [0.5 if "under" in text else float(text.split()[0]) for text in cells.all_inner_texts()]
        assert shown == sorted(shown, reverse=down)
    page.locator("#of-robot").select_option("robot_3")
    until(page, lambda: all("robot_3" in text for text in page.locator("#list tr").all_inner_texts()), "one robot")


def test_the_past_of_a_mission_is_shown(page, mapped):
    page.goto(f"{mapped.url}#view=history")
    until(page, lambda: has_map(page) and page.locator("#events li").count() > 3, "the map")
    page.wait_for_timeout(1000)

    def coloured():
        return sum(pixels(page, list(ROBOTS[:3])))

    now = coloured()
    page.locator("#moment").fill("10")
    shown, total = map(int, re.search(r"(\d+) of (\d+) scans", page.locator("#share").inner_text()).groups())
    assert shown == -(-total // 100)
    says(page, "#until", "min into the drive")
    until(page, lambda: coloured() < now / 2, "paths that end in the past")
    page.locator("#moment").fill("1000")
    says(page, "#until", "now")
    until(page, lambda: coloured() == now, "the paths of now")


def test_a_distance_is_measured_and_a_link_opens_the_same_view(page, browser, mapped):
    page.goto(f"{mapped.url}#view=map")
    until(page, lambda: has_map(page), "the map")
    page.locator("[data-tool=distance]").click()
    metres = page.evaluate("() => Number(document.getElementById('metres').textContent.split(' ')[0])")
    bar = page.locator("#bar").bounding_box()["width"]
    box = page.locator("#map").bounding_box()
    for across in (300, 300 + bar):
        page.mouse.click(box["x"] + across, box["y"] + 300)
    assert float(page.locator("#measured").inner_text().split()[0]) == pytest.approx(metres, rel=0.03)
    page.keyboard.press("Escape")
    page.locator("#map").focus()
    for key in ("+", "+", "ArrowLeft"):
        page.keyboard.press(key)
    until(page, lambda: "scale" in page.url, "the view in the address")
    page.wait_for_timeout(500)
    place = page.url
    with closing(browser.new_page(viewport=page.viewport_size)) as other:
        other.goto(place)
        until(other, lambda: has_map(other), "the same view")
        assert other.locator("#metres").inner_text() == page.locator("#metres").inner_text()
        until(other, lambda: other.url == place, "the same address")


def drag(page, low, high):
    """Drag a box on the map; corners as shares of its width and height."""
    box = page.locator("#map").bounding_box()
    (x, y), (u, v) = ([box["x"] + a * box["width"], box["y"] + b * box["height"]] for a, b in (low, high))
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move((x + u) / 2, (y + v) / 2)
    page.mouse.move(u, v)
    page.mouse.up()
    says(page, "#measured", "4 points")


def test_a_keep_out_is_drawn_and_taken_back_and_the_map_is_downloaded(page, mapped, tmp_path):
    page.goto(f"{mapped.url}#view=edits")
    until(page, lambda: has_map(page), "the map")
    page.get_by_role("button", name="Keep robots out").click()
    drag(page, (0.5, 0.5), (0.6, 0.6))
    page.locator("#save").click()
    says(page, "#edits", "drew a keep-out")
    edit = httpx.get(f"{mapped.url}{API}/edits").json()[-1]
    assert (edit["kind"], edit["content"]["use"], len(edit["content"]["polygon"])) == ("region", "keep-out", 4)
    page.get_by_role("button", name=f"Undo edit {edit['number']}", exact=True).click()
    says(page, "#edits", f"taken back by edit {edit['number'] + 1}")
    view(page, "files")
    with page.expect_download() as downloaded:
        page.get_by_role("button", name="Map for Nav2").click()
    downloaded.value.save_as(tmp_path / "map.zip")
    with ZipFile(tmp_path / "map.zip") as archive:
        assert archive.testzip() is None
        content = {name: archive.read(name) for name in ("map.pgm", "map.yaml")}
    assert parse_map("map", content["map.pgm"], content["map.yaml"].decode()).cells.size > 0


def test_a_robot_is_found_by_its_name_and_a_silent_one_is_named(page, mapped):
    robots = httpx.get(f"{mapped.url}{API}/robots").json()
    told = [{**robot, "last_heard_s": 150.0 if robot["robot"] == "robot_3" else 1.0} for robot in robots]
    page.route("**/api/v1/robots", lambda route: route.fulfill(body=json.dumps(told)))
    page.goto(mapped.url)
    page.locator("#robots").get_by_role("button", name="robot_2").click()
    until(page, lambda: "robot=robot_2" in page.url, "the chosen robot in the address")
    x, y = (float(re.search(rf"[&#]{axis}=(-?[\d.]+)", page.url)[1]) for axis in "xy")
    (pose,) = [robot["T_map_base"] for robot in robots if robot["robot"] == "robot_2"]
    assert (x, y) == pytest.approx(pose[:2], abs=0.01)
    says(page, "#needs", "1")
    view(page, "attention")
    says(page, "#attention", "robot_3 has been silent for 3 min.")
    page.get_by_role("button", name="Show where it was").click()
    until(page, lambda: "robot=robot_3" in page.url, "the silent robot")


def test_a_report_tells_of_days_of_changes_and_of_accuracy(browser, tmp_path):
    folder = write_run(tmp_path / "building", (0, 1))
    certificate = {"bar": 0.05, "cell": 1.0, "drives": [], "cells": [{"x": 0.0, "y": 0.0, "good": True}] * 3}
    certificate |= {"within": 10.0, "error_95": 0.03, "good_share": 1.0}
    (folder / "quality.json").write_text(json.dumps({"0": certificate}))
    moved = {"kind": "moved", "start": [-1.0, 0.0], "end": [1.0, 0.0], "length_m": 2.0, "by_m": 0.3}
    plan = {"drawing": "M-2 -2L2 -2z", "maps": [{"map": 0, "aligned": True, "deviations": [moved]}]}
    (folder / "plan.json").write_text(json.dumps(plan))
    with ShownRun(folder) as shown, ThreadPoolExecutor(1) as beside:  # Playwright has the loop of this thread
        (tmp_path / "report.html").write_text(beside.submit(asyncio.run, report_html(shown)).result())
    with (
        closing(browser.new_context(timezone_id="UTC", locale="en-GB")) as context,
        closing(context.new_page()) as page,
    ):
        page.goto(f"file://{tmp_path / 'report.html'}")
        says(page, "#verdicts", "accurate to 3 cm within 10 m")
        page.locator("#layers summary").click()
        page.wait_for_timeout(500)
        assert pixels(page, [APPEARED]) == [0]
        page.get_by_label("Since the first day").check()
        until(page, lambda: pixels(page, [APPEARED])[0] > 50, "what appeared")
        page.get_by_label("Floor plan").check()
        until(page, lambda: pixels(page, [MOVED])[0] > 50, "the wall that moved")
        assert not page.get_by_label("Tags").is_visible()
        view(page, "history")
        says(page, "#events", "Monday")
        page.get_by_role("button", name="anna begins drive 2").click()
        says(page, "#until", "17/11/2026")


def test_a_map_in_space_is_shown_from_above_up_to_a_cut(browser, tmp_path):
    folder, cells = write_run(tmp_path / "building", (0,)), 5 * np.mgrid[-5:5, -5:5].reshape(2, -1).T
    points = np.concatenate([np.column_stack((cells, np.full(len(cells), z))) for z in (0, 135)]).astype(np.int16)
    scanner, seen_from = np.zeros((1, 3), np.int16), np.zeros(len(points), np.uint8)
    voxels = VoxelMap(KeyscanId("anna", 0), 0, 0, se3.IDENTITY, points, scanner, seen_from)
    (folder / "map.ply").write_bytes(ply_of([(voxels, se3.IDENTITY)]))
    floor, ceiling = 0x440154, 0xFDE725
    with ShownRun(folder) as shown, ThreadPoolExecutor(1) as beside:
        (tmp_path / "report.html").write_text(beside.submit(asyncio.run, report_html(shown)).result())
    with closing(browser.new_page(viewport={"width": 1200, "height": 900})) as page:
        page.goto(f"file://{tmp_path / 'report.html'}")
        until(page, lambda: pixels(page, [floor])[0] > 100, "the floor, below the ceiling")
        assert pixels(page, [ceiling]) == [0]
        page.locator("#height").fill(page.locator("#height").get_attribute("max"))
        until(page, lambda: pixels(page, [floor])[0] == 0, "the ceiling over the floor")
        assert pixels(page, [ceiling])[0] > 100
        page.locator("#layers summary").click()
        page.get_by_label("3D from above").uncheck()
        until(page, lambda: pixels(page, [ceiling])[0] == 0, "the plane")
        assert not page.locator("#height").is_visible()


def test_rounds_of_a_federated_training_are_listed(page, mapped):
    page.goto(mapped.url)
    page.get_by_text("Shared training").click()
    says(page, "#learned", "2 rounds, 1 released")
    assert page.locator("#of-rounds th").all_inner_texts() == ["Round", "Robots", "Left out", "triplet", "mma 3px"]
    assert page.locator("#rounds tr").first.locator("th, td").all_inner_texts() == [
        "2, released", "anna", "bob: too late", "0.250", "0.375"
    ]  # fmt: skip


@pytest.fixture(scope="module")
def credentials(tmp_path_factory):
    folder = tmp_path_factory.mktemp("credentials")
    assert main(["tools", "certificates", "-o", str(folder), "--robot=robot_1", "--robot=robot_2", "--viewer=eye"]) == 0
    return folder


def test_a_viewer_sees_and_may_not_veto_and_one_whose_token_expires_loses_nothing(page, packets, credentials, tmp_path):
    def token(name):
        (place,) = credentials.glob(f"*/{name}/token")
        return place.read_text().strip()

    tokens = tmp_path / "tokens.yaml"
    tokens.write_bytes((credentials / "tokens.yaml").read_bytes())
    with closing(Service(tmp_path / "data", "--credentials", str(tmp_path))) as service:
        for robot in ("robot_1", "robot_2"):
            play(service.url, packets, (robot,), Authorization=f"Bearer {token(robot)}")
        page.goto(service.url)
        says(page, "#status", "needs a token")
        page.get_by_label("Token").fill("wrong")
        page.keyboard.press("Enter")
        says(page, "#status", "needs a token")
        page.get_by_label("Token").fill(token("eye"))
        page.keyboard.press("Enter")
        says(page, "#status", "Live")
        says(page, "#robots", "robot_2")
        view(page, "evidence")
        until(page, lambda: page.locator("#list tr").count() > 0, "pairs")
        page.locator("#list button").first.click()
        playwright.expect(page.locator("#locate")).to_be_visible(timeout=WAIT_MS)
        view(page, "edits")
        says(page, "#locked", "Your token may look")
        assert page.locator(".admin:visible").count() == 0
        files = page.locator("#files").text_content()
        assert "Report (html)" in files
        assert not any(name in files for name in ("Mission file", "Finished run"))
        with httpx.Client(base_url=service.url, headers={"Authorization": f"Bearer {token('eye')}"}) as client:
            assert client.get(f"{API}/edits").json() == []
        view(page, "fleet")
        entries = yaml.safe_load(tokens.read_text())["tokens"]
        tokens.write_text(yaml.safe_dump({"tokens": [entry for entry in entries if entry["name"] != "eye"]}))
        service.process.send_signal(signal.SIGHUP)
        page.get_by_role("button", name="robot_1").click()
        says(page, "#status", "needs a token")
        playwright.expect(page.get_by_label("Token")).to_be_visible(timeout=WAIT_MS)
        says(page, "#robots", "robot_1")
        assert page.get_by_role("button", name="robot_1").get_attribute("aria-pressed") == "true"


def covered_controls(page):
    """The buttons of the map that a finger cannot reach, while many messages wait for the map."""
    return page.evaluate(
        """() => {
            document.getElementById("age").textContent = "Map drawn 12 min ago; 12,345 messages not in it yet. ";
            return [...document.querySelectorAll("#controls button, #layers summary")].filter((button) => {
                const { left, top, width, height } = button.getBoundingClientRect();
                return width && [0.1, 0.9].some((y) => !button.contains(
                    document.elementFromPoint(left + width / 2, top + y * height)));
            }).map((button) => button.textContent);
        }"""
    )


def test_the_page_fits_a_phone(browser, mapped):
    with closing(browser.new_page(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)) as phone:
        phone.goto(mapped.url)
        until(phone, lambda: has_map(phone), "the map")
        verdict, drawn = (phone.locator(part).bounding_box() for part in ("#verdicts", "#map"))
        assert verdict["y"] < drawn["y"], "the verdict comes first"
        for name in ("evidence", "edits", "files", "map"):
            view(phone, name)
            assert phone.evaluate("document.documentElement.scrollWidth") <= 390
        for name in ("fleet", "map"):
            view(phone, name)
            assert covered_controls(phone) == []
        box = phone.locator("#map").bounding_box()
        assert box["width"] == 390
        assert box["height"] > 300


def test_the_keyboard_is_enough(page, mapped):
    page.goto(mapped.url)
    until(page, lambda: has_map(page), "the map")

    def tab_to(selector):
        for _ in range(60):
            page.keyboard.press("Tab")
            if page.evaluate("selector => document.activeElement.matches(selector)", selector):
                return
        pytest.fail(f"the keyboard does not reach {selector}")

    tab_to("[data-view=evidence]")
    page.keyboard.press("Enter")
    until(page, lambda: page.locator("#list tr").count() > 0, "pairs")
    tab_to("#list button")
    page.keyboard.press("Enter")
    playwright.expect(page.locator("#closure")).to_be_visible(timeout=WAIT_MS)
    tab_to("#pin")
    page.keyboard.press("Enter")
    says(page, "#message", "Saved as edit")
    view(page, "map")
    page.locator("body").focus()
    tab_to("#map")
    before = page.locator("#map").screenshot()
    for key in ("ArrowLeft", "+", "+", "ArrowUp"):
        page.keyboard.press(key)
    page.wait_for_timeout(500)
    assert page.locator("#map").screenshot() != before


def test_a_connection_that_falls_silent_is_noticed(page, mapped):
    page.route("**/api/v1/events", lambda _: None)  # nothing ever comes
    page.goto(mapped.url)
    says(page, "#status", "No connection to the service; trying again")
    page.unroute("**/api/v1/events")
    says(page, "#status", "Live")


def fulfil(answer, route):
    route.fulfill(body=json.dumps(answer))


def test_a_robot_with_a_hostile_name_is_text(page, mapped):
    """No robot can have such a name; a page must not rely on that."""
    evil = "<script>window.evil=1</script><img src=x onerror=window.evil=1>"

    def ask(path):
        return httpx.get(f"{mapped.url}{API}/{path}").json()

    region = {"kind": "region", "content": {"use": "area", "name": evil, "session": evil, "stamp": 0, "polygon": []}}
    closures = [
        {**one, "robot_i": evil, "robot_j": f"{evil}+1", "explanation": evil}
        for one in ask("closures?status=accepted&limit=5")
    ]
    answers = {
        "fleet": {**ask("fleet"), "mission": evil, "maps": 2},
        "robots": [{**robot, "session": evil, "robot": evil, "floor": evil} for robot in ask("robots")],
        "maps": [{**ask("maps")[0], "map": k, "robots": [evil], "floor": evil} for k in (0, 1)],
        "edits": [{**region, "number": 1, "author": evil, "time_s": 1e9, "undone_by": None}],
        "verdicts": [{"map": 0, "robots": [evil], "use": "reserve", "sentence": evil, "details": [evil], "where": []}],
        "closures?*": closures,
        "metrics.json": [{"name": evil, "value": 1.0, "unit": evil}],
    }
    for path, answer in answers.items():
        page.route(f"**/api/v1/{path}", partial(fulfil, answer))
    page.route("**/api/v1/trajectories/**", lambda route: route.fulfill(body="0 0 0 0 0 0 0 1\n"))
    page.goto(mapped.url)
    says(page, "#robots", evil)
    says(page, "#verdicts", evil)
    page.get_by_text("All numbers").click()
    says(page, "#metrics", evil)
    for name, where in {"history": "#events", "edits": "#edits", "files": "#files"}.items():
        view(page, name)
        says(page, where, evil)
    view(page, "evidence")
    page.locator("#two-robots").uncheck()
    page.locator("#list button").first.click()
    says(page, "#facts-of-closure", evil)
    assert page.evaluate("window.evil") is None
    assert page.locator("main img, main script").count() == 0


def test_axe_finds_no_fault(browser, mapped):
    if not AXE.exists():
        pytest.skip("no axe-core: make browser-test")
    for scheme, width in (("light", 1200), ("dark", 360)):
        context = browser.new_context(bypass_csp=True, color_scheme=scheme, viewport={"width": width, "height": 800})
        with closing(context), closing(context.new_page()) as page:
            page.goto(mapped.url)
            until(page, lambda: has_map(page) or scheme == "dark", "the map")  # noqa: B023
            view(page, "map")
            page.locator("#layers summary").click()
            page.add_script_tag(path=AXE)
            for name in ("map", "fleet", "attention", "evidence", "history", "edits", "files"):
                view(page, name)
                if name == "evidence":
                    page.locator("#list button").first.click()
                assert [(name, fault["id"]) for fault in page.evaluate("axe.run()")["violations"]] == []
                assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_a_slow_reader_of_events_keeps_nobody_waiting(page, mapped):
    """200 pages that read nothing, and one that works."""
    with suppress(OSError):
        address = urlsplit(mapped.url)
        idle = [socket.create_connection((address.hostname, address.port)) for _ in range(200)]
        for one in idle:
            one.sendall(b"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    page.goto(mapped.url)
    says(page, "#status", "Live")
    says(page, "#robots", "robot_1")
    for one in idle:
        one.close()
