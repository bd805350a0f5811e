"""What `fcslam evaluate fleet` and `relations` print: tables, and sentences."""

import math
from collections.abc import Iterator

from rich.table import Table

from fcslam.lab.evaluation.closures import BOTH, ClosureScope
from fcslam.lab.evaluation.report import FleetReport
from fcslam.metrics.relations import RelationErrors

_KINDS = {"intra_robot": "within robots", "inter_robot": "between robots"}


def fleet_tables(report: FleetReport) -> list[Table]:
    """The tables of robots, relative poses, closures and traffic."""
    closures = (_closures(report, within) for within in ClosureScope)
    return [_robots(report), _relative(report), *closures, _traffic(report)]


def relations_table(errors: RelationErrors, what: str) -> Table:
    """Errors by the relations metric; ``what`` was measured."""
    table = Table("error", "mean", "std", "max", caption=f"{errors.used} of {errors.total} {what} used")
    for name, spread, digits in (("translation, m", errors.translation, 4), ("rotation, deg", errors.rotation, 3)):
        table.add_row(name, *(f"{value:.{digits}f}" for value in (spread.mean, spread.std, spread.maximum)))
    return table


def _percent(share: float) -> str:
    """In tenths of a percent, never rounded up to all."""
    return "-" if math.isnan(share) else f"{math.floor(1000.0 * share) / 10.0:.1f}%"


def _robots(report: FleetReport) -> Table:
    table = Table("robot", "map", "path, m", "ATE, m", "mean", "max", "aligned alone")
    for score in report.robots:
        errors = (score.joint.rmse_m, score.joint.mean_m, score.joint.max_m, score.alone.rmse_m)
        cells = (_number(score.path_length_m, 1), *(_number(error, 3) for error in errors))
        table.add_row(score.robot, str(score.map_index), *cells)
    return table


def _relative(report: FleetReport) -> Table:
    table = Table("relative poses", "pairs", "in one map", "mean, m", "max, m", "mean, deg", "max, deg")
    for name, errors in (("within robots", report.within), ("across robots", report.across)):
        metres, degrees = errors.translation, errors.rotation
        figures = (metres.mean, metres.maximum, degrees.mean, degrees.maximum)
        table.add_row(name, str(errors.total), str(errors.used), *(_number(figure, 3) for figure in figures))
    return table


def _closures(report: FleetReport, within: ClosureScope) -> Table:
    """Table of the channels that closed something, and of both together if both did."""
    table = Table(_KINDS[within], "channel", "all", "wrong", "precision", "recall", "like heading", "at 100 %")
    scores = {(status, channel): score for (kind, status, channel), score in report.closures.items() if kind is within}
    seen = {channel for (_, channel), score in scores.items() if channel != BOTH and score.precision.closures}
    for (status, channel), score in scores.items():
        if channel in seen or (channel == BOTH and len(seen) != 1):
            found, recalls = score.precision, (score.recall, score.recall_like_heading, score.recall_full_precision)
            shares = (found.precision, *(each.recall for each in recalls))
            table.add_row(str(status), channel, str(found.closures), str(found.wrong), *map(_percent, shares))
    return table


def _traffic(report: FleetReport) -> Table:
    table = Table("sent", "kB", "kB/s", "kB/m", "places", "kB a place")
    for score in report.robots:
        kilobytes = score.uplink_bytes / 1e3
        rates = (_ratio(kilobytes, score.duration_s), _ratio(kilobytes, score.path_length_m))
        table.add_row(score.robot, _number(kilobytes, 1), *(_number(rate, 2) for rate in rates))
    for channel, (packets, size) in report.places.items():
        kilobytes = size / 1e3
        each = _number(_ratio(kilobytes, packets), 2)
        table.add_row(f"{channel} places, all", _number(kilobytes, 1), "", "", _number(packets, 0), each)
    return table


def findings(report: FleetReport) -> Iterator[str]:
    """What the tables do not say: the truth, the maps and their joins, and how well the map agrees."""
    scans, covered = (sum(counts) for counts in zip(*((s.poses, s.covered) for s in report.robots), strict=True))
    yield f"Truth: {report.truth}, at {covered} of {scans} scans. What the columns mean: docs/howto/evaluation.md"
    yield f"Maps: {report.maps}. Pairs of robots in one map: {len(report.joins)}, of them falsely joined: " + (
        ", ".join(f"{j.robot_a} and {j.robot_b} ({j.translation_m:.2f} m, {j.rotation_deg:.1f} deg)" for j in false)
        if (false := report.false_joins)
        else "none."
    )
    if report.agreement is None:
        yield f"Map: not compared, {report.truth} has no ground_truth/map.yaml."
        return
    found = report.agreement
    yield (
        f"Map: F1 of occupied cells {_number(found.f1, 3)} (precision {_number(found.precision, 3)}, recall "
        f"{_number(found.recall, 3)}), IoU of free space {_number(found.free_iou, 3)}."
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"
