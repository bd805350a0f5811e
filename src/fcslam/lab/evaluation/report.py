"""Evaluates a run folder against the ground truth: trajectories, closures, joins, the map, and the traffic."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from fcslam.lab.evaluation.closures import FleetClosures, FleetClosureScore, score_closures
from fcslam.lab.evaluation.ground_truth import TRUE_MAP, KnownPoses, known_poses, labelled, truth_folder
from fcslam.lab.evaluation.relations import relation_metrics
from fcslam.maps.ros_map import read_ros_map
from fcslam.metrics.closures import WRONG_DEG, WRONG_M, Mask, Recall
from fcslam.metrics.grid import GridAgreement, grid_agreement
from fcslam.metrics.relations import RelationErrors
from fcslam.metrics.trajectory import (
    PositionErrors,
    align,
    near_pairs,
    placement_error,
    position_errors,
    relative_errors,
)
from fcslam.records import PLACE_CHANNELS, Channel, FloatArray
from fcslam.runs import Metric, Run, open_run


@dataclass(frozen=True, slots=True)
class RobotScore:
    """Scores of one robot's trajectory, and its traffic."""

    robot: str
    map_index: int
    poses: int
    """Laser scans in the run."""
    covered: int
    """Laser scans with a true pose."""
    joint: PositionErrors
    """ATE after alignment of the robot's whole map with the truth."""
    alone: PositionErrors
    """ATE after alignment of this robot's trajectory with the truth."""
    path_length_m: float
    """Length of the true path."""
    duration_s: float
    uplink_bytes: float
    """NaN if the run does not have it."""


@dataclass(frozen=True, slots=True)
class EvaluatedJoin:
    """Two robots in one map."""

    robot_a: str
    robot_b: str
    translation_m: float
    """Relative error of both robots, translation."""
    rotation_deg: float
    """Relative error of both robots, rotation."""

    @property
    def is_false(self) -> bool:
        """Whether the relative error exceeds the thresholds of a wrong closure, or cannot be measured (NaN)."""
        return not (self.translation_m <= WRONG_M and self.rotation_deg <= WRONG_DEG)


@dataclass(frozen=True, slots=True)
class FleetReport:
    """Scores of a run against the ground truth."""

    truth: Path
    """Folder of the ground truth."""
    robots: tuple[RobotScore, ...]
    maps: int
    joins: tuple[EvaluatedJoin, ...]
    """All pairs of robots in one map."""
    within: RelationErrors
    """Errors of relative poses of one robot."""
    across: RelationErrors
    """Errors of relative poses of different robots; pairs in different maps are unusable."""
    closures: FleetClosures
    agreement: GridAgreement | None
    """Agreement of the first map with the true map; None without a true map."""
    places: Mapping[Channel, tuple[float, float]]
    """Packets and bytes of places; NaN if the run does not have them."""

    @property
    def false_joins(self) -> tuple[EvaluatedJoin, ...]:
        """Joins with a relative error above the thresholds, or without one."""
        return tuple(join for join in self.joins if join.is_false)


def evaluate_fleet(run: Path, truth: Path | None = None) -> FleetReport:
    """Evaluate the run folder ``run`` against the ground truth in a folder, by default that of ``truth_folder``."""
    opened, folder = open_run(run), truth_folder(run, truth)
    known = estimate, true = known_poses(opened, folder)
    alignments = {k: align(*_poses(known, estimate.maps == k)) for k in np.unique(estimate.maps).tolist()}
    rng = np.random.default_rng(0)
    figures = {name: metric.value for name, metric in opened.metrics.items()}
    return FleetReport(
        truth=folder,
        robots=_robot_scores(opened, known, alignments, figures),
        maps=len(alignments),
        joins=_joins(opened, known),
        within=relative_errors(near_pairs(true, rng, across_robots=False), true, estimate),
        across=relative_errors(near_pairs(true, rng, across_robots=True), true, estimate),
        closures=score_closures(opened, true),
        agreement=_agreement(run, folder, alignments),
        places={channel: _place_traffic(channel, figures) for channel in PLACE_CHANNELS},
    )


def _poses(known: KnownPoses, rows: Mask) -> tuple[FloatArray, FloatArray]:
    """``T_truth_base`` and ``T_map_base`` (N, 3) of the rows that ``rows`` (M,) selects."""
    estimate, truth = known
    return truth.T_map_base[rows], estimate.T_map_base[rows]


def _robot_scores(
    run: Run, known: KnownPoses, alignments: Mapping[int, FloatArray], figures: Mapping[str, float]
) -> tuple[RobotScore, ...]:
    scores = []
    for number, trajectory in enumerate(run.trajectories.values()):
        true, estimated = _poses(known, known[1].robots == number)
        joint, alone = alignments[trajectory.map_index], align(true, estimated)
        scores.append(
            RobotScore(
                robot=trajectory.robot,
                map_index=trajectory.map_index,
                poses=len(trajectory.stamps),
                covered=len(true),
                joint=PositionErrors.of(position_errors(joint, true, estimated)),
                alone=PositionErrors.of(position_errors(alone, true, estimated)),
                path_length_m=float(np.hypot(*np.diff(true[:, :2], axis=0).T).sum()),
                duration_s=float(np.ptp(trajectory.stamps)),
                uplink_bytes=figures.get(f"uplink_bytes_{trajectory.robot}", np.nan),
            )
        )
    return tuple(scores)


def _joins(run: Run, known: KnownPoses) -> tuple[EvaluatedJoin, ...]:
    tracks = [_poses(known, known[1].robots == number) for number in range(len(run.trajectories))]
    robots = list(zip(run.trajectories.values(), tracks, strict=True))
    return tuple(
        EvaluatedJoin(a.robot, b.robot, *placement_error(track_a, track_b))
        for (a, track_a), (b, track_b) in combinations(robots, 2)
        if a.map_index == b.map_index
    )


def _agreement(run: Path, folder: Path, alignments: Mapping[int, FloatArray]) -> GridAgreement | None:
    if not (folder / TRUE_MAP).is_file():
        return None
    drawn, true = (labelled(read_ros_map(place)) for place in (run / "map.yaml", folder / TRUE_MAP))
    return grid_agreement(drawn, true, alignments[0])


def _place_traffic(channel: Channel, figures: Mapping[str, float]) -> tuple[float, float]:
    return figures.get(f"{channel}_place_packets", np.nan), figures.get(f"{channel}_place_bytes", np.nan)


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
    if report.agreement is not None:
        shares = ("precision", "recall", "f1", "free_iou")
        metrics += [Metric(f"map_{share}", getattr(report.agreement, share), "1") for share in shares]
    for place_channel, (packets, size) in report.places.items():
        metrics.append(Metric(f"{place_channel}_places", packets, "1"))
        metrics.append(Metric(f"{place_channel}_place_bytes", size, "B"))
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
