"""A pose graph in the plane: variables numbered from 0, measured motions between them. It only grows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fcslam.geometry import se2
from fcslam.records import FloatArray, frozen

MAXIMUM_INFORMATION = 1e8
"""Largest eigenvalue of an information matrix, 0.1 mm or 0.1 mrad: stiffer edges make the systems ill-conditioned."""

_MINIMUM_INFORMATION = 1e-4
"""Smallest eigenvalue of a bounded matrix, where rounding may have destroyed small ones."""

_ASYMMETRY = 1e-6
"""Largest relative asymmetry of an information matrix that counts as rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured motion between two variables.

    Raises:
        ValueError: the two variables are the same, a number is not finite, or the information is not symmetric
            positive definite (asymmetry by rounding is repaired).
    """

    i: int
    j: int
    T_i_j: FloatArray
    """Pose of j in i, shape (3,)."""
    information: FloatArray
    """Inverse covariance of T_i_j in the tangent space at T_i_j (x, y, theta of j), shape (3, 3)."""
    robust: bool
    """Whether the edge may be false (a closure); odometry is trusted."""

    def __post_init__(self) -> None:
        where = f"edge {self.i} -> {self.j}"
        if self.i == self.j or min(self.i, self.j) < 0:
            raise ValueError(f"{where}: connects two different variables, numbered from 0")
        object.__setattr__(self, "T_i_j", frozen(_checked(self.T_i_j, (3,), f"{where}: T_i_j")))
        object.__setattr__(self, "information", frozen(_positive_definite(self.information, where)))


@dataclass(frozen=True, slots=True)
class EdgeArrays:
    """All edges of a graph, one row each; eigenvalues of the information are at most MAXIMUM_INFORMATION."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    T_i_j: FloatArray
    information: FloatArray
    robust: NDArray[np.bool_]


class PoseGraph:
    """Variables with initial poses, shape (N, 3), and edges between them; append-only."""

    def __init__(self, poses: ArrayLike = (), edges: Sequence[Edge] = ()) -> None:
        self._poses: list[FloatArray] = []
        self._edges: list[Edge] = []
        self._arrays = _stack([])
        for pose in np.asarray(poses, dtype=np.float64).reshape(-1, 3):
            self.add_variable(pose)
        for edge in edges:
            self.add_edge(edge)

    @classmethod
    def restored(cls, poses: FloatArray, edges: EdgeArrays) -> Self:
        """A graph from the poses (N, 3) and edges of another one, which were checked when they were added to it."""
        graph = cls()
        graph._poses = list(frozen(poses))
        ends, robust = zip(edges.i.tolist(), edges.j.tolist(), strict=True), edges.robust.tolist()
        measured = zip(frozen(edges.T_i_j), frozen(edges.information), strict=True)
        rows = zip(ends, measured, robust, strict=True)
        graph._edges = [_checked_edge(i, j, T, information, closes) for (i, j), (T, information), closes in rows]
        return graph

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def edges(self) -> Sequence[Edge]:
        """Edges in the order in which they were added."""
        return self._edges

    def add_variable(self, pose: ArrayLike) -> int:
        """Append a variable with its initial pose (3,); returns its number.

        Raises:
            ValueError: the pose is not three finite numbers.
        """
        self._poses.append(frozen(_checked(pose, (3,), f"variable {len(self)}")))
        return len(self._poses) - 1

    def add_edge(self, edge: Edge) -> int:
        """Append an edge; returns its number.

        Raises:
            ValueError: the edge names a variable that the graph does not have.
        """
        if max(edge.i, edge.j) >= len(self):
            raise ValueError(f"edge {edge.i} -> {edge.j}: the graph has variables 0 to {len(self) - 1}")
        self._edges.append(edge)
        return len(self._edges) - 1

    def poses(self) -> FloatArray:
        """Initial poses, shape (N, 3)."""
        return np.array(self._poses, dtype=np.float64).reshape(-1, 3)

    def given(self) -> EdgeArrays:
        """Edges as arrays with the information that was given, for ``restored``."""
        bounded = self.arrays()
        information = np.array([edge.information for edge in self._edges], dtype=np.float64).reshape(-1, 3, 3)
        return replace(bounded, information=information)

    def arrays(self) -> EdgeArrays:
        """Edges as arrays; only those added since the last call are converted."""
        known = len(self._arrays.i)
        if known < len(self._edges):
            old, new = self._arrays, _stack(self._edges[known:])
            self._arrays = EdgeArrays(
                i=np.concatenate((old.i, new.i)),
                j=np.concatenate((old.j, new.j)),
                T_i_j=np.concatenate((old.T_i_j, new.T_i_j)),
                information=np.concatenate((old.information, new.information)),
                robust=np.concatenate((old.robust, new.robust)),
            )
        return self._arrays

    def chi2(self, poses: ArrayLike | None = None, rows: NDArray[np.int64] | None = None) -> FloatArray:
        """Squared Mahalanobis length of the edges' residuals at ``poses`` (N, 3); None: initial poses.

        Shape (E,), or (K,) of some ``rows``, shape (K,).
        """
        x = self.poses() if poses is None else np.asarray(poses, dtype=np.float64)
        edges, chosen = self.arrays(), slice(None) if rows is None else rows
        # The residual that the solver minimises: the logarithm, not the difference of coordinates.
        measured = se2.between(x[edges.i[chosen]], x[edges.j[chosen]])
        residual = se2.log(se2.between(edges.T_i_j[chosen], measured))
        chi2: FloatArray = np.einsum("ea,eab,eb->e", residual, edges.information[chosen], residual)
        return chi2

    def components(self, kept: ArrayLike | None = None) -> NDArray[np.int64]:
        """Number of the connected component of each variable, shape (N,), counted in the order of first variables.

        ``kept``, shape (E,), marks the edges that connect; None: all.
        """
        edges = self.arrays()
        mask = np.ones(len(edges.i), dtype=bool) if kept is None else np.asarray(kept, dtype=bool)
        i, j = edges.i[mask], edges.j[mask]
        links = coo_array((np.ones(len(i)), (i, j)), shape=(len(self), len(self)))
        labels = connected_components(links, directed=False)[1] if len(self) else np.zeros(0)
        first, number = np.unique(labels, return_index=True)[1], np.empty(len(np.unique(labels)), dtype=np.int64)
        number[np.argsort(first)] = np.arange(len(first))
        return number[labels.astype(np.int64)]


