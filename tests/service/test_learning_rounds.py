"""The table of rounds that `fcslam tools federate` writes, read for the page."""

import pytest

from fcslam.errors import InputError
from fcslam.learning.federated.rounds import ROUNDS_FILE, Evaluation, RoundReport, write_rows
from fcslam.service.http import fleet
from fcslam.service.http.fleet import read_rounds


def test_the_table_of_a_training_is_read(tmp_path):
    judged = Evaluation({"mma_3px": 0.25}, 0.4, released=True)
    first = RoundReport(1, "light-a", ("anna", "bob"), {"cleo": "too late"}, {"triplet": 0.5}, judged)
    second = RoundReport(2, "light-b", ("bob",), losses={"triplet": float("nan")})
    assert fleet.ROUNDS_FILE == ROUNDS_FILE
    write_rows(tmp_path / ROUNDS_FILE, [first.row(), second.row()])
    one, two = read_rounds(tmp_path)
    assert (one.round, one.version, one.released, one.robots) == (1, "light-a", True, ["anna", "bob"])
    assert one.left_out == "cleo: too late"
    assert (one.losses, one.measures) == ({"triplet": 0.5}, {"mma_3px": 0.25})
    assert (two.released, two.robots, two.losses, two.measures) == (False, ["bob"], {}, {})


def test_before_the_first_round_there_is_none(tmp_path):
    assert read_rounds(tmp_path) == []


@pytest.mark.parametrize(
    "content", [b"round,version\n1,a\n", b"round,version,released,robots,left_out\nx,a,1,r,\n", b"\xff\xfe"]
)
def test_a_damaged_table_is_refused(tmp_path, content):
    (tmp_path / ROUNDS_FILE).write_bytes(content)
    with pytest.raises(InputError, match="not a table of rounds"):
        read_rounds(tmp_path)
