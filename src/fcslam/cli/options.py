"""Options that several commands share, each declared once, and what they choose."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fcslam.cli.inputs import pose
from fcslam.errors import InputError
from fcslam.lab.presets import Preset

if TYPE_CHECKING:
    from fcslam.config import SettingsType
    from fcslam.mission.mission import MissionConfig
    from fcslam.wire.keys import Server

_ONE_KEY = re.compile(r"([a-z][a-z0-9_.]*)=(.*)", re.DOTALL)

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print neither progress nor notices on stderr, only errors.")
]
Force = Annotated[bool, typer.Option("--force", "-f", help="Replace the output if it exists.")]
Csv = Annotated[
    Path | None, typer.Option(help="Also write the numbers to this file: as JSON if it ends in .json, else as CSV.")
]
BuildingSeed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the building, the routes and the noise.")]
PathLength = Annotated[
    float | None,
    typer.Option(min=1.0, max=10_000.0, help="Distance that each robot drives, in metres.", show_default="60"),
]
NoCamera = Annotated[bool, typer.Option("--no-camera", help="Simulate LiDARs only. This needs no GL library.")]

ConfigFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE|KEY=VALUE",
        help="Configuration file (YAML; `fcslam tools config` prints the default one), one key of it, such as "
        "fleet.join_maps=false, or the preset `paper`: FC-SLAM as published. Can be repeated; a later one overrides "
        "keys of an earlier one.",
    ),
]
SettingsFiles = Annotated[
    list[str] | None,
    typer.Option(
        "--config", "-c", metavar="FILE|KEY=VALUE", help="Settings file (YAML), or one of its keys. Can be repeated."
    ),
]

Sensors = Annotated[
    list[str] | None,
    typer.Option(
        metavar="KEY=VALUE",
        help="ROS topics and frames to read instead of those that fcslam chooses; repeat it for each key. scan-topic "
        "(one for each laser), odom-topic (/tf: from tf; none), camera-topic; odom-frame and base-frame of the "
        "odometry in tf; laser-pose=X,Y,THETA[,upside-down] in the base frame (one for each scan-topic); "
        "cloud-band=LOW,HIGH[,BODY], the heights of a 3D LiDAR or depth camera that count, and the radius of the "
        "robot. Metres, radians.",
    ),
]
_ROS = "ROS networks"
RosParameters = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        rich_help_panel=_ROS,
        help="Parameters (YAML) of a ROS 2 node, with the names of slam_toolbox where they mean the same.",
    ),
]
UseSimTime = Annotated[
    bool, typer.Option("--use-sim-time", help="Take the time from /clock, as with a simulator.", rich_help_panel=_ROS)
]

Space = Annotated[
    bool,
    typer.Option(
        "--3d",
        help="Map 3D LiDARs with six degrees of freedom: poses with height, roll and pitch, and a 3D map. Robots with "
        "2D LiDARs share the map.",
    ),
]
Floor = Annotated[str, typer.Option(help="Floor of the building. Places of different floors are never compared.")]
ServerUrl = Annotated[
    str | None,
    typer.Option(
        "--server",
        metavar="URL",
        rich_help_panel="Network",
        help="Address of the cloud, as in https://cloud.example:8443. Separate the addresses of several instances by "
        "commas.",
    ),
]
Credentials = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        rich_help_panel="Network",
        help="Folder with the robot's credentials: token, ca.pem (authority that signed the cloud's certificate, "
        "if it is not one of this system), client.pem and client.key (the robot's certificate).",
    ),
]
STATE = typer.Option(help="Folder of the packets that the cloud has not confirmed. Each robot needs its own; keep it.")
Budget = Annotated[
    float | None,
    typer.Option(
        "--budget-kBps",
        min=0.1,
        rich_help_panel="Network",
        help="Limit of the uplink, in kB per second of the recording. Keyscans, constraints, tags and fixes are always "
        "sent; places are sent with fewer descriptors or left out.",
    ),
]
WorkersOption = Annotated[
    str,
    typer.Option(
        "--workers",
        metavar="N|ADDRESS",
        help="Processes that verify closures, this one included, or the Dask scheduler of a cluster: "
        "tls://HOST:PORT or tcp://HOST:PORT, with the certificates of Dask's configuration. The result is the same.",
        rich_help_panel="Workers",
    ),
]


def output_option(description: str, parent: str) -> Any:
    """The option ``--output``, whose default is a new folder ``parent/<time>``; see ``output.new_folder``."""
    return typer.Option("--output", "-o", help=description, show_default=f"{parent}/<time>")


def access(server: str | None, credentials: Path | None, budget_kBps: float | None = None) -> "Server | None":
    """The service that a robot sends to; None if none is named."""
    from fcslam.wire.keys import read_server

    return None if server is None else read_server(server, credentials, budget_kBps)


def chosen_settings(
    settings: "SettingsType", chosen: Sequence[str] | None, presets: Mapping[str, Path] = MappingProxyType({})
) -> "SettingsType":
    """The settings with the changes of files, presets and single keys, in this order."""
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
            raise InputError(f"--config {key}: {error}") from error
        for part in reversed(key.split(".")):
            content = {part: content}
        settings = changed(settings, content, "--config")
    return settings


def _single_key(text: str) -> "re.Match[str] | None":
    return None if os.path.exists(text) else _ONE_KEY.fullmatch(text)


def mission_config(
    chosen: Sequence[str] | None, default: "MissionConfig | None" = None, in_space: bool = False
) -> "MissionConfig":
    """The configuration of a mission that the command line chooses; ``in_space`` as by --3d.

    Files and presets change the defaults. Without any, single keys change ``default``.
    """
    from fcslam.config import changed
    from fcslam.mission.mission import MissionConfig

    base = default if default is not None and all(map(_single_key, chosen or ())) else MissionConfig()
    settings = chosen_settings(base, chosen, {preset.value: preset.file for preset in Preset})
    return changed(settings, {"fleet": {"dimensions": 3}}, "--3d") if in_space else settings


def with_starts(config: "MissionConfig", starts: Sequence[str] | None) -> "MissionConfig":
    """The configuration with the starts of ``--start NAME=X,Y,THETA``."""
    from fcslam.config import changed

    named = [start.partition("=")[::2] for start in starts or ()]
    if len(dict(named)) < len(named):
        raise InputError("--start: a robot is given two starts; give one for each")
    poses = {name: pose(f"--start {name}=", numbers) for name, numbers in named}
    return changed(config, {"fleet": {"starts": poses}}, "the command line") if poses else config
