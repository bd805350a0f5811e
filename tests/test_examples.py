"""Every program of examples/ is short and runs as a user would start it."""

import contextlib
import importlib.util
import io
import json
import os
import re
import runpy
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import pytest

import fcslam
from tests.learning.textures import textured

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"


def start(name, *arguments, cwd):
    """Run an example in another folder, and return what it prints."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as said:
        patch.chdir(cwd)
        patch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return said.getvalue()


def started(name, *arguments, cwd):
    """The same in a process of its own."""
    command = [sys.executable, EXAMPLES / name, *map(str, arguments)]
    # evo writes its settings into HOME when it is imported.
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "HOME": str(cwd)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def needs(*modules):
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"needs {', '.join(missing)}")


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The run folder of map_logs.py, and what it printed."""
    folder = tmp_path_factory.mktemp("examples")
    return folder / "two", start("map_logs.py", "two", cwd=folder)


@pytest.mark.parametrize("program", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_has_under_forty_lines_and_a_test(program):
    assert len(program.read_text(encoding="utf-8").splitlines()) < 40
    assert f'("{program.name}", ' in Path(__file__).read_text(encoding="utf-8")


@pytest.mark.slow
def test_two_logs_become_one_map(two):
    folder, said = two
    assert re.findall(r"^(\w+): map (\d)", said, re.MULTILINE) == [("anna", "0"), ("ben", "0")]
    assert len(fcslam.open_run(folder).maps) == 1


@pytest.mark.slow
def test_a_robot_maps_while_it_drives(tmp_path):
    assert start("live_robot.py", "run", cwd=tmp_path).startswith("at (0.00, 0.00) m, 0.00 rad\n")
    run = fcslam.open_run(tmp_path / "run")
    assert run.trajectories["anna"].path_length_m == pytest.approx(25.0, rel=0.05)


@pytest.mark.slow
@needs("pandas")
def test_pandas_reads_a_run(two):
    folder, _ = two
    said = start("run_with_pandas.py", folder, cwd=folder)
    run = fcslam.open_run(folder)
    for robot, trajectory in run.trajectories.items():
        assert float(re.search(rf"^{robot}: ([\d.]+) m", said, re.MULTILINE)[1]) == pytest.approx(
            trajectory.path_length_m, abs=0.1
        )


@pytest.mark.slow
@needs("evo")
def test_evo_draws_a_run_and_compares_it(two):
    folder, _ = two
    said = started("plot_with_evo.py", folder, cwd=folder)
    assert cv2.imread(str(folder / "evo.png")) is not None
    assert float(re.search(r"RMSE ([\d.]+) m", said)[1]) < 0.2


@pytest.mark.slow
def test_a_third_robot_is_found_in_the_map(two):
    folder, _ = two
    found, scans = map(int, re.search(r"at (\d+) of (\d+) scans", start("localize.py", folder, cwd=folder)).groups())
    assert found > scans / 2


@pytest.mark.slow
def test_a_source_of_ones_own_is_mapped(tmp_path):
    height, width = map(int, re.search(r"\((\d+), (\d+)\)", start("own_source.py", "run", cwd=tmp_path)).groups())
    assert width * 0.05 == pytest.approx(8.0, abs=1.0)
    assert height * 0.05 == pytest.approx(6.0, abs=1.0)


def test_a_webhook_hears_once_of_a_silent_robot(tmp_path, monkeypatch):
    robot = {"ended": False, "removed": False}
    robots = [
        {**robot, "robot": "a", "last_heard_s": 90.0},
        {**robot, "robot": "b", "last_heard_s": 90.0, "ended": True},
    ]
    answers, told = {"/api/v1/fleet": {"lacking_s": 0.1}, "/api/v1/robots": robots}, []

    class Service(BaseHTTPRequestHandler):
        def do_GET(self, content=None):
            body = json.dumps(answers[self.path] if content is None else content).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_POST(self):
            told.append(
                (self.headers["Authorization"], json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            )
            self.do_GET("heard")

    monkeypatch.setenv("WEBHOOK_TOKEN", "secret")
    monkeypatch.setattr("time.sleep", lambda _: None)
    with ThreadingHTTPServer(("127.0.0.1", 0), Service) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        start("webhook.py", url, f"{url}/hook", 3, cwd=tmp_path)
        server.shutdown()
    ((token, content),) = told
    assert token == "Bearer secret"
    assert content == {"cause": "a", "text": "a has been silent for 90 s", "service": url}


@pytest.mark.slow
@needs("onnx")
def test_a_network_of_ones_own_is_a_detector(tmp_path):
    assert "300 keypoints" in start("own_detector.py", "own.onnx", cwd=tmp_path)
    assert (tmp_path / "own.onnx").is_file()


@pytest.mark.slow
@needs("torch", "onnx", "flwr")
@pytest.mark.usefixtures("brief_validation")
def test_a_strategy_of_ones_own_aggregates(tmp_path):
    for robot in range(3):
        (tmp_path / f"robot{robot}").mkdir()
        for seed in range(2):
            cv2.imwrite(str(tmp_path / f"robot{robot}" / f"{seed}.png"), textured(10 * robot + seed, 128, 96))
    said = start("own_strategy.py", "out", "robot0", "robot1", "robot2", cwd=tmp_path)
    assert said.count("leaves out the last") == 2
    assert (tmp_path / "out" / "detector.onnx").is_file()
