"""Federated training against training in one place and against robots that train alone, and against poison.

    FCSLAM_DATA=/path/to/data python benchmarks/federated.py --study FOLDER

Needs `fcslam[federated]` and `fcslam[sim]`. FOLDER holds all that is trained and measured; the same command goes on
where it was interrupted. `--until together` leaves out all but
the comparison itself. Five robots that see different things: a floor of a tower, a drive through a town, photographs
from the web, and two simulated ones, by day and with lamps off, with few images each, as a robot alone would hardly
lack others' if it had many. All begin from one small detector that was trained anew on photographs that no robot has,
with Harris's corners as labels, and is far from what longer training makes of it. Central and local training take as
many samples as all robots together, in steps of two pairs one after another; a robot of a fleet takes a fifth of these
steps in every arm, in the default's rounds, and so do robots that train alone. Plain is without the server's momentum.
Wide is central training in as few steps as a robot of the fleet does, each of five times as many pairs, at twice the
learning rate:
what it lacks, the fleet lacks for want of steps and not for images that are elsewhere. Pairs are drawn from images that
no network saw; a robot's own network is shown every fifth of all of them, in turns, so mostly of places where it never
was; the worst robot is the one whose images an arm does worst on, whoever trained.

Chosen on another fleet's held-out images (another floor, another drive, photographs of another set, robots of another
simulation; 600 pairs, one seed): the learning rate, which gave central training the better MMA of 1e-3 and 3e-3, that a
robot's optimizer goes on where its last round ended, the length of rounds, and the server's momentum. The number of
images was chosen before any of this was measured, but after a smaller study with 36 to 46 images a robot, where robots
alone lacked nothing; the number of rounds is the default, after studies of fewer, where steps were still lacking more
than others' images.

Gap: central minus the arm, in points, on the same pairs and seeds, with 95 % by paired bootstrap over pairs. Closed:
(arm - local) / (central - local), where central - local is clearly above 0; of alone: the same with alone for local.
Lost, to poison: together minus the arm. Intervals are over pairs, not over seeds, and
pairs of one image resemble one another, so they are somewhat too narrow; most so where an arm has one seed.
"""

import csv
import math
import sys
from collections.abc import Iterable, Iterator, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any

import common
import numpy as np
from evaluation.federated.training_fleet import GAPS, SIMULATED, TITLES, VISION, compare, gap_row, points, robots, run
from matplotlib.figure import Figure

from fcslam.learning.federated.coordinator import RoundRules
from fcslam.learning.federated.screening import ScreeningBounds
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.settings import TrainingSettings
from fcslam.metrics.bootstrap import mean_interval

if TYPE_CHECKING:
    from evaluation.federated.study import StudyResults
    from evaluation.federated.training_fleet import Rows

PUBLIC = "sun_hays80"
"""Photographs that the start is trained on."""
START = TrainingSettings(steps=1000, label_copies=4, pairs=4, side_px=128)

ROUNDS, STEPS = FederatedSettings().rounds, FederatedSettings().local_steps
TRAINING = {"label_copies": 4, "pairs": 2, "side_px": 128, "learning_rate": 3e-3}
FEDERATED = {"rounds": ROUNDS, "local_steps": STEPS, "training": TRAINING}
WIDE = TRAINING | {"pairs": 10, "learning_rate": 6e-3}
"""In one step what five robots take together."""
TRUSTING = RoundRules(bounds=ScreeningBounds(math.inf, math.inf, -math.inf, math.inf, clips=False))
ROBUST: dict[str, dict[str, Any]] = {
    "fedavg": {"rules": TRUSTING},
    "screened": {},
    "median": {"settings": {"strategy": "fedmedian"}, "rules": TRUSTING},
}
AT_HOME = {"arm": "s", "images": "s", "pairs": "d", "homographies, %": ".1f", "below central": "s",
           "below together": "s", "MMA, %": ".1f", "below central ": "s", "below together ": "s"}  # fmt: skip
LOST = {"homography, %": ".1f", "lost": "s", "MMA, %": ".1f", "lost ": "s"}
LOSSES = {"arm": "s"} | LOST
KEEPING = {"arm": "s", "new and new, MMA, %": ".1f", "below together": "s",
           "old and new, MMA, %": ".1f", "below together ": "s"}  # fmt: skip
