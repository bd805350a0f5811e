"""`fcslam tools changes`: a run folder of two days in, what changed out; and what it refuses."""

import csv
from datetime import UTC, datetime

import numpy as np
import pytest

import fcslam
from fcslam.cli import main
from fcslam.cloud.settings import CloudConfig
from fcslam.errors import InputError, SourceError
from fcslam.maps.occupancy_map import Occupancy, parse_map
from fcslam.mission.mission_file import as_stored, mission_bytes
from fcslam.records import Keyscan, KeyscanId
from fcslam.runs import Metric, RobotTrajectory, Run
from fcslam.wire.messages import Hello, Packet
from fcslam.wire.packets import measure
from fcslam.wire.quantisation import dequantise, quantise
from tests.maps.test_changes import LASER, session

DAY_S = 86_400.0
MONDAY_S = datetime(2026, 11, 16, 9, 0, tzinfo=UTC).timestamp()
BOXES = [(1.0, 1.0, 0.3)], [(1.0, -1.0, 0.3)], [(1.0, -1.0, 0.3), (0.0, 2.0, 0.2)]


def write_run(folder, days):
    """A robot that drives on these days, a session a day; the day tells where the boxes are."""
    packets, trajectories = [], {}
    for epoch, day in enumerate(days):
        name = f"anna+{epoch}" if epoch else "anna"
        keyscans, poses = session(name, MONDAY_S + day * DAY_S, BOXES[day], seed=day)
        bodies = [
            Hello("anna", epoch, (LASER,), {}),
            *(Keyscan(KeyscanId("anna", k.id.number), k.stamp, dequantise(quantise(k.ranges_m))) for k in keyscans),
        ]
        packets += [
            as_stored(measure(Packet("anna", epoch, number, keyscans[0].stamp + number, body)))
            for number, body in enumerate(bodies)
        ]
        stamps = np.array([keyscan.stamp for keyscan in keyscans])
        trajectories[name] = RobotTrajectory(name, 0, stamps, poses)
    mission = mission_bytes(CloudConfig(), (), packets, (), {})
    Run(trajectories, metrics={"maps": Metric("maps", 1, "1")}, mission=mission).save(folder)
    return folder


@pytest.fixture(scope="module")
def three_days(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "building", (0, 1, 2))


def kinds(changes):
    return sorted((region.kind, round(region.x), round(region.y), region.sessions) for region in changes.regions)


def test_all_days_together_show_what_moved_and_what_came(three_days):
    assert kinds(fcslam.changes(three_days)) == [
        ("appeared", 0, 2, ("anna+2",)),
        ("appeared", 1, -1, ("anna+1",)),
        ("disappeared", 1, 1, ("anna+1",)),
    ]


@pytest.mark.parametrize(
    ("since", "until"),
    [
        ("anna+1", None),
        ("2026-11-17", None),
        ("2026-11-17T20:00", "2026-11-18T20:00+00:00"),
        (str(MONDAY_S + 1.5 * DAY_S), "anna+2"),
    ],
)
def test_a_session_a_date_a_time_and_a_stamp_name_a_time(three_days, since, until):
    assert kinds(fcslam.changes(three_days, since=since, until=until)) == [("appeared", 0, 2, ("anna+2",))]


def test_until_leaves_later_sessions_out(three_days):
    found = fcslam.changes(three_days, until="2026-11-17")
    assert [kind for kind, *_ in kinds(found)] == ["appeared", "disappeared"]


def test_the_command_writes_grids_a_picture_and_a_table(three_days, tmp_path, capsys):
    assert main(["tools", "changes", str(three_days), "-o", str(tmp_path / "week")]) == 0
    out = capsys.readouterr().out
    assert "appeared: 2 regions" in out
    assert "disappeared: 1 region," in out
    names = {path.name for path in (tmp_path / "week").iterdir()}
    grids = {f"{kind}.{ending}" for kind in ("appeared", "disappeared") for ending in ("pgm", "yaml")}
    assert names == {"changes.csv", "changes.png", *grids}
    found = fcslam.changes(three_days)
    for kind, mask in (("appeared", found.appeared), ("disappeared", found.disappeared)):
        text = (tmp_path / "week" / f"{kind}.yaml").read_text()
        layer = parse_map(kind, (tmp_path / "week" / f"{kind}.pgm").read_bytes(), text)
        assert np.array_equal(layer.cells == Occupancy.OCCUPIED, mask)
    rows = list(csv.DictReader((tmp_path / "week" / "changes.csv").read_text().splitlines()))
    assert [row["sessions"] for row in rows] == [" ".join(region.sessions) for region in found.regions]
    areas = [float(row["area_m2"]) for row in rows]
    assert areas == sorted(areas, reverse=True)


def test_a_folder_is_replaced_with_force_only_and_only_if_it_holds_changes(three_days, tmp_path):
    fcslam.changes(three_days, output=tmp_path / "week")
    with pytest.raises(InputError, match="already holds changes; name a new folder or give --force"):
        fcslam.changes(three_days, output=tmp_path / "week")
    fcslam.changes(three_days, output=tmp_path / "week", force=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="does not hold changes; name a new folder"):
        fcslam.changes(three_days, output=tmp_path / "other", force=True)
    assert (tmp_path / "other" / "letter.txt").read_text() == "dear"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"since": "tuesday"}, "'tuesday': neither a session of this map, a stamp in seconds nor a date"),
        ({"since": "nan"}, "neither a session"),
        ({"since": "2020-01-01"}, "no session had ended by then; the first is anna "),
        ({"since": "anna+2"}, "nothing to compare: no session between anna"),
        ({"since": "anna+1", "until": "anna"}, "nothing to compare"),
        ({"map_index": 3}, "has no map 3"),
    ],
)
def test_what_cannot_be_compared_is_told_in_one_line(three_days, arguments, message):
    with pytest.raises(SourceError) as caught:
        fcslam.changes(three_days, **arguments)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_run_of_one_day_or_without_a_mission_is_refused(tmp_path):
    with pytest.raises(SourceError, match="the map has 1 period: anna"):
        fcslam.changes(write_run(tmp_path / "one", (0,)))
    (tmp_path / "one" / "mission.fcslam").unlink()
    with pytest.raises(SourceError, match="no such file"):
        fcslam.changes(tmp_path / "one")
    assert main(["tools", "changes", str(tmp_path / "nowhere")]) == 2
