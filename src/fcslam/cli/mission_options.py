"""Options that choose the configuration of a mission, and the configuration that follows from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cloud.fusion_strategy import FusionStrategy
from fcslam.lab.presets import Preset

if TYPE_CHECKING:
    from fcslam.mission.mission import MissionConfig

_FROM_CONFIG = "that of the configuration"

ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", "-c", help="Configuration file (YAML); `fcslam config dump` prints the default one."),
]
PresetName = Annotated[
    Preset | None,
    typer.Option(
        "--preset",
        help="Named configuration. paper: FC-SLAM to the letter; words alone decide, a new vocabulary at every place, "
        "rigid maps. Keys of --config override it.",
        show_default="none",
    ),
]
MissionSeed = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed of all random draws.", show_default=_FROM_CONFIG)
]
NoFuse = Annotated[bool, typer.Option("--no-fuse", help="Map each robot alone and fuse no maps.")]
Fusion = Annotated[
    FusionStrategy | None,
    typer.Option(
        help="How maps are fused. joint: one robust pose graph of all robots. two_point, first_two, n_point: "
        "rigid maps, aligned on the two most similar, the first two, or all of their matched points.",
        show_default=_FROM_CONFIG,
    ),
]

Starts = Annotated[
    list[str] | None,
    typer.Option(
        "--start",
        metavar="NAME=X,Y,THETA",
        help="Where a robot starts, in metres and radians, in one frame for all robots. It helps to join maps and "
        "forces nothing. Can be repeated.",
    ),
]
StartSigma = Annotated[
    str | None,
    typer.Option(
        metavar="M,RAD",
        help="Standard deviations of the starts: of x and y, and of the heading.",
        show_default=_FROM_CONFIG,
    ),
]


def mission_config(
    file: Path | None,
    seed: int | None = None,
    no_fuse: bool = False,
    fusion: FusionStrategy | None = None,
    default: "MissionConfig | None" = None,
    preset: Preset | None = None,
    starts: Sequence[str] = (),
    start_sigma: str | None = None,
) -> "MissionConfig":
    """The configuration in ``file`` over the preset, or else the default one, with the changes of the command line.

    Raises:
        ConfigError: the file cannot be read or is invalid, or options of the command line do not fit the rest.
    """
    from fcslam.cli.recordings import pose
    from fcslam.config import changed, load
    from fcslam.errors import ConfigError
    from fcslam.mission.mission import MissionConfig

    config = default if default is not None and file is None and preset is None else MissionConfig()
    for chosen in (None if preset is None else preset.file, file):
        config = config if chosen is None else load(MissionConfig, chosen, over=config)
    if no_fuse and fusion is not None:
        raise ConfigError("--no-fuse fuses no maps, so --fusion has no effect; give only one of them")
    fleet: dict[str, object] = {"join_maps": False} if no_fuse else {}
    fleet |= {"fusion": fusion} if fusion is not None else {}
    if starts:
        named = [start.partition("=")[::2] for start in starts]
        fleet["starts"] = {name: pose(f"--start {name}=", numbers) for name, numbers in named}
        if len(dict(named)) < len(named):
            raise ConfigError("--start: a robot is given two starts; give one for each")
    if start_sigma is not None:
        fleet["start_sigma"] = start_sigma.split(",")
    changes: dict[str, object] = {"fleet": fleet} if fleet else {}
    changes |= {"seed": seed} if seed is not None else {}
    return changed(config, changes, "the command line")
