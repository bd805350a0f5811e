"""`fcslam evaluate places`: place recognition on folders of images or recordings with their truth."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.evaluate.arguments import SEED
from fcslam.cli.options import output_option
from fcslam.cli.output import EVALUATIONS, answers, new_folder, notices, print_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console
    from rich.table import Table

    from fcslam.cli.progress import ProgressDisplay
    from fcslam.lab.evaluation.places.report import SetResult
    from fcslam.metrics.bootstrap import Interval


def places(
    sets: Annotated[
        list[Path],
        typer.Argument(
            metavar="SETS...",
            help="Folders of images with their truth (dataset.csv, loop_pairs.txt, associations.txt or matches.csv), "
            "fleets with cameras that fcslam tools simulate wrote, or recordings of a LiDAR.",
        ),
    ],
    *,
    output: Annotated[
        Path | None, output_option("Folder for the table, the curves and the similarity matrices.", EVALUATIONS)
    ] = None,
    features: Annotated[
        str,
        typer.Option(
            help="Features of images: orb, onnx (the bundled network), an .onnx file, or a folder that `fcslam tools "
            "extract` wrote, with a subfolder for each set."
        ),
    ] = "orb",
    train_on: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of other images, to train the static vocabulary on. Can be repeated."),
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(help="Use only this label of sets with labels. Can be repeated.", show_default="all"),
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Also verify the geometry of the most similar places.")
    ] = False,
) -> None:
    """Measure recall, precision and mismatches of place recognition: each vocabulary strategy and brute force."""
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.lab.evaluation.places.report import curves_figure, save, write_results

    output = output or new_folder(EVALUATIONS)
    with ProgressDisplay(notices()) as display:
        results = _evaluate(sets, features, label or (), train_on or (), display, verify=verify)
    write_results(output, results)
    save(curves_figure(results), output / "precision_recall.png")
    _show(answers(), results, output)


def _evaluate(
    sets: "Sequence[Path]",
    features: str,
    labels: "Sequence[str]",
    train_on: "Sequence[Path]",
    display: "ProgressDisplay",
    *,
    verify: bool,
) -> "list[SetResult]":
    from fcslam.lab.evaluation.places.features import choose_features, describe_sets, describe_training
    from fcslam.lab.evaluation.places.report import evaluate_set
    from fcslam.lab.evaluation.places.scoring import choose_scorers
    from fcslam.lab.evaluation.places.verification import PairVerifier
    from fcslam.places.vocabulary import Strategy, VocabularyConfig

    chosen = choose_features(features)
    described_one = display.start("describing")
    training = describe_training(train_on, chosen, described_one)
    described = describe_sets(sets, labels, chosen, described_one)
    strategies = Strategy.STATIC, Strategy.WINDOWED, Strategy.INCREMENTAL
    scorers = choose_scorers(strategies, VocabularyConfig(), training, SEED)
    compared_one = display.start("comparing", len(scorers) * len(described))
    return [
        evaluate_set(each, scorers, PairVerifier(each) if verify else None, SEED, compared_one) for each in described
    ]


def _show(console: "Console", results: "Sequence[SetResult]", output: Path) -> None:
    for result in results:
        for question in result.place_set.questions:
            console.print(_table(result, question))
    lines = (
        "In brackets: 95 % intervals by bootstrap over queries. Recall at k: of the queries that have a match. AP and "
        "recall at 100 % precision: each query answers with its most similar place, or not at all.",
        "Mismatch: no match is more similar than the most similar wrong place. Relative significance: by how much "
        "it is more similar, as a share of its similarity.",
        f"Similarity matrices, curves and all intervals: {output}",
    )
    for line in lines:
        print_line(console, line)


def _table(result: "SetResult", question: str) -> "Table":
    from rich.table import Table

    scores = [score for score in result.scores if score.question == question]
    table = Table(title=f"{result.place_set.name}, {question}: {scores[0].queries} queries", title_justify="left")
    headings = ("", "recall at 1", "at 5", "at 10", "AP", "recall at 100 %", "mismatch rate", "relative significance")
    for heading in headings:
        table.add_column(heading)
    for score in scores:
        name = f"{score.scorer}, verified" if score.is_verified else score.scorer
        value = score.measures
        table.add_row(
            name,
            _interval(value["recall_at_1"]),
            _share(value["recall_at_5"].mean),
            _share(value["recall_at_10"].mean),
            _interval(value["average_precision"]),
            _share(value["recall_at_full_precision"].mean),
            _interval(value["mismatch_rate"]),
            _share(value["relative_significance"].mean),
        )
    return table


def _share(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3f}"


def _interval(value: "Interval") -> str:
    return "" if math.isnan(value.mean) else f"{value.mean:.3f} [{value.low:.2f}, {value.high:.2f}]"
