"""Map the same recordings with two checkouts and compare every byte: proof that a refactoring changed no result.

    FCSLAM_DATA=/path/to/data python tools/compare_checkouts.py BEFORE AFTER --work /tmp/compared

BEFORE and AFTER are folders of two checkouts, for instance git worktrees. Both run with the interpreter that runs this
script. The cases are three logs of the SLAM benchmark as one robot, intel as three robots, the five runs of Wean Hall,
a simulated fleet with cameras (it needs a GL library) and a federated run of two rounds (it needs torch and Flower).

The script compares all files of the run folders, and the packets that the robots sent. It leaves out configuration
files and the comments in a model card, which hold the descriptions of the settings, and the seconds that a round took.
``--ignore-downlink`` leaves the metrics of the downlink out.
Results of BEFORE stay in the working folder and are used again.
"""

import argparse
import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

IGNORED = ("config.yaml", "mission.state", "settings.yaml", "simulation.yaml", "mission.json", "*.log")
"""Configuration with its comments, files that hold times of the clock, and states that hold a hash of the code."""
DOWNLINK = re.compile(r"downlink|acknowledgement|correction|release|detector_update")

RUN = """
import hashlib, sys
import fcslam.mission.mission as mission
from fcslam.wire import packets as wire
coder, path = mission if hasattr(mission, "encode") else wire, sys.argv.pop(1)
uplink, encode = {"Hello", "Keyscan", "Constraint", "Place"}, coder.encode
with open(path, "w", buffering=1) as packets:
    def recorded(packet):
        data = encode(packet)
        if type(packet.body).__name__ in uplink:
            packets.write(f"{hashlib.sha256(data).hexdigest()} {len(data)}\\n")
        return data
    coder.encode = recorded
    from fcslam.cli import main
    code = main(sys.argv[1:])
sys.exit(code)
"""
"""Runs the command line and writes down a digest of every packet that a robot sends, in processes of any number."""


@dataclass(frozen=True)
class Case:
    """One command; ``{output}`` in its arguments is the folder it writes."""

    name: str
    arguments: tuple[str, ...]


SIMULATE = "tools", "simulate", "--robots", "3", "--seed", "101", "--path-length", "40", "--output"


def cases(data: Path, work: Path) -> Iterator[Case]:
    """All cases; the runs of Wean Hall and the fleet with cameras are bags that AFTER made."""
    logs = data / "lidar" / "slam-benchmark"
    for name in ("intel", "fr079", "mit-csail"):
        yield Case(name, ("map", f"{logs / name}.clf.xz", "--output", "{output}"))
    yield Case("intel-3", ("map", str(logs / "intel.clf.xz"), "--split", "3", "--output", "{output}"))
    runs = [str(work / "wean-hall" / f"robotdata{number}.mcap") for number in range(1, 6)]
    yield Case("wean-hall", ("map", *runs, "--output", "{output}"))
    yield Case("simulate", (*SIMULATE, "{output}"))
    fleet = [str(work / "fleet" / f"robot_{number}") for number in range(1, 4)]
    yield Case("cameras", ("map", *fleet, "--output", "{output}"))
    robots = [str(data / "vision" / name) for name in ("kodak24", "sun_hays80")]
    start = Path(__file__).parents[1] / "src" / "fcslam" / "features" / "networks" / "detector.onnx"
    given = ("--public", str(data / "vision" / "urban100"), "--start", str(start))
    settings = "rounds=2", "local_steps=6", "training={pairs: 2, side_px: 96, label_copies: 2}"
    brief = (word for setting in settings for word in ("--config", setting))
    yield Case("federated", ("tools", "federate", *robots, *given, *brief, "--output", "{output}"))


def make_bags(data: Path, checkout: Path, work: Path) -> None:
    """Write the bags that both checkouts map into ``work``, unless they are there."""
    logs = sorted((data / "lidar" / "wean-hall").glob("*.log.gz"))
    script = "import sys; from fcslam.cli import main; sys.exit(main(sys.argv[1:]))"
    for folder, command in (
        ("wean-hall", [checkout / "benchmarks" / "convert_logs.py", *logs, "--output"]),
        ("fleet", ["-c", script, *SIMULATE]),
    ):
        if not (work / folder).exists():
            environment = {**os.environ, "PYTHONPATH": str(checkout / "src")}
            subprocess.run([sys.executable, *command, work / folder], env=environment, check=True)


def run(case: Case, checkout: Path, place: Path) -> None:
    """Run a case in a checkout unless its result is there already."""
    output = place / case.name
    if (place / f"{case.name}.done").exists():
        return
    shutil.rmtree(output, ignore_errors=True)
    place.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(checkout / "src"), "OMP_NUM_THREADS": "1"}
    arguments = [argument.format(output=output) for argument in case.arguments]
    if "federate" in arguments and "def local(" in (checkout / "src/fcslam/cli/federate.py").read_text("utf-8"):
        arguments.insert(2, "local")  # the command of checkouts in which servers and robots had commands, too
    began = time.perf_counter()
    command = [sys.executable, "-c", RUN, str(place / f"{case.name}.packets"), *arguments]
    process = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=place, check=False)
    if process.returncode:
        sys.exit(f"{checkout}: {' '.join(arguments)} failed:\n{process.stdout}{process.stderr}")
    (place / f"{case.name}.done").write_text(f"{time.perf_counter() - began:.1f} s\n", encoding="utf-8")


def contents(place: Path, case: Case, ignore_downlink: bool) -> dict[str, str]:
    """Digest of every file of a result, by its path in it."""
    output = place / case.name
    files = [place / f"{case.name}.packets"] if case.arguments[0] == "map" else []
    files += [path for path in output.rglob("*") if path.is_file() and not any(map(path.match, IGNORED))]
    found = {}
    for path in sorted(files):
        content = path.read_bytes()
        if path.suffix == ".packets":
            content = b"".join(sorted(content.splitlines()))
        if path.name == "metrics.json" and ignore_downlink:
            rows = [row for row in json.loads(content) if not DOWNLINK.search(row["name"])]
            content = json.dumps(rows).encode()
        if path.name == "card.md":
            content = b"\n".join(line for line in content.splitlines() if not re.match(rb" +#", line))
        if path.name == "rounds.csv":
            rows = list(csv.DictReader(content.decode().splitlines()))
            content = json.dumps([{name: row[name] for name in row if name != "seconds"} for row in rows]).encode()
        found[str(path.relative_to(place))] = hashlib.sha256(content).hexdigest()
    return found


def main() -> None:
    """Compare the cases that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="folder of the results")
    parser.add_argument("--cases", nargs="+", help="only these")
    parser.add_argument("--ignore-downlink", action="store_true", help="leave metrics of the downlink out")
    chosen = parser.parse_args()
    if "FCSLAM_DATA" not in os.environ:
        sys.exit("set FCSLAM_DATA to the folder of the recordings")
    work = chosen.work.resolve()
    shutil.rmtree(work / "after", ignore_errors=True)
    data, different = Path(os.environ["FCSLAM_DATA"]), 0
    make_bags(data, chosen.after.resolve(), work)
    for case in cases(data, work):
        if chosen.cases and case.name not in chosen.cases:
            continue
        run(case, chosen.before.resolve(), work / "before")
        run(case, chosen.after.resolve(), work / "after")
        before, after = (contents(work / side, case, chosen.ignore_downlink) for side in ("before", "after"))
        names = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
        different += len(names)
        print(f"{case.name}: {len(before)} files, {len(names) or 'none'} different", *names, sep="\n    ", flush=True)
    sys.exit(1 if different else 0)


if __name__ == "__main__":
    main()