REFUSED = {"arm": "s", "updates of honest robots": "d", "refused": "d", "of the poisoned one": "s"}
SEEDS, PAIRS, IMAGES, TRAINED = 3, 2000, 64, 16
COMPARED = ("start", "central", "wide", "local", "alone", "together", "plain")
"""Arms without poison."""


def arms() -> dict[str, Any]:
    """What is trained beside central and local, in the order in which it is."""
    few: dict[str, Any] = {"seeds": 1}
    poisoned: dict[str, Any] = {"poison": "reversed", **few}
    return {
        "together": {},
        **{f"{name}-reversed": {**how, **poisoned} for name, how in ROBUST.items()},
        "wide": {"together": False, "settings": {"training": WIDE}, **few},
        "plain": {"rules": RoundRules(momentum=0.0), **few},
    }


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--study", type=Path, help="folder of the study; the same one resumes")
    parser.add_argument("--until", choices=list(arms()), help="the last arm, those after it being left out")
    chosen = parser.parse_args()
    if chosen.study is None:
        print("skipped: takes an hour or more; name a folder by --study")
        sys.exit(0)
    folder: Path = chosen.study.resolve()
    vision = common.recordings(*VISION.values(), PUBLIC, kind="vision")
    folder.mkdir(parents=True, exist_ok=True)
    findings = study(vision, folder, chosen.until)
    below = compare(findings, "central")
    report = common.Report(__file__, __doc__ or "", chosen)
    report.say(setting(findings, folder))
    known = set(findings.measured)
    for measure, title in TITLES.items():
        report.table(title, GAPS, [gap_row(below[measure, arm]) for arm in COMPARED if arm in known])
    at_home = list(home_rows(findings, ("local", "alone")))
    report.table("Robots' own networks, at home and where other robots are", AT_HOME, at_home)
    unpoisoned = compare(findings, "together")
    if poisoned := list(poison_rows(unpoisoned)):
        report.table("One of five robots poisoned", LOSSES, poisoned)
    report.table("Updates that screening refused", REFUSED, refused_rows(folder / "study", known))
    report.table("Old codes in the first view, new ones in the second", KEEPING, kept_rows(unpoisoned))
    report.picture("Gap to central training by arm", draw(below))
    report.write()


def study(vision: Path, folder: Path, until: str | None) -> "StudyResults":
    """Train and measure whatever is missing, up to an arm."""
    fleet = robots(vision, folder)
    names = list(arms())
    wanted = names[: names.index(until) + 1] if until else names
    content = {
        "federated": FEDERATED,
        "arms": {name: arms()[name] for name in wanted},
        "seeds": SEEDS,
        "local_seeds": 1,
        "pairs": PAIRS,
        "images": IMAGES,
        "trained": TRAINED,
        "start": initial(vision, folder),
    }
    return run(fleet, folder / "study", content)


def initial(vision: Path, folder: Path) -> Path:
    """The checkpoint that all arms start from, trained unless it is there."""
    from fcslam.learning.stages import train_detector
    from fcslam.learning.trainer import CHECKPOINT_FILE, ExecutionOptions

    train_detector([vision / PUBLIC], folder / "start", START, ExecutionOptions(), None, lambda *_: None)
    return folder / "start" / "joint" / CHECKPOINT_FILE


def setting(findings: "StudyResults", folder: Path) -> str:
    """What was done, in words."""
    measured = [file.stat().st_mtime for file in (folder / "study").glob("seed*/measured/*.npz")]
    labelled = {name: list((folder / "study" / "labels" / place).rglob("*.state")) for name, place in places()}
    first = min(file.stat().st_mtime for files in labelled.values() for file in files)
    images = ", ".join(f"{name} {len(files)}" for name, files in labelled.items())
    return (
        f"Images trained on: {images}; of {IMAGES} files each a quarter is tested on. {ROUNDS} rounds of {STEPS} steps "
        f"of {TRAINING['pairs']} pairs a robot; central and local {ROUNDS * STEPS * len(labelled)} steps. "
        f"{len(findings.owners)} pairs, {SEEDS} seeds where not said otherwise. From the first label to the last "
        f"figure {(max(measured) - first) / 3600:.1f} hours, on a machine that was busy with other work as well."
    )


