"""A federated training job from the initial weights to the exported detector: over any transport, or in one process."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Final

import numpy as np
import torch

from fcslam.config import dump
from fcslam.errors import FcslamError, InputError, writing
from fcslam.features.detector import GreyImage
from fcslam.learning.artifacts import Panel, TrainingReport, write_artifacts
from fcslam.learning.export import export_onnx
from fcslam.learning.federated.checkpoint import CoordinatorState
from fcslam.learning.federated.client import ImageClient, InProcessFleet
from fcslam.learning.federated.coordinator import RULES, Coordinator, CoordinatorHooks, RoundRules, TrainingFleet
from fcslam.learning.federated.evaluation import PUBLIC_IMAGES, EvaluateFn, Metrics
from fcslam.learning.federated.initial_weights import prepare_initial_weights
from fcslam.learning.federated.networks import weights_to_network, weights_version
from fcslam.learning.federated.rounds import LOSS, RoundReport, Row
from fcslam.learning.federated.settings import FederatedSettings
from fcslam.learning.federated.weights import Weights
from fcslam.learning.images import read_usable_images
from fcslam.learning.labels import Labels
from fcslam.learning.pairs import TrainingExample
from fcslam.learning.settings import DETECTOR, Encoder
from fcslam.learning.validation import validate, validation_pairs

CONFIG_FILE: Final = "config.yaml"
SHOWN_METRICS: Final = {
    "repeatability": "keypoints found again within 3 px",
    "mma_3px": "matches within 3 px, by bits",
    "revisit_recall": "points that two images share and that match",
    "places_found": "places found again at full precision",
}
SHOWN_LOSSES: Final = ("detector", "contrastive", "triplet")
TRAFFIC: Final = {"bytes_down": "to the robots", "bytes_up": "from the robots"}


@dataclass(frozen=True, slots=True)
class FederatedJob:
    """The job of the server."""

    output: Path
    """Folder of the run; a run in it is continued."""
    settings: FederatedSettings
    start: Path | None = None
    """Checkpoint or exported detector to start from; None for the one that comes with fcslam."""
    public: Sequence[Path] = ()
    """Folders of images that the server may read; without any, the robots evaluate."""
    rules: RoundRules = RULES
    device: str = "cpu"
    """Name of a device in torch."""


def run_job(
    job: FederatedJob,
    fleet: TrainingFleet,
    *,
    on_round: Callable[[RoundReport], None] = lambda _report: None,
    on_release: Callable[[Weights], None] = lambda _weights: None,
    wait: Callable[[str], None] | None = None,
    evaluate_fn: EvaluateFn = lambda _weights: {},
) -> list[Path]:
    """Run a job, or continue it; returns the files for the user: detector, picture of the rounds, and model card.

    The functions are those of ``CoordinatorHooks``: ``on_release`` is called once the detector is written, and
    ``evaluate_fn`` is used without public images.
    """
    images = read_usable_images(job.public) if job.public else []
    encoder = job.settings.training.encoder
    _write_config(job, again=False)
    initial = prepare_initial_weights(job.start, job.output, encoder, images)

    def export(weights: Weights) -> None:
        export_onnx(weights_to_network(weights, encoder), job.output / DETECTOR)
        on_release(weights)

    evaluate = public_evaluation(images, encoder, job.device) if images else evaluate_fn
    hooks = CoordinatorHooks(partial(weights_version, encoder=encoder), evaluate, on_round, export, wait)
    state = Coordinator(fleet, job.settings, initial, job.output, hooks, job.rules).run()
    _write_config(job, again=True)
    judged_on = "on images of the robots, 4 % held out or one trained on; median of the robots"
    if job.rules.fewest_pairs is not None:
        judged_on = "on revisits that no robot trained on, mean"
    elif images:
        judged_on = "on pairs of public images"
    network = weights_to_network(state.best, encoder)
    return write_artifacts(network, job.output, "rounds.png", job.settings, _report(state, judged_on))


def _write_config(job: FederatedJob, again: bool) -> None:
    """Write the settings at the end, and at the start unless an earlier start has written them."""
    path = job.output / CONFIG_FILE
    with writing(job.output, "choose another output folder"):
        job.output.mkdir(parents=True, exist_ok=True)
        if again or not path.exists():
            path.write_text(dump(job.settings), encoding="utf-8")


def federate_locally(
    folders: Sequence[Path],
    job: FederatedJob,
    on_round: Callable[[RoundReport], None] = lambda _report: None,
    on_step: Callable[[str, int], None] = lambda _robot, _steps: None,
) -> list[Path]:
    """Run or continue federated training; returns the files for the user, see ``run_job``.

    ``folders`` hold the images of each robot, which has the name of its folder. ``on_step`` is called with a robot's
    name and the steps that it has done in the round.
    """
    for folder in folders:
        if not os.path.isdir(folder):
            raise InputError(f"{folder}: is not a folder; give one folder of images for each robot")
    names = [folder.resolve().name for folder in folders]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"two folders are called {min(twice)}; a robot has its folder's name, so rename one")
    clients = {
        name: ImageClient(name, job.output / "robots" / name, job.device, on_step, folder)
        for name, folder in zip(names, folders, strict=True)
    }

    def evaluate(weights: Weights) -> Mapping[str, Metrics]:
        found, failed = {}, []
        for name, client in clients.items():
            try:
                found[name] = client.evaluate(weights, job.settings.training)
            except FcslamError as error:
                failed.append(f"{name}: {error}")
        if not found:
            raise InputError(f"no version can be evaluated: {'; '.join(failed)}")
        return found

    return run_job(job, InProcessFleet(clients), on_round=on_round, evaluate_fn=evaluate)


def public_evaluation(images: Sequence[GreyImage], encoder: Encoder, device: str) -> EvaluateFn:
    """Evaluation of weights on pairs of views of these images, always the same pairs."""
    unlabelled = Labels(np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    pairs = validation_pairs([TrainingExample(image, unlabelled) for image in images])

    def evaluate(weights: Weights) -> Mapping[str, Metrics]:
        network = weights_to_network(weights, encoder).to(device)
        return {PUBLIC_IMAGES: validate(network, pairs, torch.device(device))}

    return evaluate


def _report(state: CoordinatorState, judged_on: str) -> TrainingReport:
    """What card and picture show; ``judged_on`` names the images of the evaluation."""
    rows = state.rows
    rounds = [int(row["round"]) for row in rows]
    best = next((row for row in rows if int(row["round"]) == state.best_round), {})
    asked = ", ".join(f"{robot} ({times})" for robot, times in sorted(state.times_asked.items()))
    sent = {label: [each / 1e6 for each in accumulate(_column(rows, name))] for name, label in TRAFFIC.items()}
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


def _column(rows: Sequence[Row], name: str) -> list[float]:
    return [float(row.get(name) or "nan") for row in rows]
