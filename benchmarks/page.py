"""The page in a browser: how soon it shows a map, how soon an update, how smoothly it moves, and what a huge map costs.

    python benchmarks/page.py [--pages 10] [--seconds 5]

Chromium runs without a window and draws in software, on the machine of the service. It is driven by Playwright
(`make browser-test`); without them the script skips.

- First map: from opening the address until a tile of the map is drawn. The service has the sample logs, three robots.
- Update: from the event that tells of a new live map until the page has its robots and closures. Robots drive
  meanwhile, at four times real time.
- Frames: 20 robots of 600 poses and 5,000 closures between them on a map, from a server that makes them up. Ten times
  a second it tells that the robots have moved, and the map is dragged all the time.
- Square kilometre: 20,000 x 20,000 cells of 5 cm. Requests for tiles of the whole view; the longest frame while the map
  is zoomed and dragged; memory of the page's script, of its process, and of the process that answers.
"""

import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import cycle
from pathlib import Path
from typing import Any

import common
import cv2
import httpx
import numpy as np
import processes

from fcslam.maps import palette
from fcslam.page.routes import ASSETS, FILES

LOGS = Path(__file__).parents[1] / "examples" / "logs"
ROBOTS, POSES, CLOSURES = 20, 600, 5000
CELLS = 20_000
EXTENT = [-100.0, -100.0, 100.0, 100.0]
"""Of the map below 20 robots."""
SIZE = {"width": 1200, "height": 900}
PAINTED = """() => {
    const canvas = document.getElementById("map"), pen = canvas.getContext("2d");
    const pixels = pen.getImageData(0, 0, canvas.width, canvas.height).data;
    for (let k = 0; k < pixels.length; k += 4)
        if (pixels[k] === 31 && pixels[k + 1] === 42 && pixels[k + 2] === 51) return true;
    return false;
}"""
"""Whether a wall is drawn, in the colour of a light page (``palette.WALL``)."""
FRAMES = """(seconds) => new Promise((done) => {
    const times = [], began = performance.now();
    const next = (now) => {
        times.push(now);
        if (now - began < 1000 * seconds) requestAnimationFrame(next); else done(times);
    };
    requestAnimationFrame(next);
})"""


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--pages", type=int, default=10, help="pages that are opened, one after another")
    parser.add_argument("--seconds", type=float, default=5.0, help="for which frames are counted")
    chosen = parser.parse_args()
    if shutil.which("chromium") is None:
        sys.exit(print("skipped: needs Chromium; make browser-test"))
    from playwright.sync_api import sync_playwright

    report = common.Report(__file__, __doc__, chosen)
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as place:
        flags = ["--no-sandbox", "--disable-gpu", "--enable-precise-memory-info"]
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        with processes.cloud(Path(place)) as (_, port):
            updates = updated(browser, port, Path(place))
            shown = [first_map_s(browser, f"http://127.0.0.1:{port}/") for _ in range(chosen.pages)]
        rows = [
            ("first map, median", float(np.median(shown)), "s"),
            ("first map, longest", max(shown), "s"),
            ("update, median", float(np.median(updates)), "s"),
            ("update, 95 %", float(np.percentile(updates, 95)), "s"),
            *frames(browser, chosen.seconds),
            *square_kilometre(browser, Path(place), chosen.seconds),
        ]
        browser.close()
    report.table("The page", {"": "", "value": ".3g", "unit": ""}, rows)
    report.write()


def first_map_s(browser: Any, address: str) -> float:
    page, began_s = browser.new_page(viewport=SIZE), time.perf_counter()
    page.goto(address)
    page.wait_for_function(PAINTED, polling=10)
    page.close()
    return time.perf_counter() - began_s


def updated(browser: Any, port: int, place: Path) -> list[float]:
    """Seconds from each event to the last answer that the page then needed."""
    told: list[float] = []
    finished: list[float] = []

    def listen() -> None:
        with (
            suppress(httpx.HTTPError),
            httpx.stream("GET", f"http://127.0.0.1:{port}/api/v1/events", timeout=None) as stream,
        ):
            for line in stream.iter_lines():
                if line == "event: live":
                    told.append(time.perf_counter())

    threading.Thread(target=listen, daemon=True).start()
    page = browser.new_page(viewport=SIZE)
    page.on(
        "requestfinished",
        lambda request: finished.append(time.perf_counter()) if request.url.endswith("/edits") else None,
    )
    page.goto(f"http://127.0.0.1:{port}/")
    robots = [processes.robot(log, port, place, "4") for log in sorted(LOGS.glob("*.clf.xz"))]
    running = [robot.__enter__() for robot in robots]
    while not all(robot.ended() for robot in running):
        page.wait_for_timeout(100)
    page.wait_for_timeout(3000)
    for robot in robots:
        robot.__exit__(None, None, None)
    page.close()
    return [
        min(done for done in finished if done > moment) - moment for moment in told if any(d > moment for d in finished)
    ]


