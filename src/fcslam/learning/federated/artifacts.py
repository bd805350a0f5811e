"""The files of a finished federated run: the detector as an ONNX file, its model card, and a picture of the rounds."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from fcslam.errors import writing
from fcslam.learning.artifacts import model_card
from fcslam.learning.export import detector_version, export_onnx
from fcslam.learning.federated.checkpoint import CoordinatorState
from fcslam.learning.federated.history import LOSS, ROUNDS_FILE, Row, read_rows
from fcslam.learning.federated.networks import weights_to_network
from fcslam.learning.federated.settings import DETECTOR, FederatedSettings

CARD, PICTURE = "card.md", "rounds.png"
SHOWN_METRICS: Final = {
    "repeatability": "keypoints found again within 3 px",
    "mma_3px": "matches within 3 px, by bits",
    "revisit_recall": "points that two images share and that match",
    "places_found": "places found again at full precision",
}
SHOWN_LOSSES: Final = ("detector", "contrastive", "triplet")
MEGABYTE: Final = 1e6


def write_federated_artifacts(
    state: CoordinatorState, folder: Path, settings: FederatedSettings, judged_on: str
) -> list[Path]:
    """Write the detector, the picture and the card; returns their paths.

    ``folder`` contains the table of rounds; ``judged_on`` names the images on which versions were evaluated.
    """
    network = weights_to_network(state.best, settings.training.encoder)
    export_onnx(network, folder / DETECTOR)
    rows = read_rows(folder / ROUNDS_FILE, state.rounds_done)
    best = next((row for row in rows if int(row["round"]) == state.best_round), {})
    figures = {text: float(best[name]) for name, text in SHOWN_METRICS.items() if best.get(name)}
    asked = ", ".join(f"{robot} ({times})" for robot, times in sorted(state.times_asked.items()))
    sent = sum(sum(_column(rows, name)) for name in ("bytes_down", "bytes_up"))
    facts = [
        f"Trained by {len(state.times_asked)} robots together, in {state.rounds_done} rounds; this is round "
        f"{state.best_round}. How often each was asked: {asked or 'never'}.",
        "",
        f"Began from {state.origin}. Weights sent: {sent / MEGABYTE:.1f} MB.",
    ]
    with writing(folder):
        draw_rounds(rows, folder / PICTURE)
        card = model_card(detector_version(network), facts, judged_on, figures, settings)
        (folder / CARD).write_text(card, encoding="utf-8")
    return [folder / name for name in (DETECTOR, PICTURE, CARD)]


def draw_rounds(rows: Sequence[Row], path: Path) -> None:
    """Draw losses, metrics with the released versions marked, and the megabytes sent so far, over the rounds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    losses, shares, traffic = figure.subplots(1, 3)
    rounds = [int(row["round"]) for row in rows]
    for name in SHOWN_LOSSES:
        losses.plot(rounds, _column(rows, LOSS + name), label=name)
    for name in SHOWN_METRICS:
        shares.plot(rounds, _column(rows, name), label=name.replace("_", " "))
    for number, row in zip(rounds, rows, strict=True):
        if row["released"] == "1":
            shares.axvline(number, color="0.8", linewidth=0.8, zorder=0)
    for name, label in (("bytes_down", "to the robots"), ("bytes_up", "from the robots")):
        sent = _column(rows, name)
        traffic.plot(rounds, [sum(sent[: index + 1]) / MEGABYTE for index in range(len(sent))], label=label)
    shares.set_ylim(0.0, 1.0)
    titles = ("losses, mean of the robots", "evaluation; grey: released", "weights sent so far [MB]")
    for panel, title in zip((losses, shares, traffic), titles, strict=True):
        panel.set_title(title)
        panel.set_xlabel("round")
        panel.grid(alpha=0.3)
        panel.legend(frameon=False)
    figure.savefig(path, dpi=120)


def _column(rows: Sequence[Mapping[str, str]], name: str) -> list[float]:
    return [float(row.get(name) or "nan") for row in rows]
