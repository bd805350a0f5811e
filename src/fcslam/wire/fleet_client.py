"""HTTP client of a robot that follows its fleet: the joint map in tiles, and where all robots are."""

import json
from typing import NamedTuple
from urllib.parse import quote

from fcslam.wire.http_transport import HttpClient


class TeammatePose(NamedTuple):
    """A robot of the fleet, as the cloud knows it."""

    robot: str
    map_index: int
    floor: str
    """Empty: none."""
    T_map_base: tuple[float, float, float]
    age_s: float
    """Time since it was there, when the cloud replied."""
    stamp: float
    """Of its newest keyscan in the joint map, seconds."""


class FleetReply(NamedTuple):
    """Where all robots are, and why maps are apart."""

    robots: tuple[TeammatePose, ...]
    separations: tuple[tuple[tuple[int, int], str], ...]
    """Two maps and the reason."""


class FrontierReply(NamedTuple):
    """A boundary between free and unknown cells of a map."""

    map_index: int
    point: tuple[float, float]
    """Metres in its map."""
    length_m: float
    gain_m2: float
    """Unknown area around it."""
    robots: tuple[str, ...]
    """Those that shall explore it."""


class QualityReply(NamedTuple):
    """How good a map is, by its certificate."""

    map_index: int
    verdict: str
    """How much of it is good."""
    bar_m: float
    """A cell is good if its error stays below this in 95 % of cells."""
    within_m: float
    """Distance within which errors count."""
    error_95_m: float | None
    """Error that 95 % of cells stay below; None: no cell is known."""
    good_share: float | None
    """Share of good cells."""
    drives: tuple[str, ...]
    """What to drive again, that with the largest gain first."""


class FleetClient(HttpClient):
    """Follows the fleet of one robot. Each method raises as ``BatchTransport.state``."""

    received_bytes = 0
    """Bytes of the replies' bodies so far."""

    def exchange(self, robot: str, map_index: int | None, pose: tuple[float, ...] | None) -> FleetReply:
        """Say where the robot is in its map, if it knows, and read where all robots are."""
        content = json.dumps({"map": map_index, "pose": pose} if pose and map_index is not None else {})
        response = self._ask(
            "POST", f"robots/{robot}/fleet", content.encode(), {"Content-Type": "application/json"}, "application/json"
        )
        self._require(response, 200)
        self.received_bytes += len(response.content)
        with self._reading():
            reply = response.json()
            robots = tuple(
                TeammatePose(
                    str(one["robot"]),
                    int(one["map"]),
                    str(one["floor"]),
                    _pose(one["pose"]),
                    float(one["age_s"]),
                    float(one["stamp"]),
                )
                for one in reply["robots"]
            )
            apart = tuple(
                ((int(one["maps"][0]), int(one["maps"][1])), str(one["explanation"])) for one in reply["separations"]
            )
        return FleetReply(robots, apart)

    def frontiers(self, robot: str) -> tuple[FrontierReply, ...]:
        """The frontiers of the map that a robot is in, that with the largest gain first."""
        response = self._ask("GET", f"frontiers?robot={quote(robot, safe='')}", accept="application/json")
        self._require(response, 200)
        self.received_bytes += len(response.content)
        with self._reading():
            return tuple(
                FrontierReply(
                    int(one["map"]),
                    (float(each["point"][0]), float(each["point"][1])),
                    float(each["length"]),
                    float(each["gain"]),
                    tuple(map(str, each["robots"])),
                )
                for one in response.json()
                for each in one["frontiers"]
            )

    def quality(self, robot: str) -> tuple[QualityReply, ...]:
        """How good the map is that a robot is in; none before its certificate is computed."""
        response = self._ask("GET", f"quality?robot={quote(robot, safe='')}", accept="application/json")
        if response.status_code == 404:  # a cloud of an older version
            return ()
        self._require(response, 200)
        self.received_bytes += len(response.content)
        with self._reading():
            return tuple(
                QualityReply(
                    int(one["map"]),
                    str(one["verdict"]),
                    float(one["bar"]),
                    float(one["within"]),
                    _number(one["error_95"]),
                    _number(one["good_share"]),
                    tuple(map(str, one["drives"])),
                )
                for one in response.json()
            )

    def tiles(self, robot: str, known: str, limit_bytes: int) -> tuple[bytes, str] | None:
        """The changed tiles of the map that a robot is in (``fcslam.maps.joint_tiles``) and their ETag.

        None: nothing changed since the ETag ``known``, or the robot is in no map yet.
        """
        headers = {"If-None-Match": known} if known else {}
        response = self._ask("GET", f"robots/{robot}/map?limit={limit_bytes}", headers=headers, accept="*/*")
        if response.status_code in (304, 404):
            return None
        self._require(response, 200)
        self.received_bytes += len(response.content)
        return response.content, response.headers.get("ETag", "")


def _number(value: object) -> float | None:
    return None if value is None else float(value)  # type: ignore[arg-type]


def _pose(values: object) -> tuple[float, float, float]:
    x, y, theta = map(float, values)  # type: ignore[call-overload]
    return x, y, theta
