"""A run's certificate against the truth: are the cells good that it calls good, and does it flag the others?"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from fcslam.errors import EvaluationError
from fcslam.geometry import se2
from fcslam.lab.evaluation.fleet.ground_truth import known_poses
from fcslam.maps.certificate import CELL_M
from fcslam.records import FloatArray
from fcslam.runs import QUALITY, Metric, Run, open_run


class Judged(NamedTuple):
    """Cells of all maps of a run."""

    bound_m: FloatArray
    """Bound on the error by the certificate, shape (C,)."""
    error_m: FloatArray
    """True error, shape (C,)."""
    bar_m: float

    def metrics(self) -> list[Metric]:
        """Shares of right statements; NaN if there is no such cell."""
        said, worse = self.bound_m <= self.bar_m, self.error_m > self.bar_m
        return [
            Metric("quality_cells", len(self.bound_m), "1"),
            Metric("quality_said_good", int(said.sum()), "1"),
            Metric("quality_said_good_right", float((~worse)[said].mean()) if said.any() else float("nan"), "1"),
            Metric("quality_worse", int(worse.sum()), "1"),
            Metric("quality_worse_flagged", float((~said)[worse].mean()) if worse.any() else float("nan"), "1"),
        ]


def evaluate_quality(folder: Path, truth: Path) -> Judged:
    """Compare the certificate of a run folder with true poses.

    Args:
        folder: the run folder.
        truth: folder with the truth, as in ``known_poses``.

    Raises:
        EvaluationError: there is no certificate, or the truth cannot be used.
    """
    run = open_run(folder)
    known = known_poses(run, truth)
    found = [
        judge(one, known.estimate.T_map_base[rows], known.truth.T_map_base[rows])
        for k, one in certificates_of(run, folder).items()
        if (rows := known.estimate.maps == k).any()
    ]
    if not found:
        raise EvaluationError(f"{folder}: the truth knows no pose of a map with a certificate")
    bounds, errors = (np.concatenate([one[part] for one in found]) for part in (0, 1))
    return Judged(bounds, errors, found[0].bar_m)


def certificates_of(run: Run, folder: Path) -> dict[int, dict[str, Any]]:
    """The certificate of each map.

    Raises:
        EvaluationError: the run has none.
    """
    content = run.quality.get(f"{QUALITY}.json")
    if content is None:
        raise EvaluationError(f"{folder}: has no {QUALITY}.json; map the recordings again with this version")
    try:
        return {int(k): one for k, one in json.loads(content).items()}
    except (ValueError, AttributeError) as error:
        raise EvaluationError(f"{folder}: {QUALITY}.json is broken ({error})") from error


def judge(certificate: dict[str, Any], estimate: FloatArray, truth: FloatArray) -> Judged:
    """The cells of one map, given estimated and true poses (N, 3) of its robots, row by row."""
    squares = np.floor(estimate[:, :2] / CELL_M).astype(np.int64)
    kept = np.unique(squares, axis=0, return_index=True)[1]
    estimate, truth = estimate[kept], truth[kept]
    tree = cKDTree(estimate[:, :2])
    error_m = np.zeros(len(estimate))
    for k, near in enumerate(tree.query_ball_point(estimate[:, :2], certificate["within"])):
        wrong = se2.between(estimate[k], estimate[near])[:, :2] - se2.between(truth[k], truth[near])[:, :2]
        error_m[k] = np.sqrt((wrong**2).sum() / max(len(near) - 1, 1))
    centres = np.array([(cell["x"], cell["y"]) for cell in certificate["cells"]]).reshape(-1, 2)
    nearest = tree.query(centres)[1] if len(centres) else np.zeros(0, np.int64)
    bound_m = np.array([cell["bound_95"] for cell in certificate["cells"]])
    return Judged(bound_m, error_m[nearest], certificate["bar"])
