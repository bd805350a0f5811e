"""Cost of the real command beside that of another checkout: CPU, wall time on all cores, first run.

    FCSLAM_DATA=/path/to/data python benchmarks/speed.py --against /path/to/checkout

The two checkouts take turns, so that both see the same machine. A figure is the least of its repetitions, a ratio is
ours to theirs. Both run with the interpreter that runs this script. CPU seconds are user and system, imports included,
on one core, with compiled code in the cache; two busy cores slow each other down. "Until the first scan": from the
start of the process, with an empty cache, as after an installation without `fcslam tools warm-up`. With one repetition
it takes four minutes.

"Work of one robot" counts calls: scans that were matched, searches of the tracker, keyscans inserted into fields of the
tracker and of submaps, submaps, pairs of submaps that were aligned, searches of loops, and packets encoded and decoded.

"Where the time goes" samples the stack every few milliseconds of CPU, on one core. A sample counts for the folder of
the package whose code is innermost, with the libraries that it calls. Compiled functions count for their callers.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import common

FIRST_SCAN = """
import sys, time
began, path = float(sys.argv.pop(1)), sys.argv.pop(1)
from fcslam.robot.frontend import RobotFrontend
process = RobotFrontend.process
def timed(robot, record):
    packets = process(robot, record)
    if robot.scan_poses:
        RobotFrontend.process = process
        with open(path, "w") as file:
            file.write(str(time.time() - began))
    return packets
RobotFrontend.process = timed
from fcslam.cli import main
sys.exit(main(sys.argv[1:]))
"""
"""Runs the command line and writes down when the first scan was mapped."""
SAMPLED = """
import collections, json, signal, sys, time
path, spent, before = sys.argv.pop(1), collections.Counter(), 0.0
def part_of(frame):
    part = None
    while frame:
        name = frame.f_code.co_filename
        if name.startswith("<frozen importlib"):
            return "imports"
        if name.endswith("numba/core/dispatcher.py"):
            return "loading of compiled code"
        if part is None and "/fcslam/" in name:
            part = name.split("/fcslam/")[1].split("/")[0].removesuffix(".py")
        frame = frame.f_back
    return part or "start and end"
def sample(_, frame):
    global before
    now = time.process_time()
    spent[part_of(frame)] += now - before
    before = now
signal.signal(signal.SIGPROF, sample)
signal.setitimer(signal.ITIMER_PROF, 0.003, 0.003)
from fcslam.cli import main as run
try:
    run(sys.argv[1:])
finally:
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    with open(path, "w") as file:
        json.dump(spent, file)
"""
"""Runs the command line and writes down the seconds of each part of the package."""
COUNTED = """
import collections, importlib, json, sys
path, counts = sys.argv.pop(1), collections.Counter()
def count(name, label):
    module, *owners, function = name.split(":")
    owner = importlib.import_module("fcslam." + module)
    for each in owners:
        owner = getattr(owner, each)
    called = getattr(owner, function)
    def counted(*arguments, **options):
        counts[label] += 1
        return called(*arguments, **options)
    setattr(owner, function, counted)
for name, label in json.loads(sys.argv.pop(1)):
    count(name, label)
from fcslam.cli import main as run
try:
    run(sys.argv[1:])
finally:
    with open(path, "w") as file:
        json.dump(counts, file)
