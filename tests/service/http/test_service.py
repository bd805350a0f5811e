"""Answers of the service to robots, viewers and administrators, and the requests that it refuses."""

import hashlib
import io
import json
import re
import threading
import zipfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import ANY

import cv2
import numpy as np
import pytest

from fcslam.cloud import recognition
from fcslam.errors import InputError
from fcslam.features.detector import BUNDLED_NETWORK
from fcslam.maps.palette import ROBOTS
from fcslam.records import Channel, Correction, Keyscan
from fcslam.service.http.state import ServiceState
from fcslam.wire.limits import MAXIMUM_BATCH_BYTES, MAXIMUM_BATCH_PACKETS
from fcslam.wire.messages import Acknowledgement, DetectorUpdate, Hello, Packet
from fcslam.wire.packets import decode, encode, readdress
from tests.scripted import LASER, ScriptedMatcher
from tests.service.http.desk import SCRIPT, A, B, Desk, put_detector
from tests.small_fleet import contents

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]

API = "/api/v1"
SUFFIXES = "png", "pgm", "yaml", "svg", "zip"
PACKETS = f"{API}/robots/a/packets"


@pytest.fixture
def mapped(desk):
    for robot, data in (("a", A), ("b", B)):
        desk.told(desk.send(robot, data))
    return desk


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The same for all tests that only look."""
    with pytest.MonkeyPatch.context() as patch, Desk(tmp_path_factory.mktemp("shown") / "data") as desk:
        patch.setattr(recognition, "PlaceMatcher", ScriptedMatcher)
        patch.setattr(ScriptedMatcher, "script", SCRIPT)
        for robot, data in (("a", A), ("b", B)):
            desk.told(desk.send(robot, data))
        patch.undo()
        yield desk


def get(desk, path, as_="eye"):
    response = desk.ask("GET", f"{API}/{path}", as_)
    assert response.status_code == 200, response.text
    return response


def test_a_robot_hears_what_is_stored_and_where_it_is(mapped):
    told = mapped.told(mapped.send("b", B[-1:]))
    assert told[0] == Acknowledgement("b", 0, len(B) - 1)
    assert isinstance(told[1], Correction)
    known = {"Fcslam-Correction": str(told[1].version)}
    assert mapped.told(mapped.send("b", [], **known)) == told[:1]
    state = mapped.ask("GET", f"{API}/robots/b/state", "b").json()
    assert state == {
        "robot": "b", "epoch": 0, "next": {"0": len(B)}, "correction": told[1].version, "map": 0, "refusals": 0,
        "refused": [],
    }  # fmt: skip
    assert mapped.ask("GET", f"{API}/robots/a/state", "a").json()["next"] == {"0": len(A)}


def test_nothing_that_may_wait_for_a_store_runs_between_the_requests(mapped, monkeypatch):
    """To open the mission that a request is about may wait, too."""
    opened_by, mission = set(), ServiceState.mission.fget
    opening = property(lambda state: opened_by.add(threading.get_ident()) or mission(state))
    monkeypatch.setattr(ServiceState, "mission", opening)
    assert mapped.ask("POST", f"{API}/finalize", "boss").status_code == 200
    assert mapped.serving.ident not in mapped.state.mission.worker.notified_by | opened_by


def test_a_robot_that_is_not_known_has_nothing_stored(desk):
    state = desk.ask("GET", f"{API}/robots/a/state", "a").json()
    empty = {"epoch": None, "next": {}, "correction": -1, "map": None, "refusals": 0, "refused": []}
    assert state == {"robot": "a", **empty}
    assert desk.told(desk.send("a", [])) == []


@pytest.mark.parametrize("data", [[A[0], b"no packet", A[2]], [A[0], B[0]], [A[0], A[1][:-1]]])
def test_a_refused_packet_has_an_index_and_a_reason(desk, data):
    response = desk.send("a", data)
    assert response.status_code == 400
    assert response.json()["index"] == 1
    assert response.json()["error"]
    assert desk.ask("GET", f"{API}/robots/a/state", "a").json()["next"] == {"0": 1}


def test_what_the_worker_refuses_later_is_told_with_every_answer_and_why_on_asking(desk):
    assert desk.send("a", A[:9]).headers["Fcslam-Refused"] == "0"
    again = next(k for k, data in enumerate(A) if isinstance(decode(data).body, Keyscan))
    desk.told(desk.send("a", [readdress(A[again], 0, 9)]))
    assert desk.send("a", []).headers["Fcslam-Refused"] == "1"
    (refused,) = desk.ask("GET", f"{API}/robots/a/state", "a").json()["refused"]
    assert (refused["epoch"], refused["sequence"], "keyscan" in refused["reason"]) == (0, 9, True)
    assert get(desk, "robots/a").json()["refused"] == [refused]
    assert desk.send("b", B[:2]).headers["Fcslam-Refused"] == "0", "it is not its own"


@pytest.mark.parametrize("announced", [True, False])
def test_a_body_that_is_too_long_is_not_read(desk, announced):
    body = b"\0" * (MAXIMUM_BATCH_BYTES + 1)
    content = body if announced else iter([body[: 2**19], body[2**19 :]])
    response = desk.ask("POST", PACKETS, "a", content=content)
    assert response.status_code == 413
    assert desk.state.mission.store.envelopes() == []


def test_a_robot_that_sends_too_much_has_to_wait_as_long_as_it_is_told(desk):
    statuses = [desk.send("a", A[:1] * MAXIMUM_BATCH_PACKETS).status_code for _ in range(25)]
    limit = statuses.index(429)
    assert set(statuses[:limit]) == {200}
    response = desk.send("a", A[:1] * MAXIMUM_BATCH_PACKETS)
    assert desk.send("b", B[:1]).status_code == 200
    desk.now += int(response.headers["Retry-After"])
    assert desk.send("a", A[:1] * MAXIMUM_BATCH_PACKETS).status_code == 200


def test_a_full_disk_is_507_and_nothing_is_acknowledged(desk):
    desk.told(desk.send("a", A[:3]))
    database = desk.state.mission.store._database
    pages = database.value("PRAGMA page_count")
    database.share(lambda connection: connection.execute(f"PRAGMA max_page_count={pages}"))
    response = desk.send("a", A[3:])
    assert response.status_code == 507
    assert "full" in response.json()["error"]
    database.share(lambda connection: connection.execute("PRAGMA max_page_count=1000000"))
    assert desk.told(desk.send("a", A[3:]))[0] == Acknowledgement("a", 0, len(A) - 1)


def one_map(robots, layers):
    summary = {"map": 0, "floor": "", "zoom": 5, "extent": ANY, "in_space": False, "georeferenced": False}
    return {**summary, "robots": robots, "layers": layers}


def test_viewers_see_the_fleet(shown):
    fleet = get(shown, "fleet").json()
    assert (fleet["robots"], fleet["maps"], fleet["packets"]) == (["a", "b"], 1, len(A) + len(B))
    robots = get(shown, "robots").json()
    assert [(robot["session"], robot["map"], robot["packets"]) for robot in robots] == [
        ("a", 0, len(A)),
        ("b", 0, len(B)),
    ]
    assert get(shown, "robots/a").json()["refused"] == []
    assert shown.ask("GET", f"{API}/robots/c", "eye").status_code == 404
    accepted = get(shown, "closures?status=accepted").json()
    assert len(accepted) == 4
    assert {(c["robot_i"], c["robot_j"]) for c in accepted} == {("a", "b")}
    assert get(shown, "closures?status=accepted&limit=3").json() == accepted[1:]
    assert get(shown, "maps").json() == [one_map(["a", "b"], ["quality", "changes"])]


def test_viewers_see_the_floors(desk, scripted):
    scripted()
    above = [encode(decode(data).on_floor("2")) for data in B]
    for robot, data in (("a", A), ("b", above)):
        desk.told(desk.send(robot, data))
    assert [(found["floor"], found["robots"]) for found in get(desk, "maps").json()] == [("", ["a"]), ("2", ["b"])]
    assert {robot["robot"]: robot["floor"] for robot in get(desk, "robots").json()} == {"a": "", "b": "2"}
    assert get(desk, "closures").json() == []
    joined = {
        "robot_i": "a", "stamp_i": 0.0, "robot_j": "b", "stamp_j": 500.0, "T_i_j": [0, 0, 0], "tolerance": [0.1, 0.1],
    }  # fmt: skip
    refused = edit(desk, "closure", joined)
    assert refused.status_code == 404
    assert refused.json() == {"error": "a and b are on different floors, which no closure joins"}


def test_viewers_get_the_files_of_the_live_run(shown):
    live = shown.state.mission.folder.live
    for path, name in {
        "maps/0.png": "map.png",
        "maps/0.pgm": "map.pgm",
        "maps/0.yaml": "map.yaml",
        "pose_graph.g2o": "pose_graph.g2o",
        "trajectories/b.tum": "trajectories/b.tum",
    }.items():
        assert get(shown, path).content == (live / name).read_bytes()
    for path in ("maps/1.png", "trajectories/c.tum", "maps/0.exe", "trajectories/..%2F..%2Fmission.tum"):
        assert shown.ask("GET", f"{API}/{path}", "eye").status_code in (400, 404)


@pytest.mark.parametrize(
    "path",
    ["maps/0/tiles/5/0/0.png", "maps/0/layers/changes", "closures", *(f"maps/0.{end}" for end in SUFFIXES)],
)
def test_what_did_not_change_is_not_sent_again(shown, path):
    path = f"{API}/{path}"
    first = shown.ask("GET", path, "eye")
    again = shown.ask("GET", path, "eye", headers={"If-None-Match": first.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")
    other = shown.ask("GET", path, "eye", headers={"If-None-Match": '"of another map"'})
    assert (other.status_code, other.content) == (200, first.content)


def test_a_result_can_be_downloaded(mapped, tmp_path):
    answer = mapped.ask("POST", f"{API}/finalize", "boss").json()
    archive = mapped.ask("GET", answer["archive"], "boss")
    assert archive.headers["content-type"] == "application/zip"
    zipfile.ZipFile(io.BytesIO(archive.content)).extractall(tmp_path / "run")
    assert contents(tmp_path / "run") == contents(Path(answer["run"]))
    assert mapped.ask("GET", answer["archive"], "eye").status_code == 403
    assert mapped.ask("GET", f"{API}/missions/mission/runs/99.zip", "boss").status_code == 404
    assert mapped.ask("GET", f"{API}/missions/other/runs/1.zip", "boss").status_code == 404


def edit(mapped, kind, content, who="boss"):
    return mapped.ask("POST", f"{API}/edits", who, json={"kind": kind, "content": content})


def test_who_has_the_first_poses_of_a_trajectory_gets_the_others_unless_those_moved(shown):
    path = "trajectories/a.tum"
    whole = get(shown, path)
    text, digest = whole.text, whole.headers["Fcslam-Digest"]
    assert whole.headers["Fcslam-After"] == "0"
    again = get(shown, f"{path}?after={len(text)}&digest={digest}")
    assert (again.text, again.headers["Fcslam-After"], again.headers["Fcslam-Digest"]) == ("", str(len(text)), digest)
    first = text[: text.index("\n", 100) + 1]
    rest = get(shown, f"{path}?after={len(first)}&digest={hashlib.sha256(first.encode()).hexdigest()}")
    assert first + rest.text == text
    for moved in (
        f"after={len(first)}&digest={digest}",
        f"after={len(text) + 1}&digest={digest}",
        f"after={len(text)}",
    ):
        assert get(shown, f"{path}?{moved}").text == text
    for wrong in ("after=-1", "after=x", "digest=x", f"digest={digest}0"):
        assert shown.ask("GET", f"{API}/{path}?{wrong}", "eye").status_code == 400


def picture_of(closure):
    named = (closure[key] for key in ("channel", "robot_i", "stamp_i", "robot_j", "stamp_j"))
    return "closures/" + "/".join(map(str, named))


def test_a_closure_is_shown_with_what_both_robots_saw_until_it_is_gone(mapped):
    closure = get(mapped, "closures?status=accepted").json()[0]
    path = picture_of(closure)
    assert get(mapped, path).json() == closure
    answer = get(mapped, f"{path}.png")
    assert answer.headers["content-type"] == "image/png"
    pixels = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR_RGB)
    colors = {tuple(color) for color in pixels.reshape(-1, 3).tolist()}
    # the scripted robots stand at the same place and see the same
    assert {(255, 255, 255), tuple(ROBOTS[1].to_bytes(3))} <= colors
    other = picture_of(closure | {"stamp_j": closure["stamp_j"] + 0.25})
    for wrong, status in (
        (f"{path}x", 400),
        (f"{other}.png", 404),
        (other, 404),
        (path.replace("lidar", "sonar"), 400),
    ):
        assert mapped.ask("GET", f"{API}/{wrong}", "eye").status_code == status
    edit(mapped, "removal", {"robot": "b"})
    assert mapped.ask("GET", f"{API}/{path}.png", "eye").status_code == 404


def test_a_vetoed_closure_says_so_and_the_maps_come_apart_with_a_reason(mapped):
    closures = get(mapped, "closures?status=accepted").json()
    between = [closure for closure in closures if closure["robot_i"] != closure["robot_j"]]
    (verdict,) = get(mapped, "verdicts").json()
    assert (verdict["robots"], verdict["map"]) == (["a", "b"], 0)
    assert verdict["details"][0].startswith("joined: a and b: ")
    assert edit(mapped, "veto", {"robot_i": "a", "robot_j": "b"}).status_code == 201
    now = get(mapped, picture_of(between[0])).json()
    assert (now["reason"], now["explanation"]) == ("vetoed", "vetoed by hand")
    first, second = (one["sentence"] for one in get(mapped, "verdicts").json())
    assert f"b has another map ({len(between)} verified closures, but vetoed by hand)" in first
    assert "a has another map" in second
    (made,) = get(mapped, "edits").json()
    assert (made["kind"], made["author"], made["undone_by"]) == ("veto", "boss", None)
    assert len(get(mapped, "maps").json()) == 2
    both = {"robot_i": "a", "robot_j": "b"}
    for wrong, status in (
        ({"robot_i": "a", "robot_j": "x"}, 404), ({"robot_i": "a"}, 409), ({**both, "stamps": [1.0]}, 409),
        ({**both, "stamps": [1.0, None]}, 409), ({"robot_i": "a", "robot_j": ""}, 409), ({**both, "more": 1}, 409),
        ({**both, "stamps": [1.0, 1e9]}, 404),
    ):  # fmt: skip
        assert edit(mapped, "veto", wrong).status_code == status, wrong
    assert "b+x" in edit(mapped, "veto", {"robot_i": "a", "robot_j": "b+x"}).text


def test_a_removed_robot_leaves_the_map_and_comes_back(mapped):
    removed = edit(mapped, "removal", {"robot": "b"}).json()
    assert (removed["number"], removed["kind"], removed["author"]) == (1, "removal", "boss")
    assert get(mapped, "maps").json() == [one_map(["a"], ["quality"])]
    assert get(mapped, "closures").json() == []
    undone = mapped.ask("POST", f"{API}/edits/1/undo", "boss").json()
    assert (undone["kind"], undone["content"]) == ("undo", {"number": 1})
    assert get(mapped, "maps").json() == [one_map(["a", "b"], ["quality", "changes"])]
    edits = mapped.ask("GET", f"{API}/edits", "boss").json()
    assert [(edit["number"], edit["undone_by"]) for edit in edits] == [(1, 2), (2, None)]
    for kind, wrong, status in (
        ("removal", {"robot": "x"}, 404), ("removal", {"robot": "b+1"}, 404), ("removal", {}, 409),
        ("removal", {"robot": "b", "epoch": -1}, 409), ("removal", {"robot": "b", "epoch": 1}, 404),
        ("undo", {"number": 1}, 400), ("rumour", {}, 400), ("cut", {"session": "b", "first_s": 2, "last_s": 1}, 409),
    ):  # fmt: skip
        assert edit(mapped, kind, wrong).status_code == status, (kind, wrong)
    for number, status in (("1", 409), ("9", 409), ("x", 400)):
        assert mapped.ask("POST", f"{API}/edits/{number}/undo", "boss").status_code == status
    assert edit(mapped, "removal", {"robot": "b"}, "eye").status_code == 403


def test_a_robot_that_ended_is_not_silent_until_it_sends_again(mapped):
    ended = lambda: {robot["robot"]: robot["ended"] for robot in get(mapped, "robots").json()}  # noqa: E731
    assert ended() == {"a": False, "b": False}
    mapped.send("b", [], **{"Fcslam-Ended": "1"})
    assert ended() == {"a": False, "b": True}
    mapped.told(mapped.send("b", [], **{"Fcslam-Agent": "another"}))  # need not wait for the first one's time
    assert ended() == {"a": False, "b": False}


def test_a_robot_is_told_that_it_is_removed(mapped):
    assert mapped.send("b", []).headers["Fcslam-Removed"] == "0"
    edit(mapped, "removal", {"robot": "b", "epoch": 0})
    assert mapped.send("b", []).headers["Fcslam-Removed"] == "1"
    assert mapped.send("a", []).headers["Fcslam-Removed"] == "0"
    assert [robot["removed"] for robot in get(mapped, "robots").json()] == [False, True]


def test_the_service_is_ready_when_the_worker_has_caught_up(desk, monkeypatch):
    current = {"status": "ready", "backlog": 0, "lacking_packets": 0, "lacking_sessions": 0, "lacking_s": 0.0}
    assert desk.ask("GET", "/readyz").json() == current
    worker = desk.state.mission.worker
    notify, worker.notify = worker.notify, lambda: None
    monkeypatch.setattr("fcslam.service.http.app.LARGEST_BACKLOG", 5)
    for count, status in ((5, 200), (6, 503)):
        desk.told(desk.send("a", A[:count]))
        answer = desk.ask("GET", "/readyz")
        assert (answer.status_code, answer.json()["backlog"]) == (status, count)
        shown = get(desk, "fleet").json()
        assert (shown["lacking_packets"], shown["lacking_sessions"]) == (count, 1)
        assert shown["lacking_s"] > 0.0
    assert "6 packets" in answer.json()["error"]
    assert desk.ask("GET", "/healthz").status_code == 200
    notify()
    assert desk.ask("GET", "/readyz").json() == current
    worker.is_ready = False
    assert desk.ask("GET", "/readyz").status_code == 503


def test_the_audit_log_says_who_did_what(mapped):
    edit(mapped, "removal", {"robot": "b"})
    edit(mapped, "removal", {"robot": "a"}, "eye")
    mapped.ask("POST", f"{API}/edits/7/undo", "boss")
    mapped.ask("GET", f"{API}/fleet", "eye")
    mapped.ask("GET", f"{API}/missions/mission/export?x=1", "boss")
    told = mapped.ask("GET", f"{API}/audit", "boss").json()
    assert [(line["who"], line["action"], line["status"], line["content"]) for line in told] == [
        ("boss", f"POST {API}/edits", 201, {"kind": "removal", "content": {"robot": "b"}}),
        ("eye", f"POST {API}/edits", 403, {}),
        ("boss", f"POST {API}/edits/7/undo", 409, {}),
        ("boss", f"GET {API}/missions/mission/export?x=1", 200, {}),
    ]
    assert {(line["address"], line["time"]) for line in told} == {("127.0.0.1", "2001-09-09T01:46:40Z")}
    (newest,) = mapped.ask("GET", f"{API}/audit?limit=1", "boss").json()
    assert newest["action"] == f"GET {API}/audit"


def test_refused_logins_are_counted_in_few_lines(desk):
    def refused():
        lines = desk.ask("GET", f"{API}/audit", "boss").json()
        return [line["content"]["count"] for line in lines if line["action"] == "refused logins"]

    for _ in range(5):
        desk.ask("GET", f"{API}/fleet", "stranger")
    assert refused() == [1]
    desk.now += 61.0
    desk.ask("GET", f"{API}/fleet")
    assert refused() == [1, 5]


def test_missions_are_begun_opened_and_rest_as_they_were(mapped):
    assert mapped.ask("POST", f"{API}/missions", "boss", json={"name": "next"}).json() == {
        "open": "next",
        "missions": ["mission", "next"],
    }
    assert get(mapped, "fleet").json()["packets"] == 0
    mapped.told(mapped.send("a", A[:5]))
    mapped.ask("POST", f"{API}/missions/mission/open", "boss")
    assert get(mapped, "fleet").json()["packets"] == len(A) + len(B)
    mapped.ask("POST", f"{API}/missions/next/open", "boss")
    assert get(mapped, "fleet").json()["packets"] == 5
    long = mapped.ask("POST", f"{API}/missions", "boss", json={"name": "x" * 70_000})
    assert (long.status_code, "over" in long.json()["error"]) == (413, True)
    for wrong in ("next", "../x", "", ".hidden"):
        assert mapped.ask("POST", f"{API}/missions", "boss", json={"name": wrong}).status_code in (400, 409)
    assert mapped.ask("POST", f"{API}/missions/none/open", "boss").status_code == 404


def test_a_mission_travels_as_one_file(mapped, tmp_path, scripted):
    content = mapped.ask("GET", f"{API}/missions/mission/export", "boss").content
    with Desk(tmp_path / "elsewhere") as other:
        response = other.ask("POST", f"{API}/missions/import?name=brought", "boss", content=content)
        assert response.json() == {"open": "mission", "missions": ["brought", "mission"]}
        other.ask("POST", f"{API}/missions/brought/open", "boss")
        other.state.mission.worker.notify()
        assert get(other, "maps").json() == get(mapped, "maps").json()
        assert other.ask("GET", f"{API}/robots/a/state", "a").json()["next"] == {"0": len(A)}
        for name, wrong, status in (
            ("brought", content, 409),
            ("broken", content[:1000], 400),
            ("text", b"hello", 400),
        ):
            refused = other.ask("POST", f"{API}/missions/import?name={name}", "boss", content=wrong)
            assert refused.status_code == status
        assert other.state.missions.names == ["brought", "mission"]


def test_the_open_mission_is_open_again_when_the_service_starts_again(tmp_path, scripted):
    scripted()
    with Desk(tmp_path / "data") as desk:
        desk.ask("POST", f"{API}/missions", "boss", json={"name": "next"})
        desk.told(desk.send("a", A[:5]))
    with Desk(tmp_path / "data") as again:
        assert again.state.mission.folder.name == "next"
        assert again.told(again.send("a", A[5:6]))[:1] == [Acknowledgement("a", 0, 5)]


def test_two_services_do_not_share_a_folder(desk):
    with pytest.raises(InputError, match="another service"):
        Desk(desk.state.missions.root)


def uplink(desk, robot):
    """Bytes of one robot, by the measures."""
    lines = (line.rsplit(" ", 1) for line in get(desk, "../../metrics").text.splitlines())
    bytes_ = {name: float(value) for name, value in lines if name.startswith("fcslam_bytes_total{")}
    return sum(value for name, value in bytes_.items() if f'robot="{robot}"' in name)


def test_every_panel_of_the_dashboard_asks_for_a_metric_that_there_is(shown):
    text = get(shown, "../../metrics").text
    there = {line.split()[2] for line in text.splitlines() if line.startswith("# TYPE fcslam_")}
    there -= {name for name in there if name.endswith("_created")}
    dashboard = json.loads((ROOT / "docs" / "howto" / "grafana.json").read_text(encoding="utf-8"))
    asked = [
        set(re.findall(r"fcslam_\w+", target["expr"])) for panel in dashboard["panels"] for target in panel["targets"]
    ]
    assert all(asked)
    assert set().union(*asked) == there
    described = set(re.findall(r"`(fcslam_\w+)`", (ROOT / "docs" / "howto" / "monitor.md").read_text(encoding="utf-8")))
    assert described == there


def test_what_robots_sent_is_counted_on_when_the_service_starts_again(tmp_path, scripted):
    scripted()
    with Desk(tmp_path / "data") as desk:
        desk.told(desk.send("a", A[:5]))
        before = uplink(desk, "a")
        desk.told(desk.send("a", A[3:9]))
        assert (before, uplink(desk, "a")) == (sum(map(len, A[:5])), sum(map(len, A[:9]))), "again is not new"
        assert desk.send("a", [A[9][:-1]]).status_code == 400
        refused = uplink(desk, "a")
    with Desk(tmp_path / "data") as again:
        assert uplink(again, "a") == refused >= before
        again.told(again.send("b", B[:4]))
        assert (uplink(again, "a"), uplink(again, "b")) == (refused, sum(map(len, B[:4])))
        again.ask("POST", f"{API}/missions", "boss", json={"name": "next"})
        again.told(again.send("a", A[:2]))
        assert uplink(again, "a") == refused + sum(map(len, A[:2])), "missions are told apart, and none is forgotten"


def test_a_robot_can_fetch_a_detector(desk):
    put_detector(desk, b"network")
    assert desk.ask("GET", f"{API}/detectors/camera/v1", "a").content == b"network"
    assert get(desk, "detectors").json() == [{"channel": "camera", "version": "v1", "announced": False}]
    assert desk.ask("GET", f"{API}/detectors/camera/v2", "a").status_code == 404
    assert desk.ask("GET", f"{API}/detectors/smell/v1", "a").status_code == 400


def test_robots_with_a_camera_are_told_of_a_newer_detector_until_they_have_it(desk):
    network = BUNDLED_NETWORK.read_bytes()
    version = desk.ask("POST", f"{API}/detectors", "boss", content=network).json()["version"]
    hello = Hello("a", 0, (LASER,), {Channel.CAMERA: "orb-1", Channel.LIDAR: "test-1"})
    told = desk.told(desk.send("a", [encode(Packet("a", 0, 0, 0.0, hello))]))
    release = next(body for body in told if isinstance(body, DetectorUpdate))
    assert (release.file.version, release.file.size) == (version, len(network))
    assert desk.ask("GET", f"{API}/detectors/camera/{version}", "a").content == network
    assert any(isinstance(body, DetectorUpdate) for body in desk.told(desk.send("a", [])))
    again = replace(hello, detector_versions={**hello.detector_versions, Channel.CAMERA: version})
    assert desk.told(desk.send("a", [encode(Packet("a", 0, 1, 0.0, again))])) == [Acknowledgement("a", 0, 1)]
    assert not any(isinstance(body, DetectorUpdate) for body in desk.told(desk.send("b", B[:2]))), "it has no camera"
    assert get(desk, "detectors").json() == [{"channel": "camera", "version": version, "announced": True}]
    assert desk.ask("POST", f"{API}/detectors", "boss", content=b"no network").status_code == 400


def test_an_administrator_goes_back_to_an_older_detector(desk):
    old = BUNDLED_NETWORK.read_bytes()
    announce = [desk.ask("POST", f"{API}/detectors", "boss", content=old).json()["version"]]
    new = old.replace(announce[0].rpartition("-")[2].encode(), b"0123456789ab")
    announce += [desk.ask("POST", f"{API}/detectors", "boss", content=each).json()["version"] for each in (new, old)]
    assert announce[0] == announce[2] != announce[1]
    hello = Hello("a", 0, (LASER,), {Channel.CAMERA: announce[1], Channel.LIDAR: "test-1"})
    told = desk.told(desk.send("a", [encode(Packet("a", 0, 0, 0.0, hello))]))
    assert [body.file.version for body in told if isinstance(body, DetectorUpdate)] == [announce[0]]