def anchors(components: NDArray[np.int64]) -> NDArray[np.int64]:
    """First variable of each connected component, shape (C,); ``components`` as from ``PoseGraph.components``, (N,)."""
    return np.unique(components, return_index=True)[1].astype(np.int64)


def _checked_edge(i: int, j: int, T_i_j: FloatArray, information: FloatArray, robust: bool) -> Edge:
    """An edge without a new check."""
    edge = object.__new__(Edge)
    for name, value in (("i", i), ("j", j), ("T_i_j", T_i_j), ("information", information), ("robust", robust)):
        object.__setattr__(edge, name, value)
    return edge


def _stack(edges: Sequence[Edge]) -> EdgeArrays:
    return EdgeArrays(
        i=np.array([edge.i for edge in edges], dtype=np.int64),
        j=np.array([edge.j for edge in edges], dtype=np.int64),
        T_i_j=np.array([edge.T_i_j for edge in edges], dtype=np.float64).reshape(-1, 3),
        information=_bounded(np.array([edge.information for edge in edges], dtype=np.float64).reshape(-1, 3, 3)),
        robust=np.array([edge.robust for edge in edges], dtype=bool),
    )


def _bounded(information: FloatArray) -> FloatArray:
    """Information (E, 3, 3) with eigenvalues at most MAXIMUM_INFORMATION."""
    stiff = np.flatnonzero(np.einsum("eaa->e", information) > MAXIMUM_INFORMATION)
    values, vectors = np.linalg.eigh(information[stiff])
    values = np.clip(values, _MINIMUM_INFORMATION, MAXIMUM_INFORMATION)
    information[stiff] = np.einsum("eab,eb,ecb->eac", vectors, values, vectors)
    return information


def _checked(values: ArrayLike, shape: tuple[int, ...], what: str) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{what} must be finite numbers of shape {shape}, not {array.tolist()}")
    return array


def _positive_definite(information: ArrayLike, where: str) -> FloatArray:
    matrix = _checked(information, (3, 3), f"{where}: information")
    (xx, xy, xt), (yx, yy, yt), (tx, ty, tt) = matrix.tolist()  # without arrays: thousands of edges come one by one
    largest = max(map(abs, (xx, xy, xt, yx, yy, yt, tx, ty, tt)))
    if max(abs(xy - yx), abs(xt - tx), abs(yt - ty)) > _ASYMMETRY * largest:
        raise ValueError(f"{where}: information is not symmetric: {matrix.tolist()}")
    symmetric = 0.5 * (matrix + matrix.T)
    try:
        np.linalg.cholesky(symmetric)
    except np.linalg.LinAlgError:
        raise ValueError(f"{where}: information is not positive definite: {matrix.tolist()}") from None
    return symmetric
