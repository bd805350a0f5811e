"""What the cloud does for a fleet: places and maps compared, solves, and its CPU beside that of another checkout.

    FCSLAM_DATA=/path/to/data python benchmarks/fleet_work.py --against /path/to/checkout

Each checkout maps each fleet once: mit-csail, cut into six robots, and simulated robots in one building. Then the
clouds of both apply the packets of their missions, in turn, each in a process of its own that has applied them once
before. CPU is user and system; of several repetitions the least. "In place of": that of the other checkout.

- places compared: pairs of places whose descriptors were matched. Verified: pairs of submaps that were aligned.
- maps compared: pairs of maps at the transform of a cluster. Exhaustive: those that were aligned everywhere else, too.
- local maps: built to compare maps around one place.
- quick solves, and re-evaluations, which decide every closure.
- longest: CPU of the packet that took longest; the packets behind it wait.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import common

WORK = """
import json, sys, time
from collections import Counter
from pathlib import Path
import fcslam.cloud.decisions as decisions
import fcslam.cloud.map_comparison as comparison
import fcslam.lidar.pair_verification as verification
import fcslam.lidar.uniqueness as uniqueness
import fcslam.places.matcher as matcher
from fcslam.cloud.cloud import Cloud
from fcslam.cloud.joint_graph import JointGraph
from fcslam.mission.mission_file import read_mission
try:
    import fcslam.places.local_maps as local_maps
except ImportError:
    local_maps = comparison
counts = Counter()
def count(owner, name, label):
    function = getattr(owner, name)
    def counted(*arguments, **options):
        counts[label] += 1
        return function(*arguments, **options)
    setattr(owner, name, counted)
count(matcher, "propose_motions", "places compared")
count(verification, "align", "verified")
count(comparison.MapComparison, "_compare", "maps compared")
count(uniqueness, "_coarse_peaks", "exhaustive")
count(local_maps, "local_map", "local maps")
count(JointGraph, "optimize", "quick solves")
count(decisions, "reevaluate", "re-evaluations")
mission = read_mission(Path(sys.argv[1]))
try:
    packets = [sent.packet for sent in mission.in_order]
except AttributeError:
    packets = sorted((sent.packet for its in mission.packets.values() for sent in its), key=lambda each: each.order)
for _ in range(2):
    cloud, longest_s = Cloud(mission.config.fleet, mission.config.seed), 0.0
    counts.clear()
    began = time.process_time()
    for packet in packets:
        before = time.process_time()
        cloud.apply(packet)
        longest_s = max(longest_s, time.process_time() - before)
    counts["CPU, s"] = time.process_time() - began
    counts["longest, s"] = longest_s
began = time.process_time()
result = cloud.finalize()
counts["end: CPU, s"] = time.process_time() - began
counts["maps"] = len({robot.map_index for robot in result.robots})
between = [c for c in result.closures if c.i.robot != c.j.robot]
counts["accepted between robots"] = sum(c.status.value == "accepted" for c in between)
print(json.dumps(counts))
"""
"""Applies the packets of a mission twice and prints the second time's work."""
LOG, PARTS = "mit-csail", 6
PATH_M = 60.0
"""Of each simulated robot."""
COUNTS = ("maps", "accepted between robots", "places compared", "verified", "maps compared", "exhaustive", "local maps",
          "quick solves", "re-evaluations")  # fmt: skip
TIMES = "CPU, s", "end: CPU, s", "longest, s"


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--against", type=Path, help="the other checkout; without one there is nothing to compare")
    parser.add_argument("--repetitions", type=int, default=2)
    parser.add_argument("--robots", nargs="*", type=int, default=(2, 10), help="sizes of the simulated fleets")
    chosen = parser.parse_args()
    log = common.log_path(common.recordings(f"slam-benchmark/{LOG}.clf.xz"), LOG)
    report = common.Report(__file__, __doc__, chosen)
    checkouts = [common.REPOSITORY, *([chosen.against.resolve()] if chosen.against else [])]
    with tempfile.TemporaryDirectory() as place:
        fleets: dict[str, tuple[object, ...]] = {f"{LOG}, {PARTS} robots": (log, "--split", PARTS)}
        for robots in chosen.robots:
            name = f"{robots} simulated robots"
            options = ("--robots", robots, "--path-length", PATH_M, "--seed", 1, "--no-camera")
            folder = common.simulated(Path(place) / name, *options)
            fleets[name] = tuple(folder / f"robot_{number}" for number in range(1, robots + 1))
        for name, recordings in fleets.items():
            missions = [mapped(checkout, Path(place) / f"run{k}", recordings) for k, checkout in enumerate(checkouts)]
            turns = [list(map(work, checkouts, missions)) for _ in range(chosen.repetitions)]
            ours, *others = (list(each) for each in zip(*turns, strict=True))
            theirs = others[0] if others else [dict[str, float]()]
            rows = [(what, ours[0].get(what, 0), theirs[0].get(what, math.nan)) for what in COUNTS]
            report.table(name, {"": "", "count": ",.0f", "in place of": ",.0f"}, rows)
            times = [[min(each.get(what, math.nan) for each in side) for side in (ours, theirs)] for what in TIMES]
            columns = {"": "", "s": ".2f", "in place of, s": ".2f", "ratio": ".2f"}
            cpu = [(what, a, b, a / b) for what, (a, b) in zip(TIMES, times, strict=True)]
            report.table(f"{name}: CPU", columns, cpu)
    report.write()


def mapped(checkout: Path, run: Path, arguments: tuple[object, ...]) -> Path:
    environment = {"PYTHONPATH": str(checkout / "src")}
    common.run_fcslam("map", *arguments, "--output", run, "--force", environment=environment)
    return run


def work(checkout: Path, mission: Path) -> dict[str, float]:
    """What the cloud of a checkout does for the packets of a mission."""
    environment = {**os.environ, "PYTHONPATH": str(checkout / "src"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", WORK, str(mission)]
    output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True).stdout
    found: dict[str, float] = json.loads(output)
    return found


if __name__ == "__main__":
    main()
