"""`fcslam evaluate`: measure runs, detectors and place recognition against references."""

import json
from pathlib import Path
from typing import Annotated

import typer

from fcslam.cli.options import Csv, examples, output_option
from fcslam.cli.output import EVALUATIONS, new_folder, notices
from fcslam.errors import EvaluationError
from fcslam.features.detector_kinds import EvaluatedDetectorKind

_FLEET = "fcslam evaluate fleet fleet/run --truth fleet"
_RELATIONS = "fcslam evaluate relations runs/intel intel.relations.gz"
RunFolder = Annotated[Path, typer.Argument(help="Run folder to measure.")]

app = typer.Typer(no_args_is_help=True)


@app.callback(epilog=examples(_FLEET, _RELATIONS))
def evaluate() -> None:
    """Measure runs, detectors and place recognition against references."""


@app.command(epilog=examples(_FLEET, "fcslam evaluate fleet demo/run --csv fleet.csv --figure fleet.png"))
def fleet(
    run: RunFolder,
    *,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Folder with ROBOT/ground_truth.tum or ROBOT.tum of each robot and, if known, the true map in "
            "ground_truth/map.yaml.",
            show_default="recordings beside the run, else the parent of the run",
        ),
    ] = None,
    csv: Csv = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="PNG file to draw: the robots' maps, matched places, the fused map and the truth."),
    ] = None,
) -> None:
    """Compare a run with the truth: trajectories, closures by channel and stage, joins, the map, and bytes sent."""
    from fcslam.cli.evaluate.fleet_tables import report_fleet
    from fcslam.cli.progress import ProgressDisplay

    report_fleet(run, truth, csv, notices())
    if figure is not None:
        from fcslam.lab.evaluation.fleet.charts import fleet_charts
        from fcslam.maps.fleet_figure import write_figure

        with ProgressDisplay(notices()) as display:
            display.start("drawing")
            write_figure(fleet_charts(run, truth), figure)


@app.command(epilog=examples(_RELATIONS, "fcslam evaluate relations runs/intel-3 intel.relations.gz --across-robots"))
def relations(
    run: RunFolder,
    reference: Annotated[
        Path, typer.Argument(metavar="RELATIONS", help="Relations file, plain or compressed by gzip or xz.")
    ],
    *,
    across_robots: Annotated[
        bool, typer.Option("--across-robots", help="Use only relations between stamps of different robots.")
    ] = False,
    parts: Annotated[
        Path | None,
        typer.Option(
            help="Run folder that assigns the stamps to robots. It lets you measure the run of one robot on the "
            "relations across the robots of another run.",
            show_default="RUN",
        ),
    ] = None,
    csv: Csv = None,
) -> None:
    """Measure a run by the relations metric of Kuemmerle et al. 2009: mean, standard deviation and maximum."""
    from fcslam.cli.evaluate.fleet_tables import show_relations
    from fcslam.lab.evaluation.fleet.relations import evaluate_relations, relation_metrics, write_metrics

    errors = evaluate_relations(run, reference, across_robots, parts)
    show_relations(errors, "relations across robots" if across_robots else "relations")
    if csv is not None:
        write_metrics(relation_metrics(errors), csv)


@app.command(epilog=examples("fcslam evaluate quality fleet/run"))
def quality(run: RunFolder) -> None:
    """Print how good the maps of a run are, by its certificate, and what to drive again."""
    from fcslam.runs import QUALITY, open_run

    content = open_run(run).quality.get(f"{QUALITY}.json")
    if content is None:
        raise EvaluationError(f"{run}: has no {QUALITY}.json; map the recordings again with this version")
    try:
        certificates = dict(json.loads(content))
    except (ValueError, TypeError) as error:
        raise EvaluationError(f"{run}: {QUALITY}.json is broken ({error})") from error
    for k, one in certificates.items():
        limit = one["bar"]
        good = sum(cell["bound_95"] <= limit for cell in one["cells"])
        typer.echo(f"map {k}: {good} of {len(one['cells'])} m2 are good to {limit:g} m within {one['within']:g} m")
        for stretch in one["open_stretches"]:
            typer.echo(
                f"map {k}: open: {stretch['robot']} for {stretch['length']:g} m from {stretch['from']} to "
                f"{stretch['to']}; the scans do not fix the motion along it"
            )
        for drive in one["drives"]:
            typer.echo(f"map {k}: {drive['text']}")


