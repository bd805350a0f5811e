"""An array that grows row by row, without an object for each row."""

from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Scalar = TypeVar("Scalar", bound=np.generic)

_SPARE = 8
"""A full array grows by 1 / 8 of its rows: appending stays cheap, and little memory is unused."""
_LEAST = 2 * _SPARE


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
