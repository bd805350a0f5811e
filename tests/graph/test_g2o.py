"""Files: the round trip is exact, TORO's order differs, broken files say where."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from evaluation.g2o_files import read_g2o

from fcslam.errors import InputError
from fcslam.graph.g2o import g2o_text
from tests.graph.graph_worlds import manhattan

VERTICES = "VERTEX_SE2 3 0 0 0\nVERTEX_SE2 7 1 0 0\n"
EDGE = "EDGE_SE2 3 7 1 0 0.1 9 1 2 8 3 7\n"


@pytest.mark.parametrize("name", ["graph.g2o", "graph.g2o.gz"])
def test_round_trip_is_exact(tmp_path: Path, name: str) -> None:
    graph, _, _ = manhattan(0, steps=40, closures=20, outlier_share=0.3)
    ids = [10 + k for k in range(len(graph))]
    text = (g2o_text(graph, ids) + "FIX 10\n").encode("ascii")
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    back = read_g2o(tmp_path / name)
    assert back.ids == tuple(ids)
    assert back.fixed == (10,)
    assert back.graph.poses().tobytes() == graph.poses().tobytes()
    for old, new in zip(graph.edges, back.graph.edges, strict=True):
        assert (old.i, old.j) == (new.i, new.j)
        assert new.robust == (abs(old.i - old.j) != 1)
        assert old.T_i_j.tobytes() == new.T_i_j.tobytes()
        assert old.information.tobytes() == new.information.tobytes()
    assert (g2o_text(back.graph, back.ids) + "FIX 10\n").encode("ascii") == text


def test_both_formats_give_the_same_matrix(tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text("# a comment\n\n" + VERTICES + EDGE)
    (tmp_path / "a.toro").write_text("VERTEX2 3 0 0 0\nVERTEX2 7 1 0 0\nEDGE2 3 7 1 0 0.1 9 1 8 7 2 3\n")
    for name in ("a.g2o", "a.toro"):
        edge = read_g2o(tmp_path / name).graph.edges[0]
        assert edge.information.tolist() == [[9, 1, 2], [1, 8, 3], [2, 3, 7]]
        assert (edge.i, edge.j, edge.robust) == (0, 1, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (VERTICES + "VERTEX_SE3 1 2\n", "line 3: unknown tag 'VERTEX_SE3'"),
        (VERTICES + "EDGE_SE2 3 7 1 0 0.1 9 1 2 8 3\n", "line 3: EDGE_SE2 takes 11 numbers, not 10"),
        (VERTICES + EDGE.replace("0.1", "nan"), "line 3: numbers must be finite"),
        (VERTICES + EDGE.replace("0.1", "x"), "line 3: could not convert"),
        (VERTICES + EDGE.replace("3 7 1", "3 8 1"), "line 3: the edge names vertex 8"),
        (VERTICES + EDGE.replace("3 7 1", "3 3 1"), "line 3: edge 3 -> 3"),
        (VERTICES + EDGE.replace(" 9 1", " -9 1"), "line 3: .*not positive definite"),
        (VERTICES + "VERTEX_SE2 3 0 0 0\n", "line 3: vertex 3 is given twice"),
        ("VERTEX_SE2 -3 0 0 0\n", "line 1: '-3' is not a vertex id"),
        (f"VERTEX_SE2 {'9' * 5000} 0 0 0\n", "line 1: too long"),
        (VERTICES + "FIX 4\n", "FIX names vertex 4"),
        ("\xff\xfe", "not a text file"),
    ],
)
def test_a_broken_file_says_where(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "broken.g2o"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=f"broken.g2o: {message}"):
        read_g2o(path)


def test_a_broken_archive_is_refused(tmp_path: Path) -> None:
    whole = gzip.compress((VERTICES + EDGE).encode())
    for name, data in (("cut.gz", whole[:-12]), ("bits.gz", whole[:15] + b"\xff" * 20)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=name):
            read_g2o(tmp_path / name)
    with pytest.raises(InputError, match="nowhere"):
        read_g2o(tmp_path / "nowhere.g2o")


def test_ids_must_fit() -> None:
    graph, _, _ = manhattan(0, steps=2, closures=0)
    for ids in ([1, 2], [1, 2, 2]):
        with pytest.raises(ValueError, match="different ids"):
            g2o_text(graph, ids)
    assert np.isfinite(graph.poses()).all()


def test_a_second_edge_between_consecutive_vertices_is_a_closure(tmp_path) -> None:
    """A false loop may join two neighbours: trusted as odometry it would tear the graph."""
    (path := tmp_path / "graph.g2o").write_text(
        "EDGE_SE2 0 1 1 0 0 9 0 0 9 0 9\nEDGE_SE2 1 2 1 0 0 9 0 0 9 0 9\nEDGE_SE2 1 0 5 5 1 9 0 0 9 0 9\n"
    )
    assert [edge.robust for edge in read_g2o(path).graph.edges] == [False, False, True]
