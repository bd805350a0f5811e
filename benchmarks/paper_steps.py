"""From the paper's system to the default one, one change at a time: what does each change gain?

    python benchmarks/paper_steps.py [--changes 101 102 103] [--fleets FOLDER --keep steps.jsonl]

The first row is `fcslam map --config paper`, for all seeds. All others are for the seeds of --changes: the next two
train the vocabulary at every place, or have Karto's scan matcher (`robot.lidar.tracker: karto`); each row below changes
one thing of the first one and keeps it. Three robots with LiDAR and camera drive 60 m each in the default simulated
building from unknown starts. The seeds were not used while settings were chosen; the rule for two valid matching points
was chosen on seeds 201 to 204, as delta was (`benchmarks/delta.py`).

The cloud applies the packets of the first row with the settings of each row below (`fcslam map --onto`), but for those
of Karto and the last row, whose robots send others. A join is right if it is off by 0.5 m and 10 deg at most, otherwise
false. ATE is that of the worst robot, each map moved onto the truth as a whole: it says little where maps stay apart or
are joined falsely.

Matches are verified closures between robots. They are off if their transform is off by more than 0.5 m or 10 deg; the
paper takes the poses of two matching places for one. Camera matches are judged by what both cameras saw as well: more
than a half of either view in the other (same view), or less than a tenth (other view). Recall: revisits between robots
that matches with a right transform find. Intervals: 95 %, bootstrap over seeds; of what a change does to each fleet.

The paper's figure 5, the robots' maps with the matched places, the fused map and the building, is drawn of the first
and the last row of the first seed of --changes, into docs/images.
"""

import itertools
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import common
import numpy as np
import simulated_fleet
import yaml
from delta import papers_run
from evaluation.fleet_charts import fleet_charts
from evaluation.fleet_figure import write_figure
from evaluation.fleet_views import judge_views

from fcslam.lab.presets import Preset
from fcslam.metrics.bootstrap import mean_interval
from fcslam.records import ClosureStatus


class Step(NamedTuple):
    """One row: its name and the settings of the cloud that it changes."""

    name: str
    changes: dict[str, object]


PAPER, KARTO = "the paper", "the paper, Karto's scan matcher"
EVERY_PLACE = Step("the paper, a vocabulary at every place", {"vocabulary": {"strategy": "rebuild"}})
KARTO_TRACKER = "robot.lidar.tracker=karto"
DEFAULT = "light network, words and bits, LiDAR places: the default"
PICTURES = {step: common.REPOSITORY / "docs" / "images" / f"figure5-{name}.png" for step, name in
            ((PAPER, "paper"), (DEFAULT, "default"))}  # fmt: skip
CHANGES = (
    Step("delta -> geometric verification", {"decision": "geometry"}),
    Step("windowed -> incremental", {"vocabulary": {"strategy": "incremental"}}),
    Step("two points -> joint robust graph", {"fusion": "joint"}),
)
BESIDE = (EVERY_PLACE.name, KARTO)
STEPS = (PAPER, *(step.name for step in CHANGES), DEFAULT)

MEASURES = {"right joins, of 3": ".2f", "false joins": ".2f", "worst ATE, m": ".3f", "F1": ".3f", "matches": ".0f",
            "off": ".0f", "camera matches": ".0f", "same view": ".0f", "other view": ".0f", "recall": ".3f",
            "sent by a robot, kB": ".0f"}  # fmt: skip
COLUMNS = {"seed": "", "step": "", **MEASURES}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=simulated_fleet.SEEDS, help="of the fleets")
    parser.add_argument("--changes", nargs="*", type=int, default=simulated_fleet.SEEDS[:3], help="seeds of all rows")
    parser.add_argument("--keep", type=Path, help="file that keeps finished fleets; the same one resumes")
    parser.add_argument("--fleets", type=Path, help="folder that keeps recordings and runs [they go]")
    chosen = parser.parse_args()
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__, chosen)
    rows: list[tuple] = []
    with tempfile.TemporaryDirectory() as place:
        for seed in chosen.seeds:
            pictures, full = PICTURES if [seed] == list(chosen.changes[:1]) else {}, seed in chosen.changes
            of_fleet = (chosen.fleets or Path(place), seed, full, pictures)
            rows += kept.rows((seed, full), lambda of_fleet=of_fleet: fleet_rows(*of_fleet))
    report.table("Means", {"step": "", "fleets": "d", **dict.fromkeys(MEASURES, "")}, means(rows))
    report.table("What a change does", {"step": "", **dict.fromkeys(MEASURES, "")}, differences(rows))
    report.table("Fleets", COLUMNS, rows)
    report.write()


