"""What `fcslam evaluate homography` and `places` print."""

import math
from collections.abc import Sequence
from pathlib import Path

import typer
from rich.table import Table

from fcslam.cli.output import answers
from fcslam.lab.evaluation.detectors.homography import LARGE, MATCHING_NMS_PX, SMALL, HomographyReport
from fcslam.lab.evaluation.detectors.measures import CORRECT_CORNERS_PX, difference, interval, mean
from fcslam.lab.evaluation.detectors.scenes import SceneKind
from fcslam.lab.evaluation.places.report import SetResult
from fcslam.metrics.bootstrap import Interval

SEED = 1
"""Seed of all random draws, bootstrap included."""
_KINDS = SceneKind.ILLUMINATION, SceneKind.VIEWPOINT
_DIFFERENCES = {
    "repeatability": "repeatability",
    **{f"homography_3px_nms{nms}": f"homography e=3, NMS {nms}" for nms in (8, 0)},
    **{f"accuracy_3px_nms{nms}": f"MMA@3, NMS {nms}" for nms in (8, 0)},
}
_BY_SCENE = _DIFFERENCES | {f"score_nms{nms}": f"score, NMS {nms}" for nms in (8, 0)}
"""Measures, and what their columns are called."""


def show_homography(report: HomographyReport) -> None:
    """Print the report as tables, and the definitions behind them."""
    described = [name for name in report.detectors if report.of(name)[0].matching]
    console = answers()
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
        typer.echo(line)


def show_places(results: Sequence[SetResult], output: Path) -> None:
    """Print a table for each question of each set, the definitions behind them, and where the rest is."""
    console = answers()
    for result in results:
        for question in result.place_set.questions:
            console.print(_place_table(result, question))
    for line in (
        "In brackets: 95 % intervals by bootstrap over queries. Recall at k: of the queries that have a match. AP and "
        "recall at 100 % precision: each query answers with its most similar place, or not at all.",
        "Mismatch: no match is more similar than the most similar wrong place. Relative significance: by how much "
        "it is more similar, as a share of its similarity.",
        f"Similarity matrices, curves and all intervals: {output}",
    ):
        typer.echo(line)


def _repeatability_table(report: HomographyReport) -> Table:
    headings = ("", "illumination", "viewpoint", "all", "localization error, px", "ms 320x240", "ms 640x480")
    table = _table("I. Repeatability", headings)
    for name in report.detectors:
        pairs = report.of(name)
        table.add_row(
            name,
            *(_number(mean(pairs, "repeatability", kind)) for kind in _KINDS),
            _interval(interval(pairs, "repeatability", SEED)),
            _number(mean(pairs, "localization_error_px"), 2),
            *(_number(report.milliseconds.get((name, size), math.nan), 1) for size in (SMALL, LARGE)),
        )
    return table


def _homography_table(report: HomographyReport, described: Sequence[str]) -> Table:
    all_kinds = [f"all, e={px}" for px in CORRECT_CORNERS_PX]
    table = _table("II. Homography estimation", ("", "NMS", "illumination, e=3", "viewpoint, e=3", *all_kinds))
    for nms_px in MATCHING_NMS_PX:
        for name in described:
            pairs = report.of(name)
            kinds = (mean(pairs, f"homography_3px_nms{nms_px}", kind) for kind in _KINDS)
            shares = (interval(pairs, f"homography_{px}px_nms{nms_px}", SEED) for px in CORRECT_CORNERS_PX)
            table.add_row(name, str(nms_px), *map(_number, kinds), *map(_interval, shares))
        table.add_section()
    return table


def _matching_table(report: HomographyReport, described: Sequence[str]) -> Table:
    accuracy = ("MMA@1", "MMA@3", "MMA@5", "MMA@10", "illumination MMA@3", "viewpoint MMA@3")
    table = _table("Matching", ("", "NMS", *accuracy, "matching score", "matches"))
    for nms_px in MATCHING_NMS_PX:
        for name in described:
            pairs = report.of(name)
            shares = [mean(pairs, f"accuracy_{px}px_nms{nms_px}") for px in (1, 3, 5, 10)]
            shares += [mean(pairs, f"accuracy_3px_nms{nms_px}", kind) for kind in _KINDS]
            shares.append(mean(pairs, f"score_nms{nms_px}"))
            table.add_row(name, str(nms_px), *map(_number, shares), _number(mean(pairs, f"matches_nms{nms_px}"), 0))
        table.add_section()
    return table


def _scene_table(report: HomographyReport) -> Table:
    table = _table("Scene by scene", ("scene", "", *_BY_SCENE.values()))
    for scene in dict.fromkeys(pair.scene for pair in report.pairs):
        for name in report.detectors:
            pairs = [pair for pair in report.of(name) if pair.scene == scene]
            table.add_row(scene, name, *(_number(mean(pairs, measure)) for measure in _BY_SCENE))
        table.add_section()
    return table


def _difference_table(report: HomographyReport) -> Table:
    first, *others = report.detectors
    table = _table(f"{first} less the others, pair by pair", ("", *_DIFFERENCES.values()))
    for name in others:
        gains = (difference(report.of(first), report.of(name), measure, SEED) for measure in _DIFFERENCES)
        table.add_row(name, *(_interval(gain, sign="+") for gain in gains))
    return table


def _place_table(result: SetResult, question: str) -> Table:
    scores = [score for score in result.scores if score.question == question]
    headings = ("", "recall at 1", "at 5", "at 10", "AP", "recall at 100 %", "mismatch rate", "relative significance")
    table = _table(f"{result.place_set.name}, {question}: {scores[0].queries} queries", headings)
    for score in scores:
        value = score.measures
        table.add_row(
            f"{score.scorer}, verified" if score.is_verified else score.scorer,
            _interval(value["recall_at_1"]),
            _number(value["recall_at_5"].mean),
            _number(value["recall_at_10"].mean),
            _interval(value["average_precision"]),
            _number(value["recall_at_full_precision"].mean),
            _interval(value["mismatch_rate"]),
            _number(value["relative_significance"].mean),
        )
    return table


def _table(title: str, headings: Sequence[str]) -> Table:
    return Table(*headings, title=title, title_justify="left")


def _number(value: float, digits: int = 3) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _interval(value: Interval, sign: str = "") -> str:
    if math.isnan(value.mean):
        return ""
    return f"{value.mean:{sign}.3f} [{value.low:{sign}.2f}, {value.high:{sign}.2f}]"
