"""Options that choose the configuration of a mission, and the configuration that follows from them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fcslam.cloud.fusion_strategy import FusionStrategy

if TYPE_CHECKING:
    from fcslam.mission import MissionConfig

_FROM_CONFIG = "that of the configuration"

ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", "-c", help="Configuration file (YAML); `fcslam config dump` prints the default one."),
]
MissionSeed = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed of all random draws.", show_default=_FROM_CONFIG)
]
NoFuse = Annotated[bool, typer.Option("--no-fuse", help="Map each robot alone and fuse no maps.")]
Fusion = Annotated[
    FusionStrategy | None,
    typer.Option(
        help="How maps are fused. joint: one robust pose graph of all robots. two_point, n_point: rigid maps, "
        "aligned on two or on all of their matched points.",
        show_default=_FROM_CONFIG,
    ),
]


def mission_config(
    file: Path | None,
    seed: int | None = None,
    no_fuse: bool = False,
    fusion: FusionStrategy | None = None,
    default: "MissionConfig | None" = None,
) -> "MissionConfig":
    """The configuration in ``file``, or else the default one, with the changes of the command line.

    Raises:
        ConfigError: the file cannot be read or is invalid, or ``fusion`` is given together with ``no_fuse``.
    """
    from fcslam.config import load
    from fcslam.errors import ConfigError
    from fcslam.mission import MissionConfig

    config = (default or MissionConfig()) if file is None else load(MissionConfig, file)
    if seed is not None:
        config = config.model_copy(update={"seed": seed})
    if no_fuse and fusion is not None:
        raise ConfigError("--no-fuse fuses no maps, so --fusion has no effect; give only one of them")
    changes: dict[str, object] = {"join_maps": False} if no_fuse else {}
    changes |= {"fusion": fusion} if fusion is not None else {}
    return config.model_copy(update={"fleet": config.fleet.model_copy(update=changes)})
