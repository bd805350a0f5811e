"""The metrics of a fleet report by name, for tables and programs."""

from dataclasses import asdict

from fcslam.lab.evaluation.fleet.closures import FleetClosureScore
from fcslam.lab.evaluation.fleet.relations import relation_metrics
from fcslam.lab.evaluation.fleet.report import FleetReport, RobotScore
from fcslam.metrics.closures import Recall
from fcslam.metrics.relations import RelationErrors
from fcslam.runs import Metric


def fleet_metrics(report: FleetReport) -> tuple[Metric, ...]:
    """List the metrics of a report. Unknown values are NaN; metrics of the map are missing without a true map."""
    metrics = [
        Metric("robots", len(report.robots), "1"),
        Metric("maps", report.maps, "1"),
        Metric("joins", len(report.joins), "1"),
        Metric("false_joins", len(report.false_joins), "1"),
        Metric("worst_join_translation_error", max((join.translation_m for join in report.joins), default=0.0), "m"),
        Metric("worst_join_rotation_error", max((join.rotation_deg for join in report.joins), default=0.0), "deg"),
    ]
    for robot in report.robots:
        metrics += _robot_metrics(robot)
    metrics += _relative_metrics("within_robots", report.within) + _relative_metrics("across_robots", report.across)
    for (within, status, channel), score in report.closures.items():
        metrics += _closure_metrics(f"{within}_{status}_{channel}", score)
    for status, views in report.views.items():
        counts = asdict(views).items()
        metrics += [Metric(f"inter_robot_{status}_camera_views_{name}", count, "1") for name, count in counts]
    if report.agreement is not None:
        shares = ("precision", "recall", "f1", "free_iou")
        metrics += [Metric(f"map_{share}", getattr(report.agreement, share), "1") for share in shares]
    for place_channel, traffic in report.places.items():
        metrics.append(Metric(f"{place_channel}_places", traffic.packets, "1"))
        metrics.append(Metric(f"{place_channel}_place_bytes", traffic.bytes, "B"))
    return tuple(metrics)


def _robot_metrics(score: RobotScore) -> list[Metric]:
    name = score.robot
    errors = [("ate", score.joint), ("ate_alone", score.alone)]
    return [
        *(Metric(f"{kind}_rmse_{name}", found.rmse_m, "m") for kind, found in errors),
        *(Metric(f"{kind}_mean_{name}", found.mean_m, "m") for kind, found in errors),
        *(Metric(f"{kind}_max_{name}", found.max_m, "m") for kind, found in errors),
        Metric(f"map_of_{name}", score.map_index, "1"),
        Metric(f"scans_{name}", score.poses, "1"),
        Metric(f"scans_with_truth_{name}", score.covered, "1"),
        Metric(f"path_length_{name}", score.path_length_m, "m"),
        Metric(f"duration_{name}", score.duration_s, "s"),
        Metric(f"uplink_bytes_{name}", score.uplink_bytes, "B"),
    ]


def _relative_metrics(name: str, errors: RelationErrors) -> list[Metric]:
    return [Metric(f"{name}_{metric.name}", metric.value, metric.unit) for metric in relation_metrics(errors)]


def _closure_metrics(name: str, score: FleetClosureScore) -> list[Metric]:
    found = score.precision
    return [
        Metric(f"{name}_closures", found.closures, "1"),
        Metric(f"{name}_covered", found.covered, "1"),
        Metric(f"{name}_wrong", found.wrong, "1"),
        Metric(f"{name}_precision", found.precision, "1"),
        *_recall_metrics(name, "", score.recall),
        *_recall_metrics(name, "_like_heading", score.recall_like_heading),
        *_recall_metrics(name, "_full_precision", score.recall_full_precision),
    ]


def _recall_metrics(name: str, which: str, found: Recall) -> list[Metric]:
    return [
        Metric(f"{name}_revisits{which}", found.revisits, "1"),
        Metric(f"{name}_revisits_found{which}", found.found, "1"),
        Metric(f"{name}_recall{which}", found.recall, "1"),
    ]
