"""Options that choose settings, and the settings that follow from them."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fcslam.errors import ConfigError
from fcslam.lab.presets import Preset

if TYPE_CHECKING:
    from fcslam.config import SettingsType
    from fcslam.mission.mission import MissionConfig

_ONE_KEY = re.compile(r"([a-z][a-z0-9_.]*)=(.*)", re.DOTALL)

ConfigFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE|KEY=VALUE",
        help="Configuration file (YAML; `fcslam tools config` prints the default one), one key of it, such as "
        "fleet.join_maps=false, or the preset `paper`: FC-SLAM to the letter. Can be repeated; a later one overrides "
        "keys of an earlier one.",
    ),
]
SettingsFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--config", "-c", metavar="FILE|KEY=VALUE", help="Settings file (YAML), or one of its keys. Can be repeated."
    ),
]
NO_FILES: Mapping[str, Path] = {}


def chosen_settings(
    settings: "SettingsType", chosen: Sequence[str] | None, presets: Mapping[str, Path] = NO_FILES
) -> "SettingsType":
    """The settings with the changes of files, presets and single keys, in this order.

    Raises:
        ConfigError: a file cannot be read, or a key or a value is invalid.
    """
    from fcslam.config import changed, load, parse_yaml

    for one in chosen or ():
        single = _single_key(one)
        if single is None:
            settings = load(type(settings), presets.get(one, Path(one)), over=settings)
            continue
        key, text = single.groups()
        try:
            content: Any = parse_yaml(text)
        except ValueError as error:
            raise ConfigError(f"--config {key}: {error}") from error
        for part in reversed(key.split(".")):
            content = {part: content}
        settings = changed(settings, content, "--config")
    return settings


def _single_key(text: str) -> "re.Match[str] | None":
    return None if os.path.exists(text) else _ONE_KEY.fullmatch(text)


def mission_config(chosen: Sequence[str] | None, default: "MissionConfig | None" = None) -> "MissionConfig":
    """The configuration of a mission that the command line chooses.

    Files and presets change the defaults. Without any, single keys change ``default``.

    Raises:
        ConfigError: a file cannot be read or is invalid.
    """
    from fcslam.mission.mission import MissionConfig

    base = default if default is not None and all(map(_single_key, chosen or ())) else MissionConfig()
    return chosen_settings(base, chosen, {preset.value: preset.file for preset in Preset})


def with_starts(config: "MissionConfig", starts: Sequence[str] | None) -> "MissionConfig":
    """The configuration with the starts of ``--start NAME=X,Y,THETA``.

    Raises:
        ConfigError: a robot is given two starts, or a name or a number cannot be used.
        InputError: a start is not a pose.
    """
    from fcslam.cli.recordings import pose
    from fcslam.config import changed

    named = [start.partition("=")[::2] for start in starts or ()]
    if len(dict(named)) < len(named):
        raise ConfigError("--start: a robot is given two starts; give one for each")
    poses = {name: pose(f"--start {name}=", numbers) for name, numbers in named}
    return changed(config, {"fleet": {"starts": poses}}, "the command line") if poses else config
