"""`fcslam evaluate homography`: detectors and descriptors on scenes with known homographies."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cli.evaluate.arguments import SEED
from fcslam.cli.output import answers, notices, print_line
from fcslam.features.detector_kinds import EvaluatedDetectorKind

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console
    from rich.table import Table

    from fcslam.lab.evaluation.detectors.homography import HomographyReport, PairResult
    from fcslam.metrics.bootstrap import Interval


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
    _show(answers(), report)


def _show(console: "Console", report: "HomographyReport") -> None:
    described = [name for name in report.detectors if report.of(name)[0].matching]
    console.print(_repeatability_table(report))
    if described:
        console.print(_homography_table(report, described))
        console.print(_matching_table(report, described))
    console.print(_scene_table(report))
    if len(report.detectors) > 1:
        console.print(_difference_table(report))
    for line in (
        f"{len(report.of(report.detectors[0]))} pairs. In brackets: 95 % intervals by bootstrap over pairs.",
        "Repeatability at 320 x 240, NMS 4, of the 300 strongest keypoints in common view; correct to 3 px.",
        "Homography at 640 x 480 by mutual nearest neighbours among the 1000 strongest in common view, RANSAC at 3 px: "
        "share of pairs whose corners are right to e px on average.",
        "MMA: share of the matches within a limit in px, mean over pairs; matching score: share of the keypoints in "
        "common view whose nearest neighbour is right to 3 px; both of the 1000 strongest of each image.",
        "NMS 0: keypoints as the detector gives them. ...-logits: the network's own, compared by the cosine of their "
        "logits instead of by bits.",
        "Times: processor time on one thread, from grey levels to described keypoints.",
    ):
        print_line(console, line)


def _repeatability_table(report: "HomographyReport") -> "Table":
    from rich.table import Table

    from fcslam.lab.evaluation.detectors.homography import LARGE, SMALL
    from fcslam.lab.evaluation.detectors.measures import interval, mean
    from fcslam.lab.evaluation.detectors.scenes import SceneKind

    table = Table(title="I. Repeatability", title_justify="left")
    for heading in ("", "illumination", "viewpoint", "all", "localization error, px", "ms 320x240", "ms 640x480"):
        table.add_column(heading)
    for name in report.detectors:
        pairs = report.of(name)
        kinds = (mean(pairs, "repeatability", kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT))
        times = (report.milliseconds.get((name, size), math.nan) for size in (SMALL, LARGE))
        table.add_row(
            name,
            *map(_share, kinds),
            _interval(interval(pairs, "repeatability", SEED)),
            _number(mean(pairs, "localization_error_px"), 2),
            *(_number(time, 1) for time in times),
        )
    return table


def _homography_table(report: "HomographyReport", described: "Sequence[str]") -> "Table":
    from rich.table import Table

    from fcslam.lab.evaluation.detectors.homography import MATCHING_NMS_PX
    from fcslam.lab.evaluation.detectors.measures import CORRECT_CORNERS_PX, interval, mean
    from fcslam.lab.evaluation.detectors.scenes import SceneKind

    table = Table(title="II. Homography estimation", title_justify="left")
    for heading in ("", "NMS", "illumination, e=3", "viewpoint, e=3", *(f"all, e={px}" for px in CORRECT_CORNERS_PX)):
        table.add_column(heading)
    for nms_px in MATCHING_NMS_PX:
        for name in described:
            pairs = report.of(name)
            measure = f"homography_3px_nms{nms_px}"
            kinds = (mean(pairs, measure, kind) for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT))
            shares = (interval(pairs, f"homography_{px}px_nms{nms_px}", SEED) for px in CORRECT_CORNERS_PX)
            table.add_row(name, str(nms_px), *map(_share, kinds), *map(_interval, shares))
        table.add_section()
    return table


def _matching_table(report: "HomographyReport", described: "Sequence[str]") -> "Table":
    from rich.table import Table

    from fcslam.lab.evaluation.detectors.homography import MATCHING_NMS_PX
    from fcslam.lab.evaluation.detectors.measures import mean
    from fcslam.lab.evaluation.detectors.scenes import SceneKind

    table = Table(title="Matching", title_justify="left")
    accuracy = ("MMA@1", "MMA@3", "MMA@5", "MMA@10", "illumination MMA@3", "viewpoint MMA@3")
    for heading in ("", "NMS", *accuracy, "matching score", "matches"):
        table.add_column(heading)
    for nms_px in MATCHING_NMS_PX:
        for name in described:
            pairs = report.of(name)
            shares = [mean(pairs, f"accuracy_{px}px_nms{nms_px}") for px in (1, 3, 5, 10)]
            for kind in (SceneKind.ILLUMINATION, SceneKind.VIEWPOINT):
                shares.append(mean(pairs, f"accuracy_3px_nms{nms_px}", kind))
            shares.append(mean(pairs, f"score_nms{nms_px}"))
            table.add_row(name, str(nms_px), *map(_share, shares), _number(mean(pairs, f"matches_nms{nms_px}"), 0))
        table.add_section()
    return table


def _scene_table(report: "HomographyReport") -> "Table":
    from rich.table import Table

    from fcslam.lab.evaluation.detectors.measures import mean

    titles = {
        "repeatability": "repeatability",
        **{f"homography_3px_nms{nms}": f"homography e=3, NMS {nms}" for nms in (8, 0)},
        **{f"accuracy_3px_nms{nms}": f"MMA@3, NMS {nms}" for nms in (8, 0)},
        **{f"score_nms{nms}": f"score, NMS {nms}" for nms in (8, 0)},
    }
    table = Table("scene", "", *titles.values(), title="Scene by scene", title_justify="left")
    for scene in dict.fromkeys(pair.scene for pair in report.pairs):
        for name in report.detectors:
            pairs: list[PairResult] = [pair for pair in report.of(name) if pair.scene == scene]
            table.add_row(scene, name, *(_share(mean(pairs, measure)) for measure in titles))
        table.add_section()
    return table


def _difference_table(report: "HomographyReport") -> "Table":
    from rich.table import Table

    from fcslam.lab.evaluation.detectors.measures import difference

    first, *others = report.detectors
    titles = {
        "repeatability": "repeatability",
        **{f"homography_3px_nms{nms}": f"homography e=3, NMS {nms}" for nms in (8, 0)},
        **{f"accuracy_3px_nms{nms}": f"MMA@3, NMS {nms}" for nms in (8, 0)},
    }
    table = Table("", *titles.values(), title=f"{first} less the others, pair by pair", title_justify="left")
    for name in others:
        gains = (difference(report.of(first), report.of(name), measure, SEED) for measure in titles)
        table.add_row(name, *(_interval(gain, sign="+") for gain in gains))
    return table


def _share(value: float) -> str:
    return _number(value, 3)


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _interval(value: "Interval", sign: str = "") -> str:
    if math.isnan(value.mean):
        return ""
    return f"{value.mean:{sign}.3f} [{value.low:{sign}.2f}, {value.high:{sign}.2f}]"