def fleet_rows(fleets: Path, seed: int, full: bool, pictures: Mapping[str, Path]) -> Iterator[tuple]:
    """One fleet, recorded into the folder ``fleets``, by the paper's system and, if ``full``, after each change.

    ``pictures``: where figure 5 of a row goes.
    """
    fleet, paper = papers_run(fleets, seed)
    robots = sorted(fleet.glob("robot_*"))
    with tempfile.TemporaryDirectory() as place:
        run, file = Path(place) / "run", Path(place) / "cloud.yaml"
        yield seed, PAPER, *measures(paper, fleet, pictures.get(PAPER))
        if not full:
            return
        alone = EVERY_PLACE, next(changed_clouds([EVERY_PLACE]))
        for step, cloud in (alone, *zip(CHANGES, changed_clouds(CHANGES), strict=True)):
            file.write_text(yaml.safe_dump({"fleet": cloud}), encoding="utf-8")
            common.run_fcslam("map", "--onto", paper, "--config", file, "--output", run, "--force")
            yield seed, step.name, *measures(run, fleet)
        settings = ("--config", Preset.PAPER, "--config", KARTO_TRACKER)
        common.run_fcslam("map", *robots, *settings, "--output", run, "--force")
        yield seed, KARTO, *measures(run, fleet)
        common.run_fcslam("map", *robots, "--output", run, "--force")
        yield seed, DEFAULT, *measures(run, fleet, pictures.get(DEFAULT))


def changed_clouds(steps: Sequence[Step]) -> Iterator[dict[str, object]]:
    """The settings of the cloud after each change: the preset, then one change after the other."""
    fleet = yaml.safe_load(Preset.PAPER.file.read_text(encoding="utf-8"))["fleet"]
    for step in steps:
        changes = dict(step.changes)
        fleet["fusion"] = changes.pop("fusion", fleet["fusion"])
        vocabulary = {**fleet["matcher"]["vocabulary"], **changes.pop("vocabulary", {})}
        fleet["matcher"] = {**fleet["matcher"], **changes, "vocabulary": vocabulary}
        yield dict(fleet)


def measures(run: Path, fleet: Path, picture: Path | None = None) -> tuple[float, ...]:
    """A run against the truth, as in ``MEASURES``; ``picture``: file of its figure 5."""
    with tempfile.TemporaryDirectory() as place:
        result = Path(place) / "result.json"
        common.run_fcslam("evaluate", "fleet", run, "--truth", fleet, "--csv", result)
        if picture is not None:
            write_figure(fleet_charts(run, fleet), picture)
        found = simulated_fleet.read(result)
    robots = [f"robot_{k + 1}" for k in range(simulated_fleet.ROBOTS)]
    matches, views = "inter_robot_verified_both", judge_views(run, fleet)[ClosureStatus.VERIFIED]
    return (
        found["joins"] - found["false_joins"],
        found["false_joins"],
        max(found[f"ate_rmse_{robot}"] for robot in robots),
        found["map_f1"],
        found[f"{matches}_closures"],
        found[f"{matches}_wrong"],
        views.judged,
        views.same,
        views.different,
        found[f"{matches}_recall"],
        sum(found[f"uplink_bytes_{robot}"] for robot in robots) / len(robots) / 1e3,
    )


def means(rows: Sequence[tuple]) -> Iterable[tuple]:
    for step in (PAPER, *BESIDE, *STEPS[1:]):
        mine = [row[2:] for row in rows if row[1] == step]
        if mine:
            yield (
                step,
                len(mine),
                *(cell(*each) for each in zip(zip(*mine, strict=True), MEASURES.values(), strict=True)),
            )


def differences(rows: Sequence[tuple]) -> Iterable[tuple]:
    """What each row beside the paper's, and each change against the one before, does to the same fleets."""
    found = {row[:2]: np.asarray(row[2:], np.float64) for row in rows}
    for before, step in (*((PAPER, beside) for beside in BESIDE), *itertools.pairwise(STEPS)):
        seeds = [seed for seed, name in found if name == step]
        if not seeds:
            continue
        changes = np.transpose([found[seed, step] - found[seed, before] for seed in seeds])
        yield step, *(cell(values, f"+{spec}") for values, spec in zip(changes, MEASURES.values(), strict=True))


def cell(values: Sequence[float], spec: str) -> str:
    mean, low, high = mean_interval(np.asarray(values, np.float64), np.random.default_rng(0))
    return f"{mean:{spec}} [{low:{spec}}, {high:{spec}}]"


if __name__ == "__main__":
    main()
