"""Parameters of a robot on a ROS network, and the files that hold them."""

from pathlib import Path
from typing import Any

from pydantic import Field

from fcslam.config import Settings, one_line, parse, parse_yaml
from fcslam.errors import InputError
from fcslam.untrusted import MOST_TEXT_BYTES, read_text

_PARAMETERS = "ros__parameters"


class NodeParameters(Settings):
    """Names that slam_toolbox has, too, mean the same."""

    map_frame: str = Field(default="map", min_length=1, description="frame of the map")
    use_sim_time: bool = Field(default=False, description="time is what /clock says, as in a simulator")
    transform_publish_period: float = Field(default=0.05, gt=0, le=10, description="time between two map -> odom [s]")
    transform_timeout: float = Field(
        default=0.2, ge=0, le=10, description="how far the stamps of map -> odom lie ahead [s]"
    )
    transform_bound: float = Field(
        default=1.0, ge=0, le=60, description="longest time after a scan for which map -> odom is published [s]"
    )
    map_update_interval: float = Field(default=5.0, gt=0, le=3600, description="time between two maps [s]")
    topic_timeout: float = Field(default=20.0, gt=0, le=3600, description="longest wait for the topics [s]")


def load_parameters(path: Path | None) -> NodeParameters:
    """The parameters in a file of ROS 2 (``NODE: ros__parameters: ...``) or a plain mapping; None: the default ones."""
    if path is None:
        return NodeParameters()
    try:
        content: Any = parse_yaml(read_text(path, most=MOST_TEXT_BYTES))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({one_line(str(error))}); give a YAML file") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: has no parameters; write `fcslam: {{ros__parameters: {{...}}}}`")
    nodes = [node[_PARAMETERS] for node in content.values() if isinstance(node, dict) and _PARAMETERS in node]
    if len(nodes) > 1:
        raise InputError(
            f"{path}: has parameters of {len(nodes)} nodes; give a file with the parameters of fcslam only"
        )
    return parse(NodeParameters, nodes[0] if nodes else content, str(path))
