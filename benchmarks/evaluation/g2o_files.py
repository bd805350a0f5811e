"""Reads pose graphs from text files: g2o (2D) and TORO, plain or gzip by the name of the file.

    VERTEX_SE2 id x y theta                     VERTEX2 id x y theta                    (TORO)
    EDGE_SE2 i j x y theta xx xy xt yy yt tt    EDGE2 i j x y theta xx xy yy tt xt yt   (TORO)
    FIX id ...

The formats do not mark closures: the first edge between two consecutive ids is odometry, all others are closures.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fcslam.errors import InputError
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.untrusted import open_unpacked

_MAXIMUM_LINE = 4096

_EDGE_ORDER = {"EDGE_SE2": (0, 1, 2, 1, 3, 4, 2, 4, 5), "EDGE2": (0, 1, 4, 1, 2, 5, 4, 5, 3)}
"""Index of each entry of the information matrix (row by row) among the six numbers of a line."""

_VERTICES = ("VERTEX_SE2", "VERTEX2")


@dataclass(frozen=True, slots=True, eq=False)
class G2oGraph:
    """A pose graph with the ids of its variables in the file."""

    graph: PoseGraph
    ids: tuple[int, ...]
    """Id of each variable, ascending."""
    fixed: tuple[int, ...] = ()
    """Ids in FIX lines."""


@dataclass(slots=True)
class _Content:
    poses: dict[int, list[float]] = field(default_factory=dict)
    edges: list[tuple[int, Edge]] = field(default_factory=list)
    """Line number and edge; ``i`` and ``j`` are ids."""
    fixed: list[int] = field(default_factory=list)


def read_g2o(path: Path) -> G2oGraph:
    """Read a g2o or TORO file, ``.gz`` or plain; unknown tags are refused, ``#`` starts a comment.

    Without vertex lines, all variables are at zero (see ``initialization.initialize``).

    Raises:
        InputError: the file cannot be read or is not a pose graph; the message names file and line.
    """
    content = _Content()
    for number, line in _lines(path):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            _take(content, words, number)
        except ValueError as error:
            raise InputError(f"{path}: line {number}: {error}") from error
    return _assemble(content, path)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        with open_unpacked(path) as file:
            for number, line in enumerate(iter(lambda: file.readline(_MAXIMUM_LINE + 1), b""), start=1):
                if len(line) > _MAXIMUM_LINE:
                    raise InputError(f"{path}: line {number}: too long for a pose graph")
                yield number, line.decode("ascii")
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: cannot read the pose graph ({error})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file; a pose graph is g2o or TORO") from error


def _take(content: _Content, words: list[str], line: int) -> None:
    tag, rest = words[0], words[1:]
    if tag in _VERTICES:
        _expect(rest, 4, tag)
        name = _id(rest[0])
        if name in content.poses:
            raise ValueError(f"vertex {name} is given twice")
        content.poses[name] = _numbers(rest[1:])
    elif tag in _EDGE_ORDER:
        _expect(rest, 11, tag)
        numbers = _numbers(rest[2:])
        information = np.array([numbers[3 + k] for k in _EDGE_ORDER[tag]]).reshape(3, 3)
        i, j = _id(rest[0]), _id(rest[1])
        content.edges.append((line, Edge(i, j, np.array(numbers[:3]), information, robust=abs(j - i) != 1)))
    elif tag == "FIX":
        content.fixed += map(_id, rest)
    else:
        raise ValueError(f"unknown tag '{tag[:40]}'; known: {', '.join((*_VERTICES, *_EDGE_ORDER, 'FIX'))}")


def _assemble(content: _Content, path: Path) -> G2oGraph:
    named = {name for _, edge in content.edges for name in (edge.i, edge.j)}
    poses = content.poses or {name: [0.0, 0.0, 0.0] for name in named}
    ids = tuple(sorted(poses))
    number_of = {name: number for number, name in enumerate(ids)}
    graph = PoseGraph([poses[name] for name in ids])
    odometry: set[tuple[int, int]] = set()
    for line, edge in content.edges:
        missing = [name for name in (edge.i, edge.j) if name not in number_of]
        if missing:
            raise InputError(f"{path}: line {line}: the edge names vertex {missing[0]}, which no line gives")
        ends = min(edge.i, edge.j), max(edge.i, edge.j)
        robust = edge.robust or ends in odometry
        odometry.add(ends)
        graph.add_edge(Edge(number_of[edge.i], number_of[edge.j], edge.T_i_j, edge.information, robust))
    unknown = set(content.fixed) - set(ids)
    if unknown:
        raise InputError(f"{path}: FIX names vertex {min(unknown)}, which no line gives")
    return G2oGraph(graph, ids, tuple(content.fixed))


def _expect(rest: list[str], count: int, tag: str) -> None:
    if len(rest) != count:
        raise ValueError(f"{tag} takes {count} numbers, not {len(rest)}")


def _id(word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 18):
        raise ValueError(f"'{word[:40]}' is not a vertex id")
    return int(word)


def _numbers(words: list[str]) -> list[float]:
    numbers = [float(word) for word in words]
    if not np.isfinite(numbers).all():
        raise ValueError("numbers must be finite")
    return numbers