def places() -> list[tuple[str, str]]:
    """The robots, and how their labels' folders are called."""
    return [(name, Path(place).name) for name, place in VISION.items()] + list(SIMULATED.items())


def home_rows(findings: "StudyResults", own: Iterable[str]) -> Iterator[tuple[object, ...]]:
    """What robots' own networks make of their own images, and of others', beside the networks that all have."""
    from evaluation.federated.pairs import MEASURES

    owners = np.array(findings.owners)
    everybody = {arm: np.nanmean(findings.measured[arm], axis=(0, 1)) for arm in ("central", "together")}
    for arm in own:
        values = findings.measured[arm]
        known = np.isfinite(values[..., 0])
        shown = [network == owners[pair] for _, network, pair in np.argwhere(known)]
        pairs = np.argwhere(known)[:, 2]
        for images, mask in (("its own", np.array(shown)), ("others'", ~np.array(shown))):
            cells: list[object] = []
            for index in (MEASURES.index(measure) for measure in TITLES):
                found = values[known][mask, index]
                gaps = [each[pairs[mask], index] - found for each in everybody.values()]
                rng = np.random.default_rng(1)
                cells += [100 * float(found.mean()), *(points(mean_interval(gap, rng)) for gap in gaps)]
            yield arm, images, int(mask.sum()), *cells


def poison_rows(rows: "Rows") -> Iterator[tuple[object, ...]]:
    for arm, what in arms().items():
        if "poison" in what and ("mma_3px", arm) in rows:
            yield arm, *lost(rows, arm)


def refused_rows(study: Path, known: Set[str]) -> Iterator[tuple[object, ...]]:
    """Of the arms that screen."""
    for arm, what in arms().items():
        if arm not in known or not what.get("together", True) or what.get("rules") is TRUSTING:
            continue
        files = study.glob(f"seed*/{arm}/rounds.csv")
        rows = [row for file in files for row in csv.DictReader(file.open(encoding="utf-8"))]
        names = [name for name, _ in places()]
        bad = names[-1:] if "poison" in what else []
        counted = {name: sum(name in row["robots"].split(" | ") for row in rows) for name in names}
        updates = len(rows) * (len(names) - len(bad))
        honest = updates - sum(count for name, count in counted.items() if name not in bad)
        yield arm, updates, honest, " ".join(f"{len(rows) - counted[name]} of {len(rows)}" for name in bad)


def lost(rows: "Rows", arm: str) -> list[object]:
    """Both measures of an arm, and how far they are below the one it is compared to."""
    return [cell for row in (rows[measure, arm] for measure in TITLES) for cell in (100 * row.mean, points(row.gap))]


def kept_rows(rows: "Rows") -> Iterator[tuple[object, ...]]:
    for arm in [each for each in ("start", "central", "together") if ("mma_3px", each) in rows]:
        found = [rows[measure, arm] for measure in ("mma_3px", "mma_3px_former")]
        cells = [cell for row in found for cell in (100 * row.mean, points(row.gap))]
        yield arm, *cells


def draw(rows: "Rows") -> Figure:
    """Gaps with intervals by arm."""
    names = [arm for arm in ("local", "alone", *arms()) if ("mma_3px", arm) in rows]
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    panel = figure.subplots()
    for offset, (measure, title) in zip((-0.15, 0.15), TITLES.items(), strict=True):
        gaps = np.array([rows[measure, arm].gap for arm in names]) * 100
        at, spread = np.arange(len(names)) + offset, np.abs(gaps[:, 1:].T - gaps[:, 0])
        panel.errorbar(gaps[:, 0], at, xerr=spread, fmt="o", capsize=2, label=title)
    panel.axvline(0.0, color="black", linewidth=1)
    panel.axvline(2.0, color="grey", linewidth=1, linestyle=":")
    panel.set_yticks(range(len(names)), names)
    panel.invert_yaxis()
    panel.set_xscale("symlog", linthresh=5.0)
    panel.set_xticks(ticks := (-5, -2, 0, 2, 5, 10, 30), [str(tick) for tick in ticks])
    panel.set_xlabel("points below central training, 95 %")
    panel.grid(alpha=0.3)
    panel.legend(frameon=False, loc="lower left")
    return figure


if __name__ == "__main__":
    main()
