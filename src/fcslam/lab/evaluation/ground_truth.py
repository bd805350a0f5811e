"""Reads the ground truth of a fleet, simulated or measured: true poses and the true map, in one coordinate frame.

The true poses of a robot are a TUM file, `<folder>/<robot>/ground_truth.tum` or `<folder>/<robot>.tum`. The true map is
`<folder>/ground_truth/map.yaml`, in the format of ROS map_server.
"""

from pathlib import Path

import numpy as np

from fcslam.errors import InputError
from fcslam.lab.evaluation.relations import pose_table
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap
from fcslam.metrics.grid import LabelledGrid
from fcslam.metrics.relations import PoseTable
from fcslam.metrics.trajectory import interpolate
from fcslam.records import FloatArray, frozen
from fcslam.runs import RobotTrajectory, Run, read_tum

GAP_S = 0.25
"""Longest gap between true poses that is interpolated."""

LEAST_COVERED = 0.5
"""Smallest share of a robot's scans with a true pose. With fewer, the truth is probably of another recording."""

TRUE_MAP = Path("ground_truth", "map.yaml")


KnownPoses = tuple[PoseTable, PoseTable]
"""Estimated poses of a run where the truth is known; and the true ones, row by row, in its frame, which is one map."""


def truth_folder(run: Path, named: Path | None) -> Path:
    """Folder of the ground truth of a run: ``named`` if given, else ``recordings`` beside the run, else its parent."""
    beside = run.resolve().parent / "recordings"
    folder = named or (beside if beside.is_dir() else run.resolve().parent)
    if not folder.is_dir():
        raise InputError(f"{folder}: no folder with the truth; name one with --truth")
    return folder


def known_poses(run: Run, folder: Path) -> KnownPoses:
    """Interpolate the true poses at the stamps of a run."""
    if not run.trajectories:
        raise InputError("the run has no robot, so there is nothing to compare with the truth")
    estimate = pose_table(run)
    true = np.empty_like(estimate.T_map_base)
    for number, trajectory in enumerate(run.trajectories.values()):
        rows = estimate.robots == number
        true[rows] = _true_poses(trajectory, estimate.stamps[rows], folder)
    known = np.isfinite(true[:, 0])
    stamps, robots = estimate.stamps[known], estimate.robots[known]
    found = PoseTable.of(stamps, estimate.T_map_base[known], robots, estimate.maps[known])
    return found, PoseTable.of(stamps, true[known], robots)


def labelled(seen: OccupancyMap) -> LabelledGrid:
    """The grid of a map, in the map's frame."""
    corner: FloatArray = frozen(np.array([*seen.origin_xy, 0.0]))
    return LabelledGrid(seen.cells == Occupancy.OCCUPIED, seen.cells == Occupancy.FREE, seen.resolution_m, corner)


def _true_poses(trajectory: RobotTrajectory, stamps: FloatArray, folder: Path) -> FloatArray:
    """True poses (N, 3) at ``stamps`` (N,); NaN if unknown."""
    places = folder / trajectory.robot / "ground_truth.tum", folder / f"{trajectory.robot}.tum"
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise InputError(
            f"{folder}: no truth of '{trajectory.robot}', neither {places[0].relative_to(folder)} nor "
            f"{places[1].name}; name the folder that has it with --truth"
        )
    known, poses = read_tum(path)
    if not len(known):
        raise InputError(f"{path}: empty, so where '{trajectory.robot}' was is not known")
    true = interpolate(known, poses, stamps, GAP_S)
    covered = int(np.isfinite(true[:, 0]).sum())
    if covered < max(LEAST_COVERED * len(stamps), 1):
        raise InputError(
            f"{path}: has poses at only {covered} of the {len(stamps)} scans of '{trajectory.robot}'; "
            "is it the truth of another recording?"
        )
    return true
