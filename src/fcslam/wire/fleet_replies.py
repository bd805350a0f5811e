"""Replies of a cloud about the joint map, as the service writes and robots read them.

Names of lengths in JSON have no units.
"""

from pydantic import ConfigDict, Field

from fcslam.config import StrictModel


class _Reply(StrictModel):
    """A cloud of a later version may say more."""

    model_config = ConfigDict(extra="ignore")


class TeammatePose(_Reply):
    """A robot of the fleet, as the cloud knows it."""

    robot: str
    map_index: int = Field(alias="map")
    floor: str = Field(description="empty: none")
    T_map_base: tuple[float, float, float] = Field(
        alias="pose", description="x and y in metres, theta in radians, in its map"
    )
    age_s: float = Field(description="time since it was there, when the cloud replied")
    stamp: float = Field(description="of its newest keyscan in the map, seconds")


class FleetReply(_Reply):
    """Where all robots are."""

    robots: tuple[TeammatePose, ...]


class FrontierReply(_Reply):
    """A boundary between free and unknown cells."""

    point: tuple[float, float] = Field(description="a place on it that a robot can reach, metres in its map")
    length_m: float = Field(alias="length", description="metres")
    gain_m2: float = Field(alias="gain", description="unknown area around it, square metres")
    distances_m: dict[str, float] = Field(
        alias="distances", description="length of each robot's path to it, metres; none: no path"
    )
    robots: tuple[str, ...] = Field(description="who shall explore it")


class MapFrontiers(_Reply):
    """The frontiers of a map, that with the largest gain first."""

    map_index: int = Field(alias="map", description="number of the map")
    frontiers: tuple[FrontierReply, ...]


class QualityReply(_Reply):
    """How good a map is, by its certificate."""

    map_index: int = Field(alias="map", description="number of the map")
    verdict: str = Field(description="whether to use it, why, and what to do next")
    bar_m: float = Field(
        alias="bar", description="a cell is good if its error stays below this in 95 % of cells, metres"
    )
    within_m: float = Field(alias="within", description="distance within which errors count, metres")
    error_95_m: float | None = Field(
        alias="error_95", description="error that 95 % of cells stay below, metres; null: no cell is known"
    )
    good_share: float | None = Field(description="share of good cells")
    drives: tuple[str, ...] = Field(description="what to do about it, the most urgent first")


class ServedMap(_Reply):
    """One of the maps of a cloud."""

    number: int = Field(alias="map")
    floor: str = Field(description="floor of its robots; empty: none")
    robots: tuple[str, ...]
    in_space: bool = Field(False, description="whether it has points in space")
    extent_m: tuple[float, ...] | None = Field(
        alias="extent", description="lowest x and y, highest x and y, metres; null before there is a map"
    )