def frames(browser: Any, seconds: float) -> list[tuple[str, float, str]]:
    rng = np.random.default_rng(0)
    names = [f"robot{k}" for k in range(ROBOTS)]
    ways = np.cumsum(rng.normal(0.0, 0.3, (ROBOTS, POSES, 2)), axis=1)
    tum = {
        name: "".join(f"{0.1 * k:.1f} {x:.3f} {y:.3f} 0 0 0 0 1\n" for k, (x, y) in enumerate(way))
        for name, way in zip(names, ways, strict=True)
    }
    ends = rng.integers(0, (ROBOTS, POSES, ROBOTS, POSES), (CLOSURES, 4)).tolist()
    closures = [
        {"robot_i": names[a], "stamp_i": 0.1 * i, "robot_j": names[b], "stamp_j": 0.1 * j, "channel": "lidar",
         "similarity": 0.3, "T_i_j": [0.0, 0.0, 0.0], "status": "accepted", "reason": "fits_joint_map", "value": None,
         "limit": None, "setting": "", "explanation": ""}
        for a, i, b, j in ends
    ]  # fmt: skip
    fleet = {
        "mission": "many", "version": "1", "read_only": False, "packets": 0, "applied": 0, "waiting": 0,
        "robots": names, "maps": 1, "metrics": {}, "worker_ready": True, "may_edit": False, "map_age_s": 0.0,
        "lacking_packets": 0, "lacking_sessions": 0, "lacking_s": 0.0, "free_bytes": None,
    }  # fmt: skip
    fixed = {
        "fleet": fleet, "maps": [{"map": 0, "floor": "", "robots": names, "zoom": 3, "extent": EXTENT}],
        "separations": [], "edits": [], "closures": closures,
    }  # fmt: skip

    floor = bytes(cv2.imencode(".png", np.kron(rng.choice([0, 205, 254], (64, 64)), np.ones((8, 8))))[1])

    def robots() -> list[dict[str, Any]]:
        row = int(10.0 * time.monotonic()) % POSES
        return [
            {"robot": name, "session": name, "epoch": 0, "packets": 1, "map": 0, "floor": "", "path_length_m": 1.0,
             "keyscans": POSES, "T_map_base": [*way[row], 0.1 * row], "T_map_odom": None, "correction": 0,
             "quality": 0.5, "detectors": {}, "removed": False, "last_heard_s": 0.1, "color": f"#{color:06x}",
             "first_s": 0.0, "last_s": 0.1 * POSES}
            for name, way, color in zip(names, ways.tolist(), cycle(palette.ROBOTS), strict=False)
        ]  # fmt: skip

    class Fleet(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if path in FILES:
                name, kind = FILES[path]
                self.answer((ASSETS / name).read_bytes(), kind)
            elif path == "/api/v1/events":
                self.answer(b"", "text/event-stream")
                with suppress(OSError):
                    for number in range(10_000):
                        self.wfile.write(b'event: live\ndata: {"number": %d}\n\n' % number)
                        time.sleep(0.1)
            elif path.startswith("/api/v1/trajectories/"):
                poses = tum[path.split("/")[-1].split(".")[0]].encode()
                known = len(poses) if "digest=" in self.path else 0
                headers = {"Fcslam-After": str(known), "Fcslam-Digest": hashlib.sha256(poses).hexdigest()}
                self.answer(poses[known:], "text/plain", headers)
            elif "/tiles/" in path:
                self.answer(floor, "image/png")
            elif path == "/api/v1/robots":
                self.answer(json.dumps(robots()).encode(), "application/json")
            elif (name := path.removeprefix("/api/v1/")) in fixed:
                self.answer(json.dumps(fixed[name]).encode(), "application/json")
            else:
                self.send_error(404)

        def answer(self, body: bytes, kind: str, headers: Mapping[str, str] | None = None) -> None:
            """As the service does: what a browser has is not sent again."""
            tag = f'"{hashlib.sha256(body).hexdigest()}"'
            is_known = self.headers.get("If-None-Match") == tag
            body = b"" if is_known else body
            self.send_response(304 if is_known else 200)
            for name, value in {"ETag": tag, "Cache-Control": "no-cache", **(headers or {})}.items():
                self.send_header(name, value)
            self.send_header("Content-Type", kind)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Fleet) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page(viewport=SIZE)
        page.goto(f"http://127.0.0.1:{server.server_port}/")
        page.wait_for_function(f"document.querySelectorAll('#robots li').length === {ROBOTS}")
        page.evaluate("document.getElementById('layer-closures').click()")
        found = dragged(page, seconds)
        page.close()
        server.shutdown()
    gaps = np.diff(found)
    return [
        ("frames, 20 robots and 5,000 closures", 1e3 / float(np.mean(gaps)), "1/s"),
        ("longest frame", float(gaps.max()), "ms"),
    ]