@app.command(
    epilog=examples(
        "fcslam evaluate homography hpatches --detector onnx --detector orb",
        "fcslam evaluate homography hpatches --detector features --csv pairs.csv",
    )
)
def homography(
    scenes: Annotated[
        list[Path], typer.Argument(metavar="SCENES...", help="Folders of scenes in the layout of HPatches.")
    ],
    *,
    detector: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|FILE|FOLDER",
            help="Evaluate only this detector: onnx, logits (the network's descriptors before they are bits), orb, "
            "sift, fast, harris or shi; the .onnx file of a network for onnx and logits; or a folder of extracted "
            "features, SCENE/1.npz ..., as `fcslam tools extract` writes them. Can be repeated.",
            show_default="all",
        ),
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="Write all measures of all pairs to this CSV file.")] = None,
) -> None:
    """Measure repeatability, homography accuracy, matching accuracy and matching score of detectors."""
    from fcslam.cli.evaluate.vision_tables import show_homography
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.lab.evaluation.detectors.evaluated_detectors import choose_detectors
    from fcslam.lab.evaluation.detectors.homography import evaluate_homography
    from fcslam.lab.evaluation.detectors.measures import write_pairs
    from fcslam.lab.evaluation.detectors.scenes import find_scenes
    from fcslam.metrics.homography import HomographyGroundTruth

    found = find_scenes(scenes)
    kinds = [EvaluatedDetectorKind(one) for one in detector or () if one in list(EvaluatedDetectorKind)]
    places = [Path(one) for one in detector or () if one not in list(EvaluatedDetectorKind)]
    weights = [place for place in places if place.suffix == ".onnx"]
    if weights and not set(kinds) & {EvaluatedDetectorKind.ONNX, EvaluatedDetectorKind.LOGITS}:
        kinds.append(EvaluatedDetectorKind.ONNX)
    detectors = choose_detectors(kinds, weights, [place for place in places if place.suffix != ".onnx"])
    with ProgressDisplay(notices()) as display:
        evaluated = display.start("evaluating", len(found) * len(detectors))
        report = evaluate_homography(found, detectors, HomographyGroundTruth.CORRECTED, evaluated)
    if csv is not None:
        write_pairs(report, csv)
    show_homography(report)


@app.command(
    epilog=examples(
        "fcslam evaluate places corridor tower",
        "fcslam evaluate places corridor --features onnx --train-on photos --verify",
    )
)
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
    from fcslam.cli.evaluate.vision_tables import SEED, show_places
    from fcslam.cli.progress import ProgressDisplay
    from fcslam.lab.evaluation.places.features import choose_features, describe_sets, describe_training
    from fcslam.lab.evaluation.places.report import curves_figure, evaluate_set, save, write_results
    from fcslam.lab.evaluation.places.scoring import choose_scorers
    from fcslam.lab.evaluation.places.verification import PairVerifier
    from fcslam.places.vocabulary import Strategy, VocabularyConfig

    output = output or new_folder(EVALUATIONS)
    with ProgressDisplay(notices()) as display:
        chosen, advance = choose_features(features), display.start("describing")
        training = describe_training(train_on or (), chosen, advance)
        described = describe_sets(sets, label or (), chosen, advance)
        strategies = Strategy.STATIC, Strategy.WINDOWED, Strategy.INCREMENTAL
        scorers = choose_scorers(strategies, VocabularyConfig(), training, SEED)
        advance = display.start("comparing", len(scorers) * len(described))
        results = [
            evaluate_set(each, scorers, PairVerifier(each) if verify else None, SEED, advance) for each in described
        ]
    write_results(output, results)
    save(curves_figure(results), output / "precision_recall.png")
    show_places(results, output)
