"""From the paper's system to the default one, one change at a time: what does each change gain?

    python benchmarks/paper_steps.py --paper VGG.onnx --vgg VGG.onnx --keep steps.jsonl

The first row is `fcslam map --config paper`. Each row below changes one thing and keeps it. Three robots with LiDAR and
camera drive 60 m each in a simulated building from unknown starts; the seeds were not used while settings were chosen.
--paper is a network with the paper's encoder that was trained with eqs. (1)-(3), --vgg the same encoder with our losses
(`benchmarks/paper_networks.py` trains both); without them, their rows are left out.

Robots send their packets once for each detector and choice of places. The cloud then applies the same packets with the
settings of each row (`fcslam map --onto`), so all rows have the same LiDAR SLAM. CPU is that of this second command.
ATE is that of the worst robot, each map moved onto the truth as a whole: it says little where maps stay apart or are
joined falsely. A join or a closure is wrong if it is off by 0.5 m or 10 deg. The paper takes the poses of two matching
places for one, so its matches are right only if the robots stood at one spot. Recall: revisits between robots that
correct verified closures find. Intervals: 95 %, bootstrap over seeds; over fleets, for what a change does to them.
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

CASES = ("default", "corridor", "default, other light")
PAPER, VGG, LIGHT, BOTH = "paper's network, camera", "vgg, camera", "light, camera", "light, LiDAR and camera"
"""What robots send: detector and places."""


class Step(NamedTuple):
    """One row: its name, what the robots send, and the settings of the cloud that it changes."""

    name: str
    sends: str
    changes: dict[str, object]


STEPS = (
    Step("the paper", PAPER, {}),
    Step("eqs. (1)-(3) -> our losses", VGG, {}),
    Step("VGG -> light network", LIGHT, {}),
    Step("delta -> geometric verification", LIGHT, {"decision": "geometry", "small_fleet": 0}),
    Step("rebuild -> incremental", LIGHT, {"vocabulary": {"strategy": "incremental"}}),
    Step("words -> words and bits", LIGHT, {"vocabulary": {"strategy": "incremental", "scoring": "matches"}}),
    Step("few places: all compared", LIGHT, {"small_fleet": 150}),
    Step("two points -> joint robust graph", LIGHT, {"fusion": "joint"}),
    Step("LiDAR places on: the default", BOTH, {}),
)

MEASURES = {"one map": ".2f", "false joins": ".2f", "worst ATE, m": ".3f", "F1": ".3f", "verified": ".0f",
            "wrong": ".0f", "recall": ".3f", "sent by a robot, kB": ".0f", "CPU of the cloud, s": ".1f"}  # fmt: skip
COLUMNS = {"building": "", "seed": "", "step": "", **MEASURES}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES, help="kinds of fleet")
    parser.add_argument("--seeds", nargs="+", type=int, default=simulated_fleet.SEEDS, help="of the fleets")
    parser.add_argument("--paper", type=Path, help="the network of the first row")
    parser.add_argument("--vgg", type=Path, help="the network of the second row")
    parser.add_argument("--keep", type=Path, help="file that keeps finished fleets; the same one resumes")
    parser.add_argument("--fleets", type=Path, help="folder that keeps the recordings [they are deleted]")
    chosen = parser.parse_args()
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__, chosen)
    networks = {PAPER: chosen.paper, VGG: chosen.vgg}
    steps = [step for step in STEPS if networks.get(step.sends, step) is not None]
    rows: list[tuple] = []
    with tempfile.TemporaryDirectory() as place:
        for seed, case in itertools.product(chosen.seeds, chosen.cases):
            folder = (chosen.fleets or Path(place)) / f"{case}-{seed}"
            for sends in dict.fromkeys(step.sends for step in steps):
                network = networks.get(sends)
                key = (case, seed, sends, str(network and network.resolve()))
                fleet = (folder, case, seed, sends, network)
                rows += kept.rows(key, lambda fleet=fleet: fleet_rows(*fleet))
    for case in chosen.cases:
        report.table(f"Means: {case}", {"step": "", **dict.fromkeys(MEASURES, "")}, means(rows, case, steps))
    report.table(
        "Against the row above: all fleets", {"step": "", **dict.fromkeys(MEASURES, "")}, differences(rows, steps)
    )
    report.table("Fleets", COLUMNS, rows)
    report.write()


def fleet_rows(fleet: Path, case: str, seed: int, sends: str, network: Path | None) -> Iterator[tuple]:
    """One fleet, recorded into the folder ``fleet``, under every step whose robots send this."""
    common.simulated(fleet, "--robots", simulated_fleet.ROBOTS, "--seed", seed, *simulated_fleet.CASES[case][0])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        settings = settings_file(folder / "robots.yaml", {"robot": robot_settings(sends, network)})
        common.run_fcslam("map", *sorted(fleet.glob("robot_*")), "--config", settings, "--output", folder / "sent")
        (folder / "sent" / "mission.state").unlink()  # the step with its settings would begin at the end
        for step, cloud in cloud_settings():
            if step.sends != sends:
                continue
            run, result = folder / "run", folder / "result.json"
            file = settings_file(folder / "cloud.yaml", {"fleet": cloud})
            cost = common.run_fcslam("map", "--onto", folder / "sent", "--config", file, "--output", run, "--force")
            common.run_fcslam("evaluate", "fleet", run, "--truth", fleet, "--csv", result)
            yield case, seed, step.name, *measures(simulated_fleet.read(result), cost)


def robot_settings(sends: str, network: Path | None) -> dict[str, object]:
    settings: dict[str, object] = {"channels": ["lidar", "camera"] if sends == BOTH else ["camera"]}
    if network is not None:
        settings["views"] = {"onnx": {"weights": str(network.resolve())}}
    return settings


def cloud_settings() -> Iterator[tuple[Step, dict[str, object]]]:
    """The settings of the cloud at each step: the preset, then one change after the other."""
    fleet = yaml.safe_load(Preset.PAPER.file.read_text(encoding="utf-8"))["fleet"]
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
    return (
        float(found["maps"] == 1),
        found["false_joins"],
        max(found[f"ate_rmse_{robot}"] for robot in robots),
        found["map_f1"],
        found["inter_robot_verified_both_closures"],
        found["inter_robot_verified_both_wrong"],
        found["inter_robot_verified_both_recall"],
        sum(found[f"uplink_bytes_{robot}"] for robot in robots) / len(robots) / 1e3,
        cost.cpu_s,
    )


def means(rows: Sequence[tuple], case: str, steps: Sequence[Step]) -> Iterable[tuple]:
    for step in steps:
        mine = [row[3:] for row in rows if row[0] == case and row[2] == step.name]
        yield (
            step.name,
            *(cell(values, spec) for values, spec in zip(zip(*mine, strict=True), MEASURES.values(), strict=True)),
        )


def differences(rows: Sequence[tuple], steps: Sequence[Step]) -> Iterable[tuple]:
    """What each change does to the same fleets; fleets that lack one of the two rows do not count."""
    found = {(*row[:2], row[2]): np.asarray(row[3:], np.float64) for row in rows}
    fleets = dict.fromkeys(row[:2] for row in rows)
    for before, step in itertools.pairwise(steps):
        both = [fleet for fleet in fleets if {(*fleet, before.name), (*fleet, step.name)} <= found.keys()]
        changes = np.transpose([found[(*fleet, step.name)] - found[(*fleet, before.name)] for fleet in both])
        yield step.name, *(cell(values, f"+{spec}") for values, spec in zip(changes, MEASURES.values(), strict=True))


def cell(values: Sequence[float], spec: str) -> str:
    mean, low, high = mean_interval(np.asarray(values, np.float64), np.random.default_rng(0))
    return f"{mean:{spec}} [{low:{spec}}, {high:{spec}}]"


if __name__ == "__main__":
    main()