def dragged(page: Any, seconds: float) -> list[float]:
    """Moments of the frames while the map is dragged, ms."""
    page.evaluate(
        """() => {
            const map = document.getElementById("map");
            const press = (key) => map.dispatchEvent(new KeyboardEvent("keydown", { key }));
            let k = 0;
            setInterval(() => press(k++ % 40 < 20 ? "ArrowLeft" : "ArrowRight"), 16);
            setInterval(() => press(k % 80 < 40 ? "+" : "-"), 500);
        }"""
    )
    found: list[float] = page.evaluate(FRAMES, seconds)
    return found


@contextmanager
def shown(run: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    command = [sys.executable, "-m", "fcslam.cli", "show", str(run), "--no-open"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        yield process, next(word for word in line.split() if word.startswith("http")).rstrip(";,")
        process.terminate()


def square_kilometre(browser: Any, place: Path, seconds: float) -> list[tuple[str, float, str]]:
    from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, map_yaml, pgm_bytes
    from fcslam.runs import RobotTrajectory, Run

    rng = np.random.default_rng(0)
    blocks = rng.choice(
        [Occupancy.FREE, Occupancy.FREE, Occupancy.UNKNOWN, Occupancy.OCCUPIED], (CELLS // 100, CELLS // 100)
    )
    cells = np.kron(blocks.astype(np.uint8), np.ones((100, 100), np.uint8))
    occupancy = OccupancyMap(cells, 0.05, (0.0, 0.0))
    corners = np.array([[0.0, 0.0, 0.0], [1000.0, 1000.0, 0.0]])
    files = {"map.pgm": pgm_bytes(occupancy), "map.yaml": map_yaml(occupancy, "map.pgm").encode()}
    Run({"a": RobotTrajectory("a", 0, np.arange(2.0), corners)}, map_files=files).save(place / "square")
    with shown(place / "square") as (process, address):
        page, tiles = browser.new_page(viewport=SIZE), []
        page.on("request", lambda request: tiles.append(request.url) if "/tiles/" in request.url else None)
        began_s = time.perf_counter()
        page.goto(address)
        page.wait_for_function(PAINTED, polling=10, timeout=120_000)
        first_s = time.perf_counter() - began_s
        page.wait_for_timeout(3000)
        whole = len(tiles)
        gaps = np.diff(dragged(page, seconds))
        page.context.new_cdp_session(page).send("HeapProfiler.collectGarbage")  # of this script's own looking
        heap_mb = page.evaluate("performance.memory.usedJSHeapSize") / 1e6
        renderer_mb = max(peak_mb(pid) for pid in renderers())
        service_mb = peak_mb(process.pid)
        page.close()
    return [
        ("square kilometre, first tile", first_s, "s"),
        ("square kilometre, tiles of the whole view", whole, "1"),
        ("square kilometre, longest frame", float(gaps.max()), "ms"),
        ("square kilometre, memory of the script", heap_mb, "MB"),
        ("square kilometre, memory of the page, pictures and browser code included", renderer_mb, "MB"),
        ("square kilometre, memory of the service", service_mb, "MB"),
    ]


def peak_mb(pid: int) -> float:
    """The largest resident set of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1e3


def renderers() -> Iterator[int]:
    """Chromium's processes that hold pages."""
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if b"--type=renderer" in (folder / "cmdline").read_bytes():
                yield int(folder.name)


if __name__ == "__main__":
    main()