"""
"""Runs the command line and writes down how often functions were called."""
CALLS = (
    ("lidar.tracker:match_scan", "scans matched"),
    ("lidar.tracker:search", "searches of the tracker"),
    ("lidar.field:SurfelField:insert", "keyscans inserted"),
    ("lidar.backend:build_submap", "submaps"),
    ("lidar.closing:search", "searches of loops"),
    ("lidar.closing:verify", "submaps aligned"),
    ("robot.backend:OwnPlaces:motions", "places recognised"),
    ("wire.packets:encode", "packets encoded"),
    ("wire.packets:decode", "packets decoded"),
)
PATIENCE_S = 600.0


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--against", type=Path, help="the other checkout; without one there are no ratios")
    parser.add_argument("--repetitions", type=int, default=3)
    chosen = parser.parse_args()
    folder = common.recordings(*common.slam_benchmark_files())
    report = common.Report(__file__, __doc__, chosen)
    checkouts = [common.REPOSITORY, *([chosen.against.resolve()] if chosen.against else [])]
    logs = {name: common.log_path(folder, name) for name in common.SPLITS}
    with tempfile.TemporaryDirectory() as place:

        def repeated(measured: Callable[[Path, Path], float]) -> tuple[float, ...]:
            """Ours, theirs and their ratio."""
            turns = [[measured(checkout, Path(place)) for checkout in checkouts] for _ in range(chosen.repetitions)]
            ours, theirs = (*map(min, zip(*turns, strict=True)), math.nan)[:2]
            return ours, theirs, ours / theirs

        first = repeated(lambda checkout, work: until_first_scan(checkout, logs["intel"], work))
        for checkout in checkouts:  # fill the caches
            for name, parts in common.SPLITS.items():
                run(checkout, Path(place), logs[name], "--split", parts)
        cpu = [
            (name, *repeated(lambda checkout, work, log=log: on_one_core(run, checkout, work, log).cpu_s))
            for name, log in logs.items()
        ]
        wall = [
            (name, *repeated(lambda checkout, work, parts=parts: run(checkout, work, logs["intel"], *parts).wall_s))
            for name, parts in (("one robot", ()), ("three robots", ("--split", 3)))
        ]
        parts = on_one_core(where_time_goes, logs["intel"], Path(place))
        work = {
            name: [on_one_core(calls, checkout, log, Path(place)) for checkout in checkouts]
            for name, log in logs.items()
        }
    columns = {"": "", "ours, s": ".2f", "theirs, s": ".2f", "ratio": ".2f"}
    report.table("CPU of one core, one robot", columns, cpu)
    report.table(f"Wall time of intel, {os.cpu_count()} cores", columns, wall)
    report.table("Until the first scan is mapped, nothing compiled", columns, [("intel", *first)])
    for name, counted in work.items():
        ours, theirs = (*counted, {})[:2]
        rows = [(what, ours.get(what, 0), theirs.get(what, 0) if theirs else math.nan) for _, what in CALLS]
        report.table(f"Work of one robot, {name}", {"": "", "ours": ",.0f", "theirs": ",.0f"}, rows)
    shares = [(part, spent / sum(parts.values())) for part, spent in sorted(parts.items(), key=lambda item: -item[1])]
    report.table("Where the time goes, intel", {"part": "", "share": ".1%"}, shares)
    report.write()


def run(checkout: Path, work: Path, log: Path, *options: object) -> common.Cost:
    """`fcslam map` of a checkout."""
    environment = {"PYTHONPATH": str(checkout / "src")}
    return common.run_fcslam("map", log, *options, "--output", work / "run", "--force", environment=environment)


def where_time_goes(log: Path, work: Path) -> dict[str, float]:
    """Seconds of `fcslam map` by part of the package."""
    noted = work / "parts.json"
    command = [sys.executable, "-c", SAMPLED, noted, "map", log, "--output", work / "run", "--force"]
    environment = {**os.environ, "PYTHONPATH": str(common.REPOSITORY / "src")}
    silent = subprocess.DEVNULL
    subprocess.run(list(map(str, command)), env=environment, stdout=silent, stderr=silent, check=True)
    parts: dict[str, float] = json.loads(noted.read_text(encoding="ascii"))
    return parts


def calls(checkout: Path, log: Path, work: Path) -> dict[str, int]:
    """How often `fcslam map` of a checkout calls functions, by what they do."""
    noted = work / "calls.json"
    command = [sys.executable, "-c", COUNTED, noted, json.dumps(CALLS)]
    command += ["map", log, "--output", work / "run", "--force"]
    environment = {**os.environ, "PYTHONPATH": str(checkout / "src")}
    silent = subprocess.DEVNULL
    subprocess.run(list(map(str, command)), env=environment, stdout=silent, stderr=silent, check=True)
    counted: dict[str, int] = json.loads(noted.read_text(encoding="ascii"))
    return counted


def on_one_core(measured: Callable[..., Any], *arguments: object) -> Any:
    """What a command gives that has one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        return measured(*arguments)
    finally:
        os.sched_setaffinity(0, cores)


def until_first_scan(checkout: Path, log: Path, work: Path) -> float:
    """Seconds from the start of the process until the first scan is mapped, with an empty cache."""
    noted = work / "seconds"
    noted.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:  # a child may still compile into it
        environment = {**os.environ, "PYTHONPATH": str(checkout / "src"), "NUMBA_CACHE_DIR": cache}
        arguments = ["map", log, "--output", work / "first", "--force"]
        command = [sys.executable, "-c", FIRST_SCAN, time.time(), noted, *arguments]
        process = subprocess.Popen(
            list(map(str, command)), env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        until = time.monotonic() + PATIENCE_S
        while not (noted.exists() and noted.read_text(encoding="ascii")):
            if process.poll() is not None or time.monotonic() > until:
                sys.exit(f"{checkout}: no scan was mapped")
            time.sleep(0.02)
        process.terminate()
        process.wait()
    return float(noted.read_text(encoding="ascii"))


if __name__ == "__main__":
    main()
