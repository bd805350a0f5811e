"""docs/settings.md is what the settings say."""

import pytest
import yaml

from fcslam.config import dump
from fcslam.mission import MissionConfig
from tools import settings_reference


def test_the_page_is_up_to_date():
    assert settings_reference.PAGE.read_text(encoding="utf-8") == settings_reference.page(), "run: make docs"


def key_paths(content, path=""):
    for key, value in content.items():
        if isinstance(value, dict):
            yield from key_paths(value, f"{path}{key}.")
        else:
            yield f"{path}{key}"


def test_every_key_of_the_configuration_has_a_row_with_its_default():
    page = settings_reference.page()
    mission = page[: page.index("## Training")]
    for path in key_paths(yaml.safe_load(dump(MissionConfig()))):
        assert mission.count(f"| `{path}` |") == 1
    assert "| `map.resolution_m` | `0.05` | m | >= 0.001, <= 10 |" in page
    assert "| `fleet.fusion` | `joint` | - | `joint`, `n_point`, `two_point` |" in page
    assert "| `loss.margin` |" in page
    assert "| `privacy.delta` |" in page
    assert "`training.steps`" not in page, "it refers to the section on training"


@pytest.mark.parametrize(
    ("key", "unit"),
    [("a.drift_rad_m", "rad/m"), ("reach_m", "m"), ("a.rate_hz", "Hz"), ("steps", "-"), ("maximum", "-"), ("K_m", "m")],
)
def test_the_unit_follows_from_the_suffix(key, unit):
    assert settings_reference.unit(key) == unit
