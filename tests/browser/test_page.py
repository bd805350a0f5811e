"""The page in a real browser, in front of a real service: what a person sees, clicks and types."""

import json
import os
import re
import signal
import socket
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from fcslam.cli import main
from fcslam.page.routes import ASSETS
from tests.cli.test_serve import API, Service, send

pytestmark = pytest.mark.system

playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright: make browser-test")

AXE = Path(os.environ.get("FCSLAM_AXE", ".venv/axe/package/axe.min.js"))
"""axe-core, which looks for faults of accessibility; it comes from npm."""
WAIT_MS = 60_000
WHOLE_PAGE_BYTES = 150_000


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


def options(page, selector):
    return page.locator(f"{selector} option").all_inner_texts()


def until(page, condition, what):
    for _ in range(WAIT_MS // 100):
        if condition():
            return
        page.wait_for_timeout(100)
    pytest.fail(f"the page never came to it: {what}")


def painted(page):
    """Shades of grey on the map's canvas: paper, floor and walls once there is a map."""
    return page.evaluate(
        """() => {
            const canvas = document.getElementById("map"), pen = canvas.getContext("2d");
            const pixels = pen.getImageData(0, 0, canvas.width, canvas.height).data, shades = new Set();
            for (let k = 0; k < pixels.length; k += 4)
                if (pixels[k + 3] && pixels[k] === pixels[k + 1] && pixels[k] === pixels[k + 2]) shades.add(pixels[k]);
            return shades.size;
        }"""
    )


def coloured(page):
    """Pixels of the map's canvas that are not grey: paths, robots and closures."""
    return page.evaluate(
        """() => {
            const canvas = document.getElementById("map"), pen = canvas.getContext("2d");
            const pixels = pen.getImageData(0, 0, canvas.width, canvas.height).data;
            let count = 0;
            for (let k = 0; k < pixels.length; k += 4)
                count += pixels[k] !== pixels[k + 1] || pixels[k] !== pixels[k + 2];
            return count;
        }"""
    )


@pytest.fixture(scope="module")
def mapped(packets, tmp_path_factory):
    """A service that anybody may change, with three robots in one map."""
    with closing(Service(tmp_path_factory.mktemp("mapped") / "data")) as service:
        play(service.url, packets, ("robot_1", "robot_2", "robot_3"))
        with httpx.Client(base_url=service.url, timeout=60.0) as client:
            while client.get("/readyz").status_code != 200 or len(client.get(f"{API}/maps").json()) != 1:
                pass
        yield service


def test_robots_join_before_the_eyes_of_a_viewer(page, packets, tmp_path):
    with closing(Service(tmp_path / "data")) as service:
        page.goto(service.url)
        says(page, "#status", "live")
        play(service.url, packets, ("robot_1",))
        says(page, "#robots", "robot_1")
        until(page, lambda: painted(page) >= 3, "the map of the first robot")
        play(service.url, packets, ("robot_2", "robot_3"))
        says(page, "#robots", "robot_3")
        until(page, lambda: options(page, "#maps") == ["0: robot_1, robot_2, robot_3"], "one map")
        says(page, "#events", "robot_2 begins")


def test_a_veto_separates_maps_and_its_undo_joins_them_again(page, packets, tmp_path):
    with closing(Service(tmp_path / "data")) as service:
        play(service.url, packets, ("robot_1", "robot_2"))
        page.goto(service.url)
        until(page, lambda: options(page, "#maps") == ["0: robot_1, robot_2"], "one map")
        vetoes = 0
        while len(options(page, "#maps")) == 1:
            between = page.locator("#list option").filter(has_text=re.compile("robot_1.*robot_2"))
            until(page, lambda: between.count() or len(options(page, "#maps")) == 2, "a closure or two maps")  # noqa: B023
            if not between.count():
                break
            page.locator("#list").select_option(between.first.get_attribute("value"))
            says(page, "#facts-of-closure", "robot_1 (blue) and robot_2 (orange)")
            page.locator("#veto").click()
            vetoes += 1
            says(page, "#message", f"Edit {vetoes} (veto) is stored")
            until(
                page,
                lambda: "vetoed" in page.locator("#facts-of-closure").inner_text() or len(options(page, "#maps")) == 2,
                "the veto",
            )
        assert page.locator("#separations li").count() == 1
        pictures = page.locator("#previews button")
        assert pictures.count() == 2
        for number in (1, 0):
            pictures.nth(number).click()
            assert page.locator("#maps").input_value() == str(number)
            assert pictures.nth(number).get_attribute("aria-pressed") == "true"
        for number in range(1, vetoes + 1):
            page.get_by_role("button", name=f"Undo edit {number}", exact=True).click()
        until(page, lambda: options(page, "#maps") == ["0: robot_1, robot_2"], "one map again")


def test_a_closure_is_selected_on_the_map_and_shows_both_submaps(page, mapped):
    page.goto(mapped.url)
    until(page, lambda: page.locator("#list option").count() > 0 and painted(page) >= 3, "closures")
    box = page.locator("#map").bounding_box()
    for across in range(20, int(box["width"]), 7):
        page.mouse.click(box["x"] + across, box["y"] + box["height"] / 2)
        if page.locator("#closure").is_visible():
            break
    says(page, "#facts-of-closure", "Similarity")
    playwright.expect(page.locator("#overlay")).to_be_visible(timeout=WAIT_MS)


def test_the_past_of_a_mission_is_shown(page, mapped):
    page.goto(mapped.url)
    until(page, lambda: page.locator("#list option").count() > 0 and painted(page) >= 3, "the map")
    page.wait_for_timeout(1000)
    now = coloured(page)
    page.locator("#moment").fill("10")
    told = re.search(r"(\d+) of (\d+) keyscans, (\d+) of (\d+) closures", page.locator("#until").inner_text())
    shown, total, closures, accepted = map(int, told.groups())
    assert shown == -(-total // 100)
    assert closures < accepted
    until(page, lambda: coloured(page) < now / 4, "paths that end in the past")
    page.locator("#moment").fill("1000")
    says(page, "#until", "now")
    until(page, lambda: coloured(page) == now, "the paths of now")


def test_rounds_of_a_federated_training_are_drawn(page, tmp_path):
    head = "round,version,released,robots,left_out,loss_triplet,mma_3px"
    (tmp_path / "rounds.csv").write_text(f"{head}\n1,a,0,anna | bob,,0.5,0.25\n2,b,1,anna,bob: too late,0.25,0.375\n")
    with closing(Service(tmp_path / "data", "--learning", str(tmp_path))) as service:
        page.goto(service.url)
        page.get_by_text("Federated training").click()
        says(page, "#learned", "2 rounds, 1 released")
        assert page.locator("#curves polyline").count() == 2
        assert page.locator("#curves circle").count() == 2
        assert page.locator("#rounds tr").first.locator("th, td").all_inner_texts() == [
            "2, released", "0.375", "anna", "bob: too late"
        ]  # fmt: skip


def test_the_page_recovers_when_the_service_is_killed_and_comes_back(page, packets, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    service = Service(tmp_path / "data", "--port", str(port))
    play(service.url, packets, ("robot_1",))
    page.goto(service.url)
    says(page, "#robots", "robot_1")
    service.kill()
    says(page, "#status", "no connection; trying again")
    with closing(Service(tmp_path / "data", "--port", str(port))) as service:
        says(page, "#status", "live")
        play(service.url, packets, ("robot_2",))
        says(page, "#robots", "robot_2")


@pytest.fixture(scope="module")
def credentials(tmp_path_factory):
    folder = tmp_path_factory.mktemp("credentials")
    assert main(["certificates", "-o", str(folder), "--robot=robot_1", "--robot=robot_2", "--viewer=eye"]) == 0
    return folder


def test_a_viewer_sees_and_may_not_veto(page, packets, credentials, tmp_path):
    def token(name):
        return (credentials / "tokens" / name).read_text().strip()

    with closing(Service(tmp_path / "data", "--tokens", str(credentials / "tokens.yaml"))) as service:
        for robot in ("robot_1", "robot_2"):
            play(service.url, packets, (robot,), Authorization=f"Bearer {token(robot)}")
        page.goto(service.url)
        says(page, "#status", "needs")
        page.get_by_label("Token").fill("wrong")
        page.keyboard.press("Enter")
        says(page, "#status", "needs")
        page.get_by_label("Token").fill(token("eye"))
        page.keyboard.press("Enter")
        says(page, "#status", "live")
        until(page, lambda: page.locator("#list option").count() > 0, "closures")
        page.locator("#list").select_option(index=0)
        page.locator("#veto").click()
        says(page, "#message", "'eye' is a viewer; this needs the role admin")
        with httpx.Client(base_url=service.url, headers={"Authorization": f"Bearer {token('eye')}"}) as client:
            assert client.get(f"{API}/edits").json() == []


def test_a_token_that_expires_is_asked_for_again_and_nothing_is_lost(page, packets, credentials, tmp_path):
    tokens = tmp_path / "tokens.yaml"
    tokens.write_bytes((credentials / "tokens.yaml").read_bytes())
    eye = (credentials / "tokens" / "eye").read_text().strip()
    robot = {"Authorization": f"Bearer {(credentials / 'tokens' / 'robot_1').read_text().strip()}"}
    with closing(Service(tmp_path / "data", "--tokens", str(tokens))) as service:
        play(service.url, packets, ("robot_1",), **robot)
        page.goto(service.url)
        page.get_by_label("Token").fill(eye)
        page.keyboard.press("Enter")
        says(page, "#robots", "robot_1")
        assert main(["tokens", "revoke", "--tokens", str(tokens), "eye"]) == 0
        service.process.send_signal(signal.SIGHUP)
        page.get_by_role("checkbox", name="robot_1").uncheck()
        page.locator("#state").select_option("rejected")
        says(page, "#status", "needs")
        playwright.expect(page.get_by_label("Token")).to_be_visible(timeout=WAIT_MS)
        says(page, "#robots", "robot_1")
        assert not page.get_by_role("checkbox", name="robot_1").is_checked()


def test_the_page_fits_a_phone(browser, mapped):
    with closing(browser.new_page(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)) as phone:
        phone.goto(mapped.url)
        says(phone, "#robots", "robot_1")
        until(phone, lambda: painted(phone) >= 3, "the map")
        assert phone.evaluate("document.documentElement.scrollWidth") <= 390
        box = phone.locator("#map").bounding_box()
        assert box["width"] == 390
        assert box["height"] > 300


def test_the_keyboard_is_enough(page, mapped):
    page.goto(mapped.url)
    until(page, lambda: page.locator("#list option").count() > 0 and painted(page) >= 3, "the map")

    def focused():
        return page.evaluate("document.activeElement.id")

    def tab_to(name):
        for _ in range(60):
            page.keyboard.press("Tab")
            if focused() == name:
                return
        pytest.fail(f"the keyboard does not reach {name}")

    tab_to("map")
    before = page.locator("#map").screenshot()
    for key in ("ArrowLeft", "+", "+", "ArrowUp"):
        page.keyboard.press(key)
    page.wait_for_timeout(500)
    assert page.locator("#map").screenshot() != before
    page.keyboard.press("0")
    tab_to("list")
    page.keyboard.press("ArrowDown")
    playwright.expect(page.locator("#closure")).to_be_visible(timeout=WAIT_MS)
    tab_to("veto")
    page.keyboard.press("Enter")
    says(page, "#message", "(veto) is stored")


def colour_of(page, robot):
    row = page.locator("#robots li").filter(has_text=f"{robot}:")
    return row.locator(".swatch").evaluate("swatch => swatch.style.background")


def test_an_edit_shows_at_once_and_what_it_removes_is_gone(page, packets, tmp_path):
    tiles = []
    page.on("request", lambda request: tiles.append(request.url) if "/tiles/" in request.url else None)
    with closing(Service(tmp_path / "data")) as service:
        play(service.url, packets, ("robot_2",))
        page.goto(service.url)
        says(page, "#robots", "robot_2")
        colour = colour_of(page, "robot_2")
        play(service.url, packets, ("robot_1",))
        until(page, lambda: options(page, "#maps") == ["0: robot_2, robot_1"], "one map")
        assert colour_of(page, "robot_2") == colour, "a robot keeps its colour, whoever comes before it in the list"
        between = page.locator("#list option").filter(has_text=re.compile("robot_2 . robot_1"))
        page.locator("#list").select_option(between.first.get_attribute("value"))
        says(page, "#facts-of-closure", "robot_2 (blue) and robot_1 (orange)")
        until(page, lambda: painted(page) >= 3, "the map")
        before = len(tiles)
        removal = {"kind": "removal", "content": {"robot": "robot_2"}}
        assert httpx.post(f"{service.url}{API}/edits", json=removal, timeout=60.0).status_code == 201
        says(page, "#robots", "robot_2: removed")
        says(page, "#message", "The selected closure is no longer there")
        assert not page.locator("#closure").is_visible()
        until(page, lambda: len(tiles) > before, "the tiles of the edited map")


def test_a_connection_that_falls_silent_is_noticed(page, mapped):
    page.route("**/api/v1/events", lambda _: None)  # nothing ever comes
    page.goto(mapped.url)
    says(page, "#status", "no connection; trying again")
    page.unroute("**/api/v1/events")
    says(page, "#status", "live")


def test_a_fault_of_the_service_is_said(page, mapped):
    fault = {"error": "the disk is full or broken; free some space"}
    page.route("**/api/v1/edits", lambda route: route.fulfill(status=507, body=json.dumps(fault)))
    page.goto(mapped.url)
    says(page, "#status", "the disk is full or broken; free some space; trying again")
    page.unroute("**/api/v1/edits")
    says(page, "#status", "live")


def test_shortcuts_of_the_browser_are_left_to_it_and_the_pointer_has_coordinates(page, mapped):
    page.goto(mapped.url)
    until(page, lambda: painted(page) >= 3, "the map")
    page.locator("#map").focus()
    taken = """key => !document.getElementById("map").dispatchEvent(
        new KeyboardEvent("keydown", { key, ctrlKey: true, cancelable: true }))"""
    assert [page.evaluate(taken, key) for key in ("0", "-", "+")] == [False] * 3
    page.locator("#map").hover()
    assert re.fullmatch(r"x -?\d+\.\d\d m, y -?\d+\.\d\d m", page.locator("#pointer").inner_text())
    assert re.fullmatch(r"[\d.]+ m", page.locator("#metres").inner_text())


def test_a_robot_with_a_hostile_name_is_text(page, mapped):
    """No robot can have such a name; a page must not rely on that."""
    evil = "<script>window.evil=1</script><img src=x onerror=window.evil=1>"

    robots = [{**robot, "session": evil} for robot in httpx.get(f"{mapped.url}{API}/robots").json()]
    page.route("**/api/v1/robots", lambda route: route.fulfill(body=json.dumps(robots)))
    page.route("**/api/v1/trajectories/**", lambda route: route.fulfill(body="0 0 0 0 0 0 0 1\n"))
    page.goto(mapped.url)
    says(page, "#robots", evil)
    assert page.evaluate("window.evil") is None
    assert page.locator("#robots img, #robots script").count() == 0


def test_the_page_is_small():
    assert sum(path.stat().st_size for path in ASSETS.iterdir()) < WHOLE_PAGE_BYTES


def test_axe_finds_no_serious_fault(browser, mapped):
    if not AXE.exists():
        pytest.skip("no axe-core: make browser-test")
    for scheme in ("light", "dark"):
        context = browser.new_context(bypass_csp=True, color_scheme=scheme)
        with closing(context), closing(context.new_page()) as page:
            page.goto(mapped.url)
            until(page, lambda: page.locator("#list option").count() > 0, "closures")
            page.locator("#list").select_option(index=0)
            page.add_script_tag(path=AXE)
            found = page.evaluate("axe.run()")["violations"]
            assert [v["id"] for v in found if v["impact"] in ("serious", "critical")] == []


def test_a_slow_reader_of_events_keeps_nobody_waiting(page, mapped):
    """200 pages that read nothing, and one that works."""
    with suppress(OSError):
        address = urlsplit(mapped.url)
        idle = [socket.create_connection((address.hostname, address.port)) for _ in range(200)]
        for one in idle:
            one.sendall(b"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    page.goto(mapped.url)
    says(page, "#status", "live")
    says(page, "#robots", "robot_1")
    for one in idle:
        one.close()
