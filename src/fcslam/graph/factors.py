"""GTSAM's factors of a pose graph. The wheel of GTSAM 4.3 is built without TBB: one thread, same input, same bytes."""

from collections.abc import Iterator, Sequence
from enum import StrEnum
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.graph.chains import Chains
from fcslam.graph.pose_graph import PoseGraph, anchors
from fcslam.records import FloatArray

CAUCHY_WIDTH = 2.385
"""Width of the Cauchy loss in standard deviations: 95 % efficiency on normal residuals."""


class Loss(StrEnum):
    """Loss of the residual of a closure; odometry always has the squared loss."""

    SQUARED = "squared"
    CAUCHY = "cauchy"

    def weights(self, chi2: FloatArray) -> FloatArray:
        """Weights in [0, 1], shape (K,), of residuals with squared Mahalanobis lengths ``chi2``, shape (K,)."""
        if self is Loss.CAUCHY:
            return CAUCHY_WIDTH**2 / (CAUCHY_WIDTH**2 + chi2)
        return np.ones_like(chi2)


class FactorCache:
    """Factors of a growing graph; each is built once."""

    def __init__(self, graph: PoseGraph, chains: Chains | None = None) -> None:
        """``chains`` of the graph, which must not grow then, leave the variables inside of them out of the factors."""
        self.graph = graph
        self.chains = chains
        self._trusted = gtsam.NonlinearFactorGraph()
        self._closures: dict[Loss, list[Any]] = {}
        """Factors of the closures with weight 1, by loss; those of a loss are built when it is first used."""
        self._built = 0
        if chains is not None:
            self._add_trusted(chains.i, chains.j, chains.T_i_j, chains.information)

    def restricted(self, graph: PoseGraph, kept: NDArray[np.bool_]) -> "FactorCache":
        """Factors of a ``graph`` that has the same variables, all trusted edges, and the closures that are kept, (K,).

        It shares what is built.
        """
        self._update()
        part = FactorCache(graph)
        part.chains = self.chains
        part._trusted = gtsam.NonlinearFactorGraph(self._trusted)
        unit = zip(self._closures_under(Loss.SQUARED), kept.tolist(), strict=True)
        part._closures[Loss.SQUARED] = [factor for factor, keep in unit if keep]
        part._built = graph.edge_count
        return part

    def values(self, poses: FloatArray, solved: NDArray[np.bool_] | None = None) -> Any:
        """GTSAM values of the poses (N, 3) that the factors measure; ``solved`` as in ``robust``."""
        rows = self._rows(solved)
        return to_values(poses, None if rows is None else rows.tolist())

    def read(self, values: Any, poses: FloatArray, solved: NDArray[np.bool_] | None = None) -> None:
        """Write GTSAM values into ``poses`` (N, 3); poses inside of chains, and those not ``solved``, stay."""
        rows = self._rows(solved)
        poses[... if rows is None else rows] = from_values(values)

    def _rows(self, solved: NDArray[np.bool_] | None) -> NDArray[np.int64] | None:
        if solved is not None:
            return np.flatnonzero(solved)
        return None if self.chains is None else self.chains.kept

    def complete(self, poses: FloatArray) -> None:
        """Set the poses inside of chains, in ``poses`` (N, 3), by those at their ends."""
        if self.chains is not None:
            self.chains.expand(poses)

    def squared(self, weights: FloatArray, poses: FloatArray) -> Any:
        """Factor graph with the information of the closures scaled by weights; closures of weight 0 are left out.

        Args:
            weights: one for each closure, in their order, shape (K,).
            poses: shape (N, 3); each connected component is anchored at the pose of its first variable.
        """
        graph = self.floating(weights)
        self._anchor(graph, weights > 0.0, poses)
        return graph

    def floating(self, weights: FloatArray) -> Any:
        """As ``squared``, without an anchor."""
        self._update()
        graph = gtsam.NonlinearFactorGraph(self._trusted)
        scales = np.sqrt(weights)
        scaled = self._closure_factors(np.flatnonzero((scales > 0.0) & (scales != 1.0)), scales)
        for unit, scale in zip(self._closures_under(Loss.SQUARED), scales.tolist(), strict=True):
            if scale == 1.0:
                graph.push_back(unit)
            elif scale > 0.0:
                graph.push_back(next(scaled))
        return graph

    def robust(
        self, loss: Loss, kept: NDArray[np.bool_], poses: FloatArray, solved: NDArray[np.bool_] | None = None
    ) -> Any:
        """Factor graph with closures under ``loss`` where ``kept``, shape (K,), is true; anchored as in ``squared``.

        ``solved``, shape (N,), marks the variables of whole components that it has, without chains; None: all.
        """
        if loss is Loss.SQUARED and solved is None:
            return self.squared(kept.astype(np.float64), poses)
        self._update()
        graph = gtsam.NonlinearFactorGraph(self._trusted) if solved is None else gtsam.NonlinearFactorGraph()
        if solved is not None:
            edges = self.graph.arrays()
            for number in np.flatnonzero(solved[edges.i[~edges.robust]]).tolist():
                graph.push_back(self._trusted.at(number))
            kept = kept & solved[edges.i[edges.robust]]
        for factor, keep in zip(self._closures_under(loss), kept.tolist(), strict=True):
            if keep:
                graph.push_back(factor)
        self._anchor(graph, kept, poses, solved)
        return graph

    def _closures_under(self, loss: Loss) -> list[Any]:
        built = self._closures.setdefault(loss, [])
        count = int(np.count_nonzero(self.graph.arrays().robust))
        built.extend(self._closure_factors(np.arange(len(built), count), np.ones(count), loss))
        return built

    def _closure_factors(
        self, numbers: NDArray[np.int64], scales: FloatArray, loss: Loss = Loss.SQUARED
    ) -> Iterator[Any]:
        """Factors of some closures, by their ``numbers`` (K,) among the closures; ``scales`` are of all closures."""
        edges = self.graph.arrays()
        rows = np.flatnonzero(edges.robust)[numbers]
        roots = _roots(edges.information[rows]) * scales[numbers, None, None]
        columns = zip(edges.i[rows].tolist(), edges.j[rows].tolist(), edges.T_i_j[rows].tolist(), roots, strict=True)
        for i, j, T_i_j, root in columns:
            yield _between(i, j, T_i_j, root, loss)

    def _anchor(
        self, graph: Any, kept: NDArray[np.bool_], poses: FloatArray, solved: NDArray[np.bool_] | None = None
    ) -> None:
        """Add a prior on the first variable of every connected component that is ``solved``."""
        connects = np.ones(self.graph.edge_count, dtype=bool)
        connects[self.graph.arrays().robust] = kept
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
        firsts = anchors(self.graph.components(connects))
        for variable in (firsts if solved is None else firsts[solved[firsts]]).tolist():
            graph.push_back(gtsam.PriorFactorPose2(variable, gtsam.Pose2(*poses[variable].tolist()), noise))

    def _update(self) -> None:
        edges = self.graph.arrays()
        new = np.arange(self._built, len(edges.i))
        trusted = new[~edges.robust[new]]
        if self.chains is None:
            self._add_trusted(edges.i[trusted], edges.j[trusted], edges.T_i_j[trusted], edges.information[trusted])
        self._built = len(edges.i)

    def _add_trusted(
        self, i: NDArray[np.int64], j: NDArray[np.int64], T_i_j: FloatArray, information: FloatArray
    ) -> None:
        roots = _roots(information)
        for first, last, motion, root in zip(i.tolist(), j.tolist(), T_i_j.tolist(), roots, strict=True):
            self._trusted.push_back(_between(first, last, motion, root))


def to_values(poses: ArrayLike, rows: Sequence[int] | None = None) -> Any:
    """GTSAM values of poses (N, 3), keyed by row; of some ``rows``, or of all."""
    values, listed = gtsam.Values(), np.asarray(poses, dtype=np.float64).tolist()
    for key in range(len(listed)) if rows is None else rows:
        values.insert(key, gtsam.Pose2(*listed[key]))
    return values


def from_values(values: Any) -> FloatArray:
    """Poses (M, 3) of GTSAM values, in the order of their keys."""
    poses: FloatArray = gtsam.utilities.extractPose2(values)
    return poses


def _between(i: int, j: int, T_i_j: list[float], root: FloatArray, loss: Loss = Loss.SQUARED) -> Any:
    noise: Any = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
    if loss is Loss.CAUCHY:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_WIDTH), noise)
    return gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*T_i_j), noise)


def _roots(information: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.cholesky(information).transpose(0, 2, 1), dtype=np.float64)
