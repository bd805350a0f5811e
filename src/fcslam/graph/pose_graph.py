"""A pose graph: variables numbered from 0, measured motions between them. It only grows."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fcslam.compiled import njit
from fcslam.geometry.groups import SE2, Group, group_of
from fcslam.records import FloatArray, frozen

Scalar = TypeVar("Scalar", bound=np.generic)

_SPARE = 8
"""A full array grows by 1 / 8 of its rows: appending stays cheap, and little memory is unused."""
_LEAST = 2 * _SPARE
MAXIMUM_INFORMATION = 1e8
"""Largest eigenvalue of an information matrix, 0.1 mm or 0.1 mrad: stiffer edges make the systems ill-conditioned."""

_MINIMUM_INFORMATION = 1e-12 * MAXIMUM_INFORMATION
"""Smallest eigenvalue of a bounded matrix, where rounding may have destroyed small ones."""

_ASYMMETRY = 1e-6
"""Largest relative asymmetry of an information matrix that counts as rounding."""


class Rows(Generic[Scalar]):
    """Rows of one shape and type; each can be replaced, none removed."""

    __slots__ = "_array", "_count"

    def __init__(self, rows: NDArray[Scalar]) -> None:
        """Start with a copy of ``rows``, shape (N, ...); N may be 0."""
        self._array, self._count = rows.copy(), len(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def values(self) -> NDArray[Scalar]:
        """The rows so far, shape (N, ...): a view, in which later changes of these rows may or may not show."""
        return self._array[: self._count]

    def append(self, row: ArrayLike) -> int:
        """Append a row; returns its number."""
        if self._count == len(self._array):
            more = max(self._count // _SPARE, _LEAST)
            grown: NDArray[Any] = np.empty((self._count + more, *self._array.shape[1:]), self._array.dtype)
            grown[: self._count] = self._array
            self._array = grown
        self._array[self._count] = row
        self._count += 1
        return self._count - 1


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured motion between two variables."""

    i: int
    j: int
    T_i_j: FloatArray
    """Pose of j in i, shape (3,) or (7,)."""
    information: FloatArray
    """Inverse covariance of T_i_j in the tangent space at T_i_j, shape (3, 3) or (6, 6)."""
    robust: bool
    """Whether the edge may be false (a closure); odometry is trusted."""

    def __post_init__(self) -> None:
        where = f"edge {self.i} -> {self.j}"
        if self.i == self.j or min(self.i, self.j) < 0:
            raise ValueError(f"{where}: connects two different variables, numbered from 0")
        group = group_of(np.asarray(self.T_i_j))
        object.__setattr__(self, "T_i_j", frozen(_checked(self.T_i_j, (group.size,), f"{where}: T_i_j")))
        object.__setattr__(self, "information", frozen(_positive_definite(self.information, group.freedom, where)))


