"""`fcslam setup tokens`: tokens are added, replaced and revoked; the file always is one that the service can read."""

import os
from datetime import UTC, datetime

import pytest

from fcslam.cli import main
from fcslam.service.http.authentication import Authenticator, Identity, Role, read_tokens


@pytest.fixture
def tokens(tmp_path):
    def run(*arguments, name="tokens.yaml"):
        return main(["setup", "tokens", *arguments, "--tokens", str(tmp_path / name)])

    run.path, run.folder = tmp_path / "tokens.yaml", tmp_path
    return run


def who(tokens, token_file, now=datetime(2027, 1, 1, tzinfo=UTC)):
    token = (tokens.folder / token_file).read_text().strip()
    return Authenticator(read_tokens(tokens.path), lambda: now).who(f"Bearer {token}")


def test_a_token_counts_until_it_is_rotated_or_revoked(tokens):
    first, second = str(tokens.folder / "first"), str(tokens.folder / "second")
    assert tokens("add", "anna", "--role", "robot", "-o", first) == 0
    assert who(tokens, "first") == Identity("anna", Role.ROBOT)
    assert (tokens.folder / "first").stat().st_mode & 0o077 == 0
    assert tokens("rotate", "anna", "-o", second) == 0
    assert who(tokens, "first") is None
    assert who(tokens, "second") == Identity("anna", Role.ROBOT)
    assert tokens("revoke", "anna") == 0
    assert who(tokens, "second") is None


def test_a_token_ends_at_the_beginning_of_its_day(tokens):
    assert tokens("add", "eye", "--role", "viewer", "-o", str(tokens.folder / "t"), "--expires", "2027-02-01") == 0
    assert who(tokens, "t", datetime(2027, 1, 31, 23, 59, tzinfo=UTC)) == Identity("eye", Role.VIEWER)
    assert who(tokens, "t", datetime(2027, 2, 1, tzinfo=UTC)) is None


def test_the_list_shows_no_token(tokens, capsys):
    tokens("add", "anna", "--role", "robot", "-o", str(tokens.folder / "a"))
    tokens("add", "boss", "--role", "admin", "-o", str(tokens.folder / "b"), "--expires", "2027-02-01")
    capsys.readouterr()
    assert tokens("list") == 0
    assert capsys.readouterr().out.splitlines() == [
        "anna  robot  never ends", "boss  admin  ends 2027-02-01 00:00 UTC",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("add", "anna", "--role", "robot", "-o", "x"), "has a token"),
        (("add", "ben", "--role", "king", "-o", "x"), "robot, viewer, admin"),
        (("add", "ben+1", "--role", "robot", "-o", "x"), "name it without"),
        (("revoke", "ben"), "there are anna"),
        (("rotate", "ben", "-o", "x"), "there are anna"),
        (("add", "ben", "--role", "robot", "-o", "missing/x"), "cannot write"),
        (("add", "ben", "--role", "robot", "-o", "a"), "a: exists, and would be lost"),
        (("rotate", "anna", "-o", "tokens.yaml"), "tokens.yaml: exists, and would be lost"),
    ],
)
def test_wrong_requests_change_nothing_and_are_one_line(tokens, capsys, monkeypatch, arguments, told):
    monkeypatch.chdir(tokens.folder)
    tokens("add", "anna", "--role", "robot", "-o", "a")
    before, _ = tokens.path.read_bytes(), capsys.readouterr()
    assert tokens(*arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert tokens.path.read_bytes() == before
    assert sorted(os.listdir()) == ["a", "tokens.yaml"]


def test_a_new_token_may_replace_the_file_of_the_old_one(tokens):
    file = str(tokens.folder / "a")
    assert tokens("add", "anna", "--role", "robot", "-o", file) == 0
    before = (tokens.folder / "a").read_text()
    assert tokens("rotate", "anna", "-o", file) == 0
    assert (tokens.folder / "a").read_text() != before
    assert who(tokens, "a") == Identity("anna", Role.ROBOT)


def test_mode_of_the_file_stays(tokens):
    tokens("add", "anna", "--role", "robot", "-o", str(tokens.folder / "a"))
    tokens.path.chmod(0o640)
    tokens("add", "ben", "--role", "robot", "-o", str(tokens.folder / "b"))
    assert tokens.path.stat().st_mode & 0o777 == 0o640
