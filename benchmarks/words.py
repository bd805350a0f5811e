"""Words only: bytes between robots and cloud when robots send words in place of descriptors and ranges, and the map.

    python benchmarks/words.py

The recordings of `fcslam demo`: three robots with LiDAR and camera, 60 m each. The shared vocabulary is trained on the
places of a fleet in another building (seed 20). Each row is the real command; "words" is `--config paper` with
`robot.sends: words`. Kilobytes are those of all three robots. ATE is that of the worst robot, each map moved onto the
truth as a whole. A join is wrong if it is off by 0.5 m or 10 deg.
"""

import tempfile
from pathlib import Path

import common
import simulated_fleet
import yaml

DEMO_SEED, OTHER_SEED = 1, 20
KINDS = ("hello", "keyscan", "constraint", "place", "word_place", "map_tile")
COLUMNS = {"robots send": "", **{f"{kind}, kB": ".1f" for kind in KINDS}, "up, kB": ".1f", "places": ".0f",
           "bytes a place": ".0f", "maps": ".0f", "false joins": ".0f", "worst ATE, m": ".3f", "F1": ".3f"}  # fmt: skip


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--fleets", type=Path, help="folder that keeps the simulated fleets; the same one resumes")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    rows = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        fleets = chosen.fleets or folder
        words = vocabulary(folder, fleets)
        fleet = common.simulated(fleets / "demo", "--robots", simulated_fleet.ROBOTS, "--seed", DEMO_SEED)
        shared = {
            "robot": {"sends": "words", "words": {"vocabulary": str(words)}},
            "fleet": {"vocabularies": [str(words)]},
        }
        file = folder / "words.yaml"
        file.write_text(yaml.safe_dump(shared), encoding="utf-8")
        rows.append(row("ranges, LiDAR and camera descriptors (default)", folder, fleet))
        rows.append(row("ranges and camera descriptors (preset paper)", folder, fleet, "--config", "paper"))
        rows.append(row("words and their own map", folder, fleet, "--config", "paper", "--config", file))
    report.table("Bytes of three robots", COLUMNS, rows)
    report.write()


def vocabulary(folder: Path, fleets: Path) -> Path:
    """Words of another building."""
    fleet = common.simulated(fleets / "other", "--robots", simulated_fleet.ROBOTS, "--seed", OTHER_SEED)
    run, words = folder / "other-run", folder / "shared.words"
    common.run_fcslam("map", *sorted(fleet.glob("robot_*")), "--config", "paper", "--output", run)
    common.run_fcslam("tools", "vocabulary", run, "--output", words)
    return words


def row(name: str, folder: Path, fleet: Path, *options: object) -> tuple:
    run, result = folder / "run", folder / "result.json"
    common.run_fcslam("map", *sorted(fleet.glob("robot_*")), *options, "--output", run, "--force")
    common.run_fcslam("evaluate", "fleet", run, "--truth", fleet, "--csv", result)
    sent, found = common.metrics(run), simulated_fleet.read(result)
    kilobytes = [sent.get(f"{kind}_bytes", 0.0) / 1e3 for kind in KINDS]
    places = sum(sent.get(f"{kind}_packets", 0.0) for kind in ("place", "word_place"))
    described = sum(sent.get(f"{kind}_bytes", 0.0) for kind in ("place", "word_place"))
    worst = max(found[f"ate_rmse_robot_{k + 1}"] for k in range(simulated_fleet.ROBOTS))
    judged = found["maps"], found["false_joins"], worst, found["map_f1"]
    return name, *kilobytes, sum(kilobytes), places, described / places, *judged


if __name__ == "__main__":
    main()
