"""From the paper's system to the default one, one change at a time: what does each change gain?

    python benchmarks/paper_steps.py [--fleets FOLDER --keep steps.jsonl]

The first row is `fcslam map --config paper`. Each row below changes one thing and keeps it. Three robots with LiDAR and
camera drive 60 m each in the default simulated building from unknown starts. The seeds were not used while settings
were chosen; the rule for two valid matching points was chosen on seeds 201 and 202.

Robots send their packets once for each network and choice of places. The cloud then applies the same packets with the
settings of each row (`fcslam map --onto`), so all rows have the same LiDAR SLAM. CPU is that of this second command.
A join is right if it is off by 0.5 m and 10 deg at most, otherwise false. ATE is that of the worst robot, each map
moved onto the truth as a whole: it says little where maps stay apart or are joined falsely.

Matches are verified closures between robots. They are off if their transform is off by more than 0.5 m or 10 deg; the
paper takes the poses of two matching places for one. Camera matches are judged by what both cameras saw as well: more
than a half of either view in the other (same view), or less than a tenth (other view). Recall: revisits between robots
that matches with a right transform find. Intervals: 95 %, bootstrap over seeds; of what a change does to each fleet.
"""

import itertools
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np
import simulated_fleet
import yaml

from fcslam.lab.presets import Preset
from fcslam.metrics.bootstrap import mean_interval

VGG, BOTH = "vgg, camera", "light, LiDAR and camera"
"""What robots send: network and places."""


class Step(NamedTuple):
    """One row: its name, what the robots send, and the settings of the cloud that it changes."""

    name: str
    sends: str
    changes: dict[str, object]


STEPS = (
    Step("the paper", VGG, {}),
    Step("rebuild -> incremental", VGG, {"vocabulary": {"strategy": "incremental"}}),
    Step("delta -> geometric verification", VGG, {"decision": "geometry"}),
    Step("two points -> joint robust graph", VGG, {"fusion": "joint"}),
    Step(
        "light network, words and bits, LiDAR places: the default",
        BOTH,
        {"vocabulary": {"strategy": "incremental", "scoring": "matches"}},
    ),
)

MEASURES = {"right joins, of 3": ".2f", "false joins": ".2f", "worst ATE, m": ".3f", "F1": ".3f", "matches": ".0f",
            "off": ".0f", "camera matches": ".0f", "same view": ".0f", "other view": ".0f", "recall": ".3f",
            "sent by a robot, kB": ".0f", "CPU of the cloud, s": ".1f"}  # fmt: skip
COLUMNS = {"seed": "", "step": "", **MEASURES}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=simulated_fleet.SEEDS, help="of the fleets")
    parser.add_argument("--keep", type=Path, help="file that keeps finished fleets; the same one resumes")
    parser.add_argument("--fleets", type=Path, help="folder that keeps the recordings [they are deleted]")
    chosen = parser.parse_args()
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__, chosen)
    rows: list[tuple] = []
    with tempfile.TemporaryDirectory() as place:
        for sends, seed in itertools.product((VGG, BOTH), chosen.seeds):
            fleet = (chosen.fleets or Path(place)) / f"default-{seed}"
            rows += kept.rows((seed, sends), lambda fleet=fleet, seed=seed, sends=sends: fleet_rows(fleet, seed, sends))
    report.table("Means", {"step": "", **dict.fromkeys(MEASURES, "")}, means(rows))
    report.table("Against the row above", {"step": "", **dict.fromkeys(MEASURES, "")}, differences(rows))
    report.table("Fleets", COLUMNS, rows)
    report.write()


def fleet_rows(fleet: Path, seed: int, sends: str) -> Iterator[tuple]:
    """One fleet, recorded into the folder ``fleet``, under every step whose robots send this."""
    common.simulated(fleet, "--robots", simulated_fleet.ROBOTS, "--seed", seed)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        settings = settings_file(folder / "robots.yaml", {"robot": preset()["robot"] if sends == VGG else {}})
        common.run_fcslam("map", *sorted(fleet.glob("robot_*")), "--config", settings, "--output", folder / "sent")
        (folder / "sent" / "mission.state").unlink()  # the step with its settings would begin at the end
        for step, cloud in cloud_settings():
            if step.sends != sends:
                continue
            run, result = folder / "run", folder / "result.json"
            file = settings_file(folder / "cloud.yaml", {"fleet": cloud})
            cost = common.run_fcslam("map", "--onto", folder / "sent", "--config", file, "--output", run, "--force")
            common.run_fcslam("evaluate", "fleet", run, "--truth", fleet, "--csv", result)
            yield seed, step.name, *measures(simulated_fleet.read(result), cost)


def preset() -> dict[str, dict]:
    """The keys of the paper's preset."""
    return yaml.safe_load(Preset.PAPER.file.read_text(encoding="utf-8"))


def cloud_settings() -> Iterator[tuple[Step, dict[str, object]]]:
    """The settings of the cloud at each step: the preset, then one change after the other."""
    fleet = preset()["fleet"]
    for step in STEPS:
        changes = dict(step.changes)
        if "fusion" in changes:
            fleet["fusion"] = changes.pop("fusion")
        vocabulary = {**fleet["matcher"]["vocabulary"], **changes.pop("vocabulary", {})}
        fleet["matcher"] = {**fleet["matcher"], **changes, "vocabulary": vocabulary}
        yield step, fleet


def settings_file(path: Path, content: dict[str, object]) -> Path:
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


def measures(found: dict[str, float], cost: common.Cost) -> tuple[float, ...]:
    robots = [f"robot_{k + 1}" for k in range(simulated_fleet.ROBOTS)]
    matches, views = "inter_robot_verified_both", "inter_robot_verified_camera_views"
    return (
        found["joins"] - found["false_joins"],
        found["false_joins"],
        max(found[f"ate_rmse_{robot}"] for robot in robots),
        found["map_f1"],
        found[f"{matches}_closures"],
        found[f"{matches}_wrong"],
        found[f"{views}_judged"],
        found[f"{views}_same"],
        found[f"{views}_different"],
        found[f"{matches}_recall"],
        sum(found[f"uplink_bytes_{robot}"] for robot in robots) / len(robots) / 1e3,
        cost.cpu_s,
    )


def means(rows: Sequence[tuple]) -> Iterable[tuple]:
    for step in STEPS:
        mine = [row[2:] for row in rows if row[1] == step.name]
        yield (
            step.name,
            *(cell(values, spec) for values, spec in zip(zip(*mine, strict=True), MEASURES.values(), strict=True)),
        )


def differences(rows: Sequence[tuple]) -> Iterable[tuple]:
    """What each change does to the same fleets."""
    found = {row[:2]: np.asarray(row[2:], np.float64) for row in rows}
    seeds = dict.fromkeys(row[0] for row in rows)
    for before, step in itertools.pairwise(STEPS):
        changes = np.transpose([found[(seed, step.name)] - found[(seed, before.name)] for seed in seeds])
        yield step.name, *(cell(values, f"+{spec}") for values, spec in zip(changes, MEASURES.values(), strict=True))


def cell(values: Sequence[float], spec: str) -> str:
    mean, low, high = mean_interval(np.asarray(values, np.float64), np.random.default_rng(0))
    return f"{mean:{spec}} [{low:{spec}}, {high:{spec}}]"


if __name__ == "__main__":
    main()
