"""Simulated fleets with LiDARs and cameras against the truth, by the real commands.

    python benchmarks/simulated_fleet.py

Per building and seed one recorded fleet of three robots that start anywhere and drive 60 m each; the seeds were not
used while settings were chosen. Buildings: the default one; the corridor, whose twenty doors are alike; and the default
one where every robot drives in another light (day, evening, some lamps off) and half of the furniture has moved. Fleets
are mapped with both channels of places, those of the latter two also with LiDAR places alone and with camera places
alone. It needs a GL library.

Passed: all robots in one map (corridor: no false join), no accepted closure between robots that is off by 0.5 m or
10 deg, worst ATE of a robot in the joint map at most 0.10 m, F1 of occupied cells at least 0.90.

Recall is that of revisits between robots, by correct verified closures; at 100 % precision: by the closures that are
more similar than every wrong one of their channel.
"""

import json
import math
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import common

ROBOTS = 3
SEEDS = tuple(range(101, 111))
DIM = ("--lighting", "day", "--lighting", "evening", "--lighting", "lamp-off", "--config", "moved_furniture=0.5")
CHANNELS = {"both": ("lidar", "camera"), "lidar": ("lidar",), "camera": ("camera",)}
CASES = {
    "default": ((), ("both",)),
    "corridor": (("--building", "corridor"), tuple(CHANNELS)),
    "default, other light": (DIM, tuple(CHANNELS)),
}
"""What is simulated, and by which places it is mapped."""
WORST_ATE_M, LEAST_F1 = 0.10, 0.90

COLUMNS = {"building": "", "seed": "", "places": "", "maps": ".0f", "false joins": ".0f", "worst ATE, m": ".4f",
           "across robots, m": ".4f", "F1": ".3f", "IoU free": ".3f", "verified": ".0f", "wrong": ".0f",
           "accepted": ".0f", "wrong ": ".0f", "recall": ".3f", "at 100 %": ".3f", "like heading": ".3f",
           "kB/s a robot": ".2f", "kB a place": ".1f", "map, s": ".1f", "passed": ""}  # fmt: skip
SUMMARY = {"building": "", "places": "", "one map": "", "false joins": ".0f", "worst ATE, m": ".4f", "least F1": ".3f",
           "verified": ".0f", "wrong": ".0f", "accepted": ".0f", "wrong ": ".0f", "recall": ".3f", "at 100 %": ".3f",
           "like heading": ".3f", "passed": ""}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="kinds of fleet")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, help="of the fleets")
    parser.add_argument("--jobs", type=int, default=1, help="fleets at the same time; more spoil the times")
    parser.add_argument("--keep", type=Path, help="file that keeps finished fleets; the same one resumes")
    parser.add_argument("--fleets", type=Path, help="folder that keeps the recordings [they go]")
    chosen = parser.parse_args()
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__, chosen)
    fleets = [(case, seed) for case in chosen.cases for seed in chosen.seeds]
    with ThreadPoolExecutor(chosen.jobs) as pool, tempfile.TemporaryDirectory() as place:
        folder = chosen.fleets or Path(place)
        done = pool.map(lambda fleet: kept.rows(fleet, lambda: fleet_rows(*fleet, folder)), fleets)
        rows = [row for some in done for row in some]
    report.table("Summary", SUMMARY, summary(rows, chosen.cases))
    report.table("Fleets", COLUMNS, rows)
    report.write()
    if any(row[-1] == "NO" for row in rows if row[2] == "both"):
        sys.exit("a fleet did not pass")


def recorded(case: str, seed: int, folder: Path) -> Path:
    """The recordings of one fleet; what is there already is not made again."""
    fleet, (simulated, _) = folder / f"{case.replace(',', '').replace(' ', '-')}-{seed}", CASES[case]
    return common.simulated(fleet, "--robots", ROBOTS, "--seed", seed, *simulated)


def fleet_rows(case: str, seed: int, folder: Path) -> Iterable[tuple]:
    """One recorded fleet, mapped with each choice of channels."""
    fleet, (_, places) = recorded(case, seed, folder), CASES[case]
    with tempfile.TemporaryDirectory() as place:
        for name in places:
            settings, run, result = Path(place) / f"{name}.yaml", Path(place) / name, Path(place) / f"{name}.json"
            settings.write_text(f"robot: {{channels: [{', '.join(CHANNELS[name])}]}}\n", encoding="utf-8")
            robots = [fleet / f"robot_{k + 1}" for k in range(ROBOTS)]
            cost = common.run_fcslam("map", *robots, "--config", settings, "--output", run)
            common.run_fcslam("evaluate", "fleet", run, "--truth", fleet, "--csv", result)
            yield row(case, seed, name, read(result), cost)


def read(result: Path) -> dict[str, float]:
    """What `fcslam evaluate fleet` wrote, by name."""
    rows = json.loads(result.read_text(encoding="utf-8"))
    return {row["name"]: math.nan if row["value"] is None else row["value"] for row in rows}


def row(case: str, seed: int, places: str, found: dict[str, float], cost: common.Cost) -> tuple:
    names = [f"robot_{k + 1}" for k in range(ROBOTS)]
    ate = max(found[f"ate_rmse_{name}"] for name in names)
    rates = [found[f"uplink_bytes_{name}"] / found[f"duration_{name}"] / 1e3 for name in names]
    sent = [(found[f"{channel}_places"], found[f"{channel}_place_bytes"]) for channel in ("lidar", "camera")]
    count, size = (sum(value for value in column if math.isfinite(value)) for column in zip(*sent, strict=True))
    verified, accepted = (f"inter_robot_{stage}_both" for stage in ("verified", "accepted"))
    joined = found["maps"] == 1 or case == "corridor"
    passed = (
        joined and not found["false_joins"] and not found[f"{accepted}_wrong"]
        and (case == "corridor" or (ate <= WORST_ATE_M and found["map_f1"] >= LEAST_F1))
    )  # fmt: skip
    return (
        case, seed, places, found["maps"], found["false_joins"], ate, found["across_robots_translation_error_mean"],
        found["map_f1"], found["map_free_iou"], found[f"{verified}_closures"], found[f"{verified}_wrong"],
        found[f"{accepted}_closures"], found[f"{accepted}_wrong"], found[f"{verified}_recall"],
        found[f"{verified}_recall_full_precision"], found[f"{verified}_recall_like_heading"], max(rates),
        size / count / 1e3, cost.wall_s, "yes" if passed else "NO",
    )  # fmt: skip


def summary(rows: Sequence[tuple], cases: Sequence[str]) -> Iterable[tuple]:
    """Each case and choice of channels over all seeds: sums of closures, means of recalls, the worst of the rest."""
    for case in cases:
        for places in CASES[case][1]:
            some = [dict(zip(COLUMNS, row, strict=True)) for row in rows if (row[0], row[2]) == (case, places)]
            total = {name: sum(row[name] for row in some) for name in ("verified", "wrong", "accepted", "wrong ")}
            mean = {name: total_of(some, name) / len(some) for name in ("recall", "at 100 %", "like heading")}
            yield (
                case, places, f"{sum(row['maps'] == 1 for row in some)} of {len(some)}", total_of(some, "false joins"),
                max(row["worst ATE, m"] for row in some), min(row["F1"] for row in some), *total.values(),
                *mean.values(), f"{sum(row['passed'] == 'yes' for row in some)} of {len(some)}",
            )  # fmt: skip


def total_of(rows: Iterable[dict], name: str) -> float:
    return sum(row[name] for row in rows)


if __name__ == "__main__":
    main()
