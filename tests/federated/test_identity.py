"""Which robot a request is by: the one whose private key has signed exactly this request a short time ago."""

from dataclasses import replace

import pytest
from cryptography.hazmat.primitives.asymmetric import ec

pytest.importorskip("torch", reason="needs fcslam[federated]")
pytest.importorskip("flwr", reason="needs fcslam[federated]")

from fcslam.errors import TrainingError
from fcslam.federated.identity import (
    CLOCK_TOLERANCE_S,
    DIGEST_HEADER,
    ROBOT_HEADER,
    SIGNATURE_HEADER,
    TIME_HEADER,
    RefusedRequestError,
    RobotAuthenticator,
    RobotIdentity,
    read_private_key,
    read_robot_keys,
)
from tests.federated.authority import keys

NOW_S = 1.8e9
KEY, OTHER_KEY = ec.generate_private_key(ec.SECP384R1()), ec.generate_private_key(ec.SECP384R1())
ROBOT = RobotIdentity("one", KEY, lambda: NOW_S)
SERVER = RobotAuthenticator({"one": KEY.public_key(), "two": OTHER_KEY.public_key()}, lambda: NOW_S)
REQUEST = ("POST", "/fleet/next")


def test_a_robot_is_known_by_its_signature():
    headers = ROBOT.headers(*REQUEST, b"body")
    assert SERVER.robot(*REQUEST, headers) == "one"
    SERVER.check_body(headers, b"body")


@pytest.mark.parametrize("name", ["Größe", "a b/c", "x" * 64])
def test_a_name_may_have_any_printable_characters(name):
    server = RobotAuthenticator({name: KEY.public_key()}, lambda: NOW_S)
    assert server.robot(*REQUEST, replace(ROBOT, name=name).headers(*REQUEST, b"")) == name


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({ROBOT_HEADER: "two"}, r"not signed with the private key of two\.pub"),
        ({ROBOT_HEADER: "three"}, r"no key three\.pub"),
        ({ROBOT_HEADER: ""}, "names no robot"),
        ({ROBOT_HEADER: "%0Aone"}, "names no robot"),
        ({ROBOT_HEADER: "x" * 65}, "names no robot"),
        ({TIME_HEADER: f"{NOW_S + 1:.3f}"}, "not signed"),
        ({TIME_HEADER: "nan"}, "not signed"),
        ({DIGEST_HEADER: "0" * 64}, "not signed"),
        ({SIGNATURE_HEADER: ""}, "not signed"),
        ({SIGNATURE_HEADER: "?"}, "not signed"),
        ({SIGNATURE_HEADER: "é"}, "not signed"),
        ({SIGNATURE_HEADER: "AAAA"}, "not signed"),
    ],
)
def test_a_changed_request_is_refused(change, reason):
    with pytest.raises(RefusedRequestError, match=reason):
        SERVER.robot(*REQUEST, ROBOT.headers(*REQUEST, b"body") | change)


def test_a_signature_is_good_for_one_operation():
    with pytest.raises(RefusedRequestError, match="not signed"):
        SERVER.robot("POST", "/fleet/alive", ROBOT.headers(*REQUEST, b""))


@pytest.mark.parametrize("skew_s", [-CLOCK_TOLERANCE_S - 1.0, CLOCK_TOLERANCE_S + 1.0, float("nan")])
def test_an_old_signature_and_another_clock_are_refused(skew_s):
    robot = replace(ROBOT, wall_clock=lambda: NOW_S + skew_s)
    with pytest.raises(RefusedRequestError, match="clock differs"):
        SERVER.robot(*REQUEST, robot.headers(*REQUEST, b""))


def test_another_body_is_refused():
    with pytest.raises(RefusedRequestError, match="not the one that was signed"):
        SERVER.check_body(ROBOT.headers(*REQUEST, b"body"), b"another")


def test_keys_are_named_after_their_robots(tmp_path):
    keys(tmp_path, "one", "two")
    known = read_robot_keys([tmp_path / "one.pub", tmp_path / "two.pub"])
    assert known["one"] == read_private_key(tmp_path / "one").public_key()
    with pytest.raises(TrainingError, match=r"one\.pub: another key is that of one too"):
        read_robot_keys([tmp_path / "one.pub", tmp_path / "one.pub"])
    with pytest.raises(TrainingError, match="is not a public key"):
        read_robot_keys([tmp_path / "one"])
    with pytest.raises(TrainingError, match="is not a private key"):
        read_private_key(tmp_path / "one.pub")
