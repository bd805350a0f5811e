"""Charts of a run and its ground truth: every robot's own map, the fused map, the building, and matched places."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fcslam.errors import InputError
from fcslam.lab.evaluation.ground_truth import TRUE_MAP, KnownPoses, known_poses, labelled, truth_folder
from fcslam.maps.ros_map import read_ros_map
from fcslam.metrics.trajectory import align
from fcslam.records import ClosureStatus, FloatArray
from fcslam.runs import LOCAL, ClosureRow, LocalMap, Run, open_run

from .fleet_figure import IDENTITY, Chart, FleetCharts, MatchedPlaces


def fleet_charts(run: Path, truth: Path | None = None) -> FleetCharts:
    """Make the charts of a run folder and its ground truth.

    Without ``truth`` it searches for the truth like ``evaluate_fleet``.

    Raises:
        InputError: the run has no maps of single robots, or the truth of a robot or the true map is missing.
    """
    opened, folder = open_run(run), truth_folder(run, truth)
    known = _, true = known_poses(opened, folder)
    if not opened.local_maps:
        raise InputError(f"{run}: has no {LOCAL}/ with the robots' own maps; map the recordings again")
    return FleetCharts(
        local={
            robot: Chart(labelled(read_ros_map(run / LOCAL / f"{robot}.yaml")), {robot: local.T_local_base})
            for robot, local in opened.local_maps.items()
        },
        fused=_fused_chart(run, opened, known),
        building=Chart(
            labelled(read_ros_map(folder / TRUE_MAP)),
            {robot: true.T_map_base[true.robots == k] for k, robot in enumerate(opened.local_maps)},
        ),
        matches=_matches(opened),
    )


def _fused_chart(run: Path, opened: Run, known: KnownPoses) -> Chart:
    estimate, true = known
    members = estimate.maps == 0
    T_building_map = align(true.T_map_base[members], estimate.T_map_base[members])
    x, y, theta = T_building_map if np.isfinite(T_building_map).all() else IDENTITY
    trajectories = {t.robot: t.T_map_base for t in opened.trajectories.values() if t.map_index == 0}
    return Chart(labelled(read_ros_map(run / "map.yaml")), trajectories, (float(x), float(y), float(theta)))


def _matches(run: Run) -> list[MatchedPlaces]:
    return [
        _match(closure, run.local_maps)
        for closure in run.closures
        if closure.status in (ClosureStatus.ACCEPTED, ClosureStatus.VERIFIED) and closure.robot_i != closure.robot_j
    ]


def _match(closure: ClosureRow, local: Mapping[str, LocalMap]) -> MatchedPlaces:
    """Both ends of a closure, ordered by the robots' names."""
    ends = sorted([(closure.robot_i, closure.stamp_i), (closure.robot_j, closure.stamp_j)])
    (robot_i, xy_i), (robot_j, xy_j) = ((robot, _position(local[robot], stamp)) for robot, stamp in ends)
    return MatchedPlaces(robot_i, xy_i, robot_j, xy_j, closure.channel, closure.status is ClosureStatus.ACCEPTED)


def _position(local: LocalMap, stamp: float) -> FloatArray:
    """Position (2,) at the scan nearest to ``stamp``; stamps may step back."""
    return np.asarray(local.T_local_base[np.argmin(np.abs(local.stamps - stamp)), :2])
