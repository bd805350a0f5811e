"""Linear least squares between pairs of variables: normal equations of square blocks, and their sparse factor L L^T.

Every sum has its order, without a library of linear algebra, in one thread: the same input gives the same bytes.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fcslam.compiled import njit
from fcslam.records import FloatArray

_Numbers = NDArray[np.int64]

Structure = tuple[_Numbers, _Numbers, _Numbers, _Numbers, _Numbers, _Numbers]
"""Where the factor L of N variables has blocks, for E edges. Its rows are in the order of elimination.

First and second variable of each edge, shape (E,) each; the row of each variable, (N,); the block below the diagonal to
which each edge adds, (E,); the first block of each column, and the end of the last one, (N + 1,); the row of each block
below the diagonal, ascending within a column, (B,).
"""


def find_structure(i: _Numbers, j: _Numbers, count: int) -> Structure:
    """Order ``count`` variables by minimum degree, for edges between two different variables each, shape (E,)."""
    return _structure(i.tobytes(), j.tobytes(), count)


@lru_cache(maxsize=2)  # most solves of a robust solution are on the edges of the solve before
def _structure(of_i: bytes, of_j: bytes, count: int) -> Structure:
    i, j = np.frombuffer(of_i, np.int64), np.frombuffer(of_j, np.int64)
    pairs = np.unique(np.concatenate((i * count + j, j * count + i)))
    first = np.searchsorted(pairs, np.arange(count + 1) * count)
    row, start, degree, near = _eliminate(first[:-1].copy(), np.diff(first), (pairs % count).astype(np.int32))
    below = near[np.arange(degree.sum()) + np.repeat(start - np.cumsum(degree) + degree, degree)]
    blocks = np.sort(np.repeat(row, degree) * count + row[below])
    low, high = np.minimum(row[i], row[j]), np.maximum(row[i], row[j])
    starts = np.searchsorted(blocks, np.arange(count + 1) * count)
    return i, j, row, np.searchsorted(blocks, low * count + high), starts, blocks % count


def solve(
    structure: Structure,
    jacobians: tuple[FloatArray, FloatArray],
    information: FloatArray,
    residual: FloatArray,
    held: NDArray[np.bool_],
    damping: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Minimise ``sum_k |A_k x_i + B_k x_j + r_k|^2 + damping |x|^2``, in the norm of the information.

    Args:
        structure: of N variables and E edges.
        jacobians: ``A`` and ``B``, shape (E, m, d) each.
        information: shape (E, m, m).
        residual: ``r``, shape (E, m).
        held: variables that are zero, shape (N,).
        damping: added to the diagonal of the normal equations.

    Returns:
        The variables, and half the gradient where they are zero, shape (N, d) each. The variables are NaN if the normal
        equations are not positive definite.
    """
    gradient, *factor = _factorized(structure, jacobians, information, residual, held, damping)
    x = -gradient[..., None]
    _substitute(*factor, x)
    return x[structure[2], :, 0], gradient[structure[2]]


def marginal_covariance(
    structure: Structure,
    jacobians: tuple[FloatArray, FloatArray],
    information: FloatArray,
    held: NDArray[np.bool_],
    wanted: _Numbers,
) -> FloatArray:
    """Marginal covariance of some variables, shape (W d, W d), where the edges measure with this information.

    ``wanted``: the variables, shape (W,); those that are held have none. Other arguments as for ``solve``.
    """
    edges, height, size = jacobians[0].shape
    _, *factor = _factorized(structure, jacobians, information, np.zeros((edges, height)), held, 0.0)
    result = np.zeros((len(wanted), size, len(wanted), size))
    rows = structure[2][wanted]
    for column in np.flatnonzero(~held[wanted]):
        x = np.zeros((len(held), size, size))
        x[rows[column]] = np.eye(size)
        _substitute(*factor, x)
        result[:, :, column] = x[rows]
    return result.reshape(len(wanted) * size, -1)


def _factorized(
    structure: Structure,
    jacobians: tuple[FloatArray, FloatArray],
    information: FloatArray,
    residual: FloatArray,
    held: NDArray[np.bool_],
    damping: float,
) -> tuple[FloatArray, _Numbers, _Numbers, FloatArray, FloatArray]:
    """The gradient by row, and the factor as ``_substitute`` takes it."""
    i, j, row, block, starts, rows = structure
    of_i, of_j = (np.where(held[ends, None, None], 0.0, of) for ends, of in zip((i, j), jacobians, strict=True))
    size = of_i.shape[2]
    diagonal, lower = np.empty((len(row), size, size)), np.zeros((len(rows), size, size))
    diagonal[row] = np.where(held, 1.0, damping)[:, None, None] * np.eye(size)
    gradient = np.zeros((len(row), size))
    _assemble(row[i], row[j], block, of_i, of_j, information, residual, diagonal, lower, gradient)
    if not _factorize(starts, rows, diagonal, lower):
        diagonal[:] = np.nan
    return gradient, starts, rows, diagonal, lower


