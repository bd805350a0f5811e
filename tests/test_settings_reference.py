"""The pages of settings and commands are what the settings and the help of the commands say."""

import pytest
import yaml

from fcslam.config import dump
from fcslam.mission.mission import MissionConfig
from tools import reference_pages, settings_reference

PAGES = {**settings_reference.PAGES, reference_pages.FOLDER / "commands.md": reference_pages.commands_page}


@pytest.mark.parametrize(("path", "page"), PAGES.items(), ids=lambda value: getattr(value, "name", ""))
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
        assert mission.count(f"\n| `{path}` |") == 1
    assert "| `map.resolution_m` | `0.05` m | >= 0.001, <= 10 |" in mission
    assert "| `fleet.fusion` | `joint` | `joint`, `two_point` |" in mission
    page = settings_reference.training_page()
    assert "| `losses` |" in page
    assert "| `local_steps` |" in page
    assert "`training.steps`" not in page, "it refers to the section on training"
