"""Configuration: what is dumped loads again, and a wrong key or value is answered in one line."""

from enum import StrEnum
from pathlib import Path

import pytest
import yaml
from pydantic import Field

from fcslam.config import Settings, dump, load, parse, parse_yaml
from fcslam.errors import InputError
from fcslam.mission.mission import MissionConfig


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


class Inner(Settings):
    reach_m: float = Field(default=2.0, gt=0.0, description="how far: it looks")
    steps: tuple[float, ...] = Field(default=(0.1, 0.2), description="finer and finer")


class Outer(Settings):
    seed: int = Field(default=7, description="of everything random")
    name: str = Field(default="yes: # 'quoted' " + "long " * 40, description="hostile to YAML")
    limit: float | None = Field(default=None, description="none by default")
    colour: Colour = Colour.RED
    inner: Inner = Inner()


def test_a_dump_loads_as_what_it_was(tmp_path):
    settings = Outer(seed=3, colour=Colour.BLUE, inner=Inner(reach_m=1e-7, steps=()))
    (tmp_path / "c.yaml").write_text(dump(settings))
    assert load(Outer, tmp_path / "c.yaml") == settings


def test_a_dump_has_every_key_under_its_comment():
    lines = dump(Outer()).splitlines()
    assert lines[:2] == ["# of everything random", "seed: 7"]
    assert lines[-5:] == [
        "inner:",
        "  # how far: it looks",
        "  reach_m: 2.0",
        "  # finer and finer",
        "  steps: [0.1, 0.2]",
    ]
    assert set(yaml.safe_load(dump(Outer()))) == set(Outer.model_fields)


def test_a_file_overrides_only_what_it_names(tmp_path):
    (tmp_path / "c.yaml").write_text("inner: {reach_m: 5}\n")
    assert load(Outer, tmp_path / "c.yaml") == Outer(inner=Inner(reach_m=5.0))
    (tmp_path / "c.yaml").write_text("")
    assert load(Outer, tmp_path / "c.yaml") == Outer()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"sede": 1}, "unknown key 'sede'; did you mean 'seed'"),
        ({"inner": {"reach": 1}}, "unknown key 'inner.reach'; did you mean 'inner.reach_m'"),
        ({"zzz": 1}, "known keys: seed, name, limit, colour, inner"),
        ({"inner": {"reach_m": -1}}, "inner.reach_m: Input should be greater than 0 (given: -1)"),
        ({"inner": {"reach_m": float("nan")}}, "inner.reach_m"),
        ({"inner": 3}, "inner"),
        ({"colour": "green"}, "colour"),
    ],
)
def test_what_does_not_belong_is_named(content, message):
    for refuse, where in (
        (lambda: parse(Outer, content, "robot.yaml"), "robot.yaml"),
        (lambda: Outer(**content), "Outer"),
    ):
        with pytest.raises(InputError, match=f"^{where}: [^\n]+$") as caught:
            refuse()
        assert message in str(caught.value)


@pytest.mark.parametrize("content", [b"a: [", b"- 1\n", b"\xff\xfe", b"3", None])
def test_files_that_are_no_configuration(tmp_path, content):
    path = tmp_path / "c.yaml"
    if content is not None:
        Path(path).write_bytes(content)
    with pytest.raises(InputError, match="yaml: ") as caught:
        load(Outer, path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", ["seed: 1\nseed: 2\n", "robot:\n  channels: [lidar]\nrobot: {}\n"])
def test_a_key_that_is_there_twice_is_refused(tmp_path, content):
    path = tmp_path / "c.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match=r"c\.yaml: not valid YAML \(the key '(seed|robot)' occurs twice"):
        load(MissionConfig, path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a: &a {x: 1}\nb: *a\n", "aliases"),
        ("a: {<<: {x: 1}}\n", "merge keys"),
        ("a: 0b" + "1" * 5000, "a number of 5002 characters"),
        ("a: " + "x" * 300_000, "the limit is"),
    ],
)
def test_yaml_that_expands_is_refused(text, reason):
    with pytest.raises(ValueError, match=reason):
        parse_yaml(text)
