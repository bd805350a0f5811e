"""HTTP client of a robot that follows its fleet (the joint map in tiles, all robots), or reads the maps of a cloud."""

import json
from urllib.parse import quote

from pydantic import TypeAdapter

from fcslam.wire.fleet_replies import FleetReply, MapFrontiers, QualityReply, ServedMap
from fcslam.wire.http_transport import HttpClient

_FRONTIERS, _QUALITY = TypeAdapter(tuple[MapFrontiers, ...]), TypeAdapter(tuple[QualityReply, ...])
_MAPS = TypeAdapter(tuple[ServedMap, ...])


class FleetClient(HttpClient):
    """Follows the fleet of one robot, or reads the maps. Each method raises as ``HttpTransport.state``."""

    def exchange(self, robot: str, map_index: int | None, pose: tuple[float, ...] | None) -> FleetReply:
        """Say where the robot is in its map, if it knows, and read where all robots are."""
        content = json.dumps({"map": map_index, "pose": pose} if pose and map_index is not None else {})
        headers = {"Content-Type": "application/json"}
        response = self._ask("POST", f"robots/{robot}/fleet", content.encode(), headers)
        with self._reading():
            return FleetReply.model_validate_json(response.content)

    def frontiers(self, robot: str) -> tuple[MapFrontiers, ...]:
        """The frontiers of the map that a robot is in; none if it is in no map."""
        response = self._ask("GET", f"frontiers?robot={quote(robot, safe='')}")
        with self._reading():
            return _FRONTIERS.validate_json(response.content)

    def quality(self, robot: str) -> tuple[QualityReply, ...]:
        """How good the map is that a robot is in; none before its certificate is computed."""
        response = self._ask("GET", f"quality?robot={quote(robot, safe='')}")
        with self._reading():
            return _QUALITY.validate_json(response.content)

    def tiles(self, robot: str, known: str, limit_bytes: int) -> tuple[bytes, str] | None:
        """The changed tiles of the map that a robot is in (``fcslam.maps.joint_tiles``) and their ETag.

        None: nothing changed since the ETag ``known``, or the robot is in no map yet.
        """
        return self._changed(f"robots/{robot}/map?limit={limit_bytes}", known)

    def points(self, robot: str, known: str) -> tuple[bytes, str] | None:
        """The points of the map in space that a robot is in, as a PLY file, and their ETag; None as for ``tiles``."""
        return self._changed(f"robots/{robot}/points", known)

    def _changed(self, path: str, known: str) -> tuple[bytes, str] | None:
        nothing = (304, 404)
        response = self._ask("GET", path, headers={"If-None-Match": known} if known else {}, passes=nothing)
        if response.status_code in nothing:
            return None
        return response.content, response.headers.get("ETag", "")

    def maps(self) -> list[ServedMap]:
        """The maps of the cloud now, for a token with the rights of a viewer."""
        response = self._ask("GET", "maps")
        with self._reading():
            return list(_MAPS.validate_json(response.content))

    def file(self, number: int, suffix: str) -> bytes:
        """The file of a map with this suffix."""
        return self._ask("GET", f"maps/{number}.{suffix}").content
