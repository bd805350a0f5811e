"""The pages of settings are what the settings say."""

import pytest
import yaml

from fcslam.config import dump
from fcslam.mission.mission import MissionConfig
from tools import settings_reference


@pytest.mark.parametrize(
    ("path", "page"), settings_reference.PAGES.items(), ids=lambda value: getattr(value, "name", "")
)
def test_the_pages_are_up_to_date(path, page):
    assert path.read_text(encoding="utf-8") == page(), "run: make docs"


def key_paths(content, path=""):
    for key, value in content.items():
        if isinstance(value, dict):
            yield from key_paths(value, f"{path}{key}.")
        else:
            yield f"{path}{key}"


def test_every_key_of_the_configuration_has_a_row_with_its_default():
    mission = settings_reference.cloud_page() + settings_reference.robot_page() + settings_reference.lidar_page()
    for path in key_paths(yaml.safe_load(dump(MissionConfig()))):
        assert mission.count(f"| `{path}` |") == 1
    assert "| `map.resolution_m` | `0.05` m | >= 0.001, <= 10 |" in mission
    assert "| `fleet.fusion` | `joint` | `joint`, `two_point` |" in mission
    page = settings_reference.training_page()
    assert "| `losses` |" in page
    assert "| `local_steps` |" in page
    assert "`training.steps`" not in page, "it refers to the section on training"


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("a.drift_rad_m", "rad/m"),
        ("maximum", "-"),
        ("packets_per_s", "1/s"),
    ],
)
def test_the_unit_follows_from_the_suffix(key, unit):
    assert settings_reference.unit(key) == unit


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        ("Largest speed [m/s].", ("Largest speed.", "m/s")),
        ("Scaled to [0, 1].", ("Scaled to [0, 1].", "")),
    ],
)
def test_a_unit_in_brackets_at_the_end_goes_to_its_column(effect, expected):
    assert settings_reference.split_unit(effect) == expected