@dataclass(frozen=True, slots=True)
class EdgeArrays:
    """All edges of a graph, one row each; eigenvalues of the information are at most MAXIMUM_INFORMATION."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    T_i_j: FloatArray
    information: FloatArray
    robust: NDArray[np.bool_]

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "EdgeArrays":
        """The edges at these rows, shape (K,), or where ``rows``, shape (E,), is true."""
        return EdgeArrays(self.i[rows], self.j[rows], self.T_i_j[rows], self.information[rows], self.robust[rows])


class PoseGraph:
    """Variables with initial poses, shape (N, P), and edges between them; append-only."""

    def __init__(self, poses: ArrayLike = (), edges: Iterable[Edge] = (), group: Group = SE2) -> None:
        self.group = group
        self._poses = Rows(np.zeros((0, group.size)))
        ends, d = np.zeros(0, np.int64), group.freedom
        self._set_edges(EdgeArrays(ends, ends, np.zeros((0, group.size)), np.zeros((0, d, d)), np.zeros(0, bool)))
        for pose in np.asarray(poses, dtype=np.float64).reshape(-1, group.size):
            self.add_variable(pose)
        for edge in edges:
            self.add_edge(edge)

    @classmethod
    def restored(cls, poses: FloatArray, edges: EdgeArrays) -> Self:
        """A graph from the poses (N, P) and edges of another one, which were checked when they were added to it."""
        graph = cls(group=group_of(poses))
        graph._poses = Rows(poses)
        graph._set_edges(edges)
        return graph

    def _set_edges(self, edges: EdgeArrays) -> None:
        """``edges`` with the information that was given."""
        self._i, self._j, self._robust = Rows(edges.i), Rows(edges.j), Rows(edges.robust)
        self._T_i_j, self._information = Rows(edges.T_i_j), Rows(edges.information)
        self._given: dict[int, FloatArray] = {}
        """The given information of those edges where it was bounded."""
        self._bounded = 0
        """Edges whose information is bounded where it has to be."""

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def edge_count(self) -> int:
        """Number of edges."""
        return len(self._i)

    @property
    def edges(self) -> list[Edge]:
        """Edges in the order in which they were added, as they were given; ``arrays`` takes less time."""
        rows, given = range(self.edge_count), self.given()
        return [
            Edge(int(given.i[k]), int(given.j[k]), given.T_i_j[k], given.information[k], bool(given.robust[k]))
            for k in rows
        ]

    def add_variable(self, pose: ArrayLike) -> int:
        """Append a variable with its initial pose (P,); returns its number."""
        return self._poses.append(_checked(pose, (self.group.size,), f"variable {len(self)}"))

    def add_edge(self, edge: Edge) -> int:
        """Append an edge; returns its number."""
        if max(edge.i, edge.j) >= len(self):
            raise ValueError(f"edge {edge.i} -> {edge.j}: the graph has variables 0 to {len(self) - 1}")
        for rows, value in (
            (self._i, edge.i),
            (self._j, edge.j),
            (self._robust, edge.robust),
            (self._T_i_j, edge.T_i_j),
        ):
            rows.append(value)
        return self._information.append(edge.information)

    def poses(self) -> FloatArray:
        """Initial poses, shape (N, P)."""
        return self._poses.values.copy()

    def given(self) -> EdgeArrays:
        """Edges as arrays with the information that was given, for ``restored``."""
        information = self._information.values.copy()
        for row, matrix in self._given.items():
            information[row] = matrix
        return replace(self.arrays(), information=information)

    def arrays(self) -> EdgeArrays:
        """Edges as arrays; eigenvalues of the information are at most MAXIMUM_INFORMATION."""
        information = self._information.values
        new = information[self._bounded :]
        stiff = np.flatnonzero(np.einsum("eaa->e", new) > MAXIMUM_INFORMATION)
        self._given |= {self._bounded + row: frozen(new[row]) for row in stiff.tolist()}
        new[stiff] = _bounded(new[stiff])
        self._bounded = self.edge_count
        return EdgeArrays(self._i.values, self._j.values, self._T_i_j.values, information, self._robust.values)

    def restricted(
        self, poses: FloatArray, kept: NDArray[np.bool_], variables: NDArray[np.bool_] | None = None
    ) -> "PoseGraph":
        """The graph at ``poses`` (N, P) with the edges where ``kept`` (E,) is true.

        ``variables`` (N,) marks those that stay, with new numbers, and the edges between them; None: all.
        """
        if variables is None:
            return PoseGraph.restored(poses, self.given().select(kept))
        edges, number = self.given(), np.cumsum(variables) - 1
        edges = edges.select(kept & variables[edges.i] & variables[edges.j])
        return PoseGraph.restored(poses[variables], replace(edges, i=number[edges.i], j=number[edges.j]))

    def to_plane(self) -> "PoseGraph":
        """The same graph in the plane: heights, roll and pitch are left out."""
        if self.group is SE2:
            return self
        edges, to_plane = self.given(), self.group.to_plane
        information = self.group.planar_information(edges.information)
        planar = replace(edges, T_i_j=to_plane(edges.T_i_j), information=information)
        return PoseGraph.restored(to_plane(self.poses()), planar)

    def chi2(self, poses: ArrayLike | None = None, rows: NDArray[np.int64] | None = None) -> FloatArray:
        """Squared Mahalanobis length of the edges' residuals at ``poses`` (N, P); None: initial poses.

        Shape (E,), or (K,) of some ``rows``, shape (K,).
        """
        x = self.poses() if poses is None else np.asarray(poses, dtype=np.float64)
        edges, chosen = self.arrays(), slice(None) if rows is None else rows
        residual = self.group.residual(edges.T_i_j[chosen], x[edges.i[chosen]], x[edges.j[chosen]])
        chi2: FloatArray = np.einsum("ea,eab,eb->e", residual, edges.information[chosen], residual)
        return chi2

    def components(self, kept: ArrayLike | None = None) -> NDArray[np.int64]:
        """First variable of the connected component of each variable, shape (N,).

        ``kept``, shape (E,), marks the edges that connect; None: all.
        """
        edges = self.arrays() if kept is None else self.arrays().select(np.asarray(kept, dtype=bool))
        first: NDArray[np.int64] = _first_connected(edges.i, edges.j, len(self))
        return first


@njit
def _first_connected(i, j, count):  # type: ignore[no-untyped-def]
    """First variable of the component of each variable, shape (count,): union-find, whose roots are the least."""
    first = np.arange(count)
    for k in range(len(i)):
        a, b = _root(first, i[k]), _root(first, j[k])
        first[max(a, b)] = min(a, b)
    for variable in range(count):  # what comes before is final
        first[variable] = first[first[variable]]
    return first


@njit(allocates=False)
def _root(first, variable):  # type: ignore[no-untyped-def]
    while first[variable] != variable:
        first[variable] = first[first[variable]]
        variable = first[variable]
    return variable


def _bounded(information: FloatArray) -> FloatArray:
    """Information (E, d, d) with eigenvalues at most MAXIMUM_INFORMATION."""
    values, vectors = np.linalg.eigh(information)
    values = np.clip(values, _MINIMUM_INFORMATION, MAXIMUM_INFORMATION)
    bounded: FloatArray = np.einsum("eab,eb,ecb->eac", vectors, values, vectors)
    return bounded


def _checked(values: ArrayLike, shape: tuple[int, ...], what: str) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{what} must be finite numbers of shape {shape}, not {array.tolist()}")
    return array


def _positive_definite(information: ArrayLike, freedom: int, where: str) -> FloatArray:
    matrix = _checked(information, (freedom, freedom), f"{where}: information")
    rows = matrix.tolist()  # without arrays: thousands of edges come one by one
    largest = max(abs(number) for row in rows for number in row)
    upper = ((r, c) for r in range(freedom) for c in range(r + 1, freedom))
    if max(abs(rows[r][c] - rows[c][r]) for r, c in upper) > _ASYMMETRY * largest:
        raise ValueError(f"{where}: information is not symmetric: {rows}")
    symmetric = 0.5 * (matrix + matrix.T)
    try:
        np.linalg.cholesky(symmetric)
    except np.linalg.LinAlgError:
        raise ValueError(f"{where}: information is not positive definite: {rows}") from None
    return symmetric
