"""HTTP client of a robot that reads the maps of a cloud."""

from typing import NamedTuple

from fcslam.wire.http_transport import HttpClient


class ServedMap(NamedTuple):
    """One of the maps of a cloud."""

    number: int
    floor: str
    """Floor of its robots; empty: none."""
    robots: tuple[str, ...]
    extent_m: tuple[float, ...]
    """Lowest x and y, highest x and y, metres; empty before there is a map."""


class MapClient(HttpClient):
    """Reads the maps of one cloud; it needs the rights of a viewer. Each method raises as ``BatchTransport.state``."""

    def maps(self) -> list[ServedMap]:
        """The maps of the cloud now."""
        response = self._ask("GET", "maps", accept="application/json")
        with self._reading():
            return [
                ServedMap(
                    int(one["map"]),
                    str(one["floor"]),
                    tuple(map(str, one["robots"])),
                    tuple(map(float, one["extent"] or ())),
                )
                for one in response.json()
            ]

    def image(self, number: int) -> bytes:
        """The PGM file of a map."""
        return self._ask("GET", f"maps/{number}.pgm", accept="*/*").content

    def description(self, number: int) -> bytes:
        """The YAML file of a map."""
        return self._ask("GET", f"maps/{number}.yaml", accept="*/*").content
