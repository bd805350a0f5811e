"""What the card and the picture of a finished federated run show."""

from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Final

from fcslam.learning.artifacts import Panel, TrainingReport
from fcslam.learning.federated.checkpoint import CoordinatorState
from fcslam.learning.federated.history import LOSS, ROUNDS_FILE, read_rows

SHOWN_METRICS: Final = {
    "repeatability": "keypoints found again within 3 px",
    "mma_3px": "matches within 3 px, by bits",
    "revisit_recall": "points that two images share and that match",
    "places_found": "places found again at full precision",
}
SHOWN_LOSSES: Final = ("detector", "contrastive", "triplet")
TRAFFIC: Final = {"bytes_down": "to the robots", "bytes_up": "from the robots"}
MEGABYTE: Final = 1e6


def federated_report(state: CoordinatorState, folder: Path, judged_on: str) -> TrainingReport:
    """The report; ``folder`` contains the table of rounds, ``judged_on`` names the images of the evaluation."""
    rows = read_rows(folder / ROUNDS_FILE, state.rounds_done)
    rounds = [int(row["round"]) for row in rows]
    best = next((row for row in rows if int(row["round"]) == state.best_round), {})
    asked = ", ".join(f"{robot} ({times})" for robot, times in sorted(state.times_asked.items()))
    sent = {label: [each / MEGABYTE for each in accumulate(_column(rows, name))] for name, label in TRAFFIC.items()}
    facts = [
        f"Trained by {len(state.times_asked)} robots together, in {state.rounds_done} rounds; this is round "
        f"{state.best_round}. How often each was asked: {asked or 'never'}.",
        "",
        f"Began from {state.origin}. Weights sent: {sum(each[-1] for each in sent.values() if each):.1f} MB.",
    ]
    shares = {name.replace("_", " "): (rounds, _column(rows, name)) for name in SHOWN_METRICS}
    released = [number for number, row in zip(rounds, rows, strict=True) if row["released"] == "1"]
    return TrainingReport(
        facts,
        judged_on,
        {text: float(best[name]) for name, text in SHOWN_METRICS.items() if best.get(name)},
        [
            Panel("losses, mean of the robots", {name: (rounds, _column(rows, LOSS + name)) for name in SHOWN_LOSSES}),
            Panel("evaluation; grey: released", shares, are_shares=True, marks=released),
            Panel("weights sent so far [MB]", {label: (rounds, values) for label, values in sent.items()}),
        ],
        "round",
    )


def _column(rows: Sequence[Mapping[str, str]], name: str) -> list[float]:
    return [float(row.get(name) or "nan") for row in rows]
