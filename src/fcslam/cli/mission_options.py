"""Options that choose the configuration of a mission, and the configuration that follows from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.lab.presets import Preset

if TYPE_CHECKING:
    from fcslam.mission.mission import MissionConfig

_FROM_CONFIG = "that of the configuration"

ConfigFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE|PRESET",
        help="Configuration file (YAML; `fcslam setup config` prints the default one) or the preset `paper`: FC-SLAM "
        "to the letter. Can be repeated; a later one overrides keys of an earlier one.",
    ),
]


@dataclass(frozen=True)
class MissionFlags:
    """The configuration of a mission, and what is often changed in it."""

    config: ConfigFiles = None
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of all random draws.", show_default=_FROM_CONFIG)] = None
    no_fuse: Annotated[bool, typer.Option("--no-fuse", help="Map each robot alone and fuse no maps.")] = False
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=X,Y,THETA",
            help="Where a robot starts, in metres and radians, in one frame for all robots. It helps to join maps and "
            "forces nothing. Can be repeated.",
        ),
    ] = None
    start_sigma: Annotated[
        str | None,
        typer.Option(
            metavar="M,RAD",
            help="Standard deviations of the starts: of x and y, and of the heading.",
            show_default=_FROM_CONFIG,
        ),
    ] = None

    def settings(self, default: "MissionConfig | None") -> "MissionConfig":
        """The configuration; without a file or preset, ``default`` with the changes of the command line.

        Raises:
            ConfigError: a file cannot be used, a robot is given two starts, or a number cannot be used.
            InputError: a start is not a pose.
        """
        from fcslam.cli.recordings import pose
        from fcslam.config import changed
        from fcslam.errors import ConfigError

        named = [start.partition("=")[::2] for start in self.start or ()]
        if len(dict(named)) < len(named):
            raise ConfigError("--start: a robot is given two starts; give one for each")
        fleet: dict[str, object] = {"join_maps": False} if self.no_fuse else {}
        if named:
            fleet["starts"] = {name: pose(f"--start {name}=", numbers) for name, numbers in named}
        if self.start_sigma is not None:
            fleet["start_sigma"] = self.start_sigma.split(",")
        changes: dict[str, object] = {"fleet": fleet} if fleet else {}
        changes |= {} if self.seed is None else {"seed": self.seed}
        return changed(mission_config(self.config, default), changes, "the command line")


def mission_config(chosen: Sequence[str] | None, default: "MissionConfig | None" = None) -> "MissionConfig":
    """The configuration of files and presets, the first one over the default; without any, ``default`` if it is given.

    Raises:
        ConfigError: a file cannot be read or is invalid.
    """
    from fcslam.config import load
    from fcslam.mission.mission import MissionConfig

    config = default if default is not None and not chosen else MissionConfig()
    presets = {preset.value: preset.file for preset in Preset}
    for one in chosen or ():
        config = load(MissionConfig, presets.get(one, Path(one)), over=config)
    return config