@njit
def _eliminate(start, degree, near):  # type: ignore[no-untyped-def]
    """Eliminate the variables, about those with the fewest neighbours first; each joins its neighbours to one another.

    The neighbours of each variable are from ``start`` on in ``near``. Returns the row of each variable, and in place of
    its neighbours those that were left when it was eliminated.
    """
    count, end, number, least = len(start), len(near), 0, 0
    row, left, seen = np.full(count, -1), np.arange(count).astype(near.dtype), np.zeros(count, np.int64)
    joins = 0
    while number < count:
        kept, fewest = 0, count
        for variable in left[: count - number]:
            if degree[variable] > least:
                left[kept] = variable
                kept += 1
                fewest = min(fewest, degree[variable])
                continue
            row[variable] = number
            number += 1
            first, last = start[variable], start[variable] + degree[variable]
            if degree[variable] == count - number:  # all others are its neighbours, and so will be each other's
                for p in range(first, last):
                    row[near[p]], start[near[p]], degree[near[p]] = number + p - first, p + 1, last - p - 1
                number = count
                break
            for p in range(first, last):
                other = near[p]
                if end + degree[other] + degree[variable] > len(near):
                    near = np.concatenate((near, np.empty(end + count, near.dtype)))
                joins += 1
                seen[variable] = seen[other] = joins
                new = end
                for joined in (other, variable):
                    for q in range(start[joined], start[joined] + degree[joined]):
                        if seen[near[q]] != joins:
                            seen[near[q]] = joins
                            near[new] = near[q]
                            new += 1
                start[other], degree[other], end = end, new - end, new
        least = fewest
    return row, start, degree, near


@njit(allocates=False)
def _assemble(i, j, block, of_i, of_j, information, residual, diagonal, lower, gradient):  # type: ignore[no-untyped-def]
    """Add ``J^T W J`` and ``J^T W r`` of each factor; only the lower triangles of the diagonal blocks are complete."""
    height, size = of_i.shape[1:]
    for k in range(len(i)):
        (low, of_low), (high, of_high) = (i[k], of_i[k]), (j[k], of_j[k])
        if low > high:
            (low, of_low), (high, of_high) = (high, of_high), (low, of_low)
        for m in range(height):
            for n in range(height):
                weight = information[k, m, n]
                for a in range(size):
                    down, right = of_low[m, a] * weight, of_high[m, a] * weight
                    gradient[low, a] += down * residual[k, n]
                    gradient[high, a] += right * residual[k, n]
                    for b in range(size):
                        diagonal[low, a, b] += down * of_low[n, b]
                        diagonal[high, a, b] += right * of_high[n, b]
                        lower[block[k], a, b] += right * of_low[n, b]


@njit(allocates=False)
def _factorize(starts, rows, diagonal, lower):  # type: ignore[no-untyped-def]
    """Replace the lower triangle of a matrix by its Cholesky factor; false if it is not positive definite."""
    for column in range(len(diagonal)):
        if not _factorize_block(diagonal[column]):
            return False
        last = starts[column + 1]
        for p in range(starts[column], last):
            _divide(lower[p], diagonal[column])
        for p in range(starts[column], last):
            _subtract_product(diagonal[rows[p]], lower[p], lower[p])
            q = starts[rows[p]]
            for below in range(p + 1, last):
                while rows[q] != rows[below]:
                    q += 1
                _subtract_product(lower[q], lower[below], lower[p])
    return True


@njit(allocates=False)
def _factorize_block(block):  # type: ignore[no-untyped-def]
    for a in range(len(block)):
        for b in range(a + 1):
            rest = block[a, b]
            for c in range(b):
                rest -= block[a, c] * block[b, c]
            if a > b:
                block[a, b] = rest / block[b, b]
            elif rest > 0.0:
                block[a, a] = np.sqrt(rest)
            else:
                return False
    return True


@njit(allocates=False)
def _divide(block, factor):  # type: ignore[no-untyped-def]
    """``block L^-T`` of the lower triangle L of ``factor``, in place."""
    for a in range(len(block)):
        for b in range(len(block)):
            for c in range(b):
                block[a, b] -= block[a, c] * factor[b, c]
            block[a, b] /= factor[b, b]


@njit(allocates=False)
def _subtract_product(block, left, right):  # type: ignore[no-untyped-def]
    """``block - left right^T``, in place."""
    for a in range(len(left)):
        for b in range(len(right)):
            product = 0.0
            for c in range(left.shape[1]):
                product += left[a, c] * right[b, c]
            block[a, b] -= product


@njit(allocates=False)
def _substitute(starts, rows, diagonal, lower, x):  # type: ignore[no-untyped-def]
    """Solve ``L L^T x = b`` in place of b, shape (N, d, m)."""
    count, size, width = x.shape
    for column in range(count):
        for a in range(size):
            for m in range(width):
                for b in range(a):
                    x[column, a, m] -= diagonal[column, a, b] * x[column, b, m]
                x[column, a, m] /= diagonal[column, a, a]
        for p in range(starts[column], starts[column + 1]):
            _subtract_product(x[rows[p]], lower[p], x[column].T)
    for column in range(count - 1, -1, -1):
        for p in range(starts[column], starts[column + 1]):
            _subtract_product(x[column], lower[p].T, x[rows[p]].T)
        for a in range(size - 1, -1, -1):
            for m in range(width):
                for b in range(a + 1, size):
                    x[column, a, m] -= diagonal[column, b, a] * x[column, b, m]
                x[column, a, m] /= diagonal[column, a, a]
