"""The floors of recordings. A robot that rides in a lift is on another floor from a time on."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from fcslam.errors import InputError, PacketError
from fcslam.records import CloudScan, LaserScan, SensorRecord
from fcslam.sources import Source
from fcslam.sources.source import Derived
from fcslam.wire.checks import check_floor


class OnFloors(Derived):
    """A recording whose scans name their floors."""

    def __init__(self, source: Source, floors: Mapping[float, str]) -> None:
        """``floors``: by the time at which the robot came there, in seconds since the first scan."""
        super().__init__(source)
        self._floors = floors

    def records(self) -> Iterator[SensorRecord]:
        """See ``Source``; the first scan on each floor names it."""
        first_s, coming = math.nan, sorted(self._floors.items(), reverse=True)
        for record in self._source.records():
            floor = ""
            if isinstance(record, LaserScan | CloudScan):
                first_s = record.stamp if math.isnan(first_s) else first_s
                while coming and record.stamp - first_s >= coming[-1][0]:
                    floor = coming.pop()[1]
            yield replace(record, new_floor=floor) if floor and isinstance(record, LaserScan | CloudScan) else record


def on_floors(sources: Sequence[Source], floors: Mapping[str, str]) -> list[Source]:
    """The recordings with their floors, by NAME or NAME@TIME."""
    of: dict[str, dict[float, str]] = {source.name: {} for source in sources}
    for key, floor in floors.items():
        name, at, time = key.partition("@")
        if name not in of:
            raise InputError(f"a floor names '{name}', but the robots are {', '.join(of)}")
        try:
            check_floor(floor)
        except PacketError as error:
            raise InputError(str(error)) from error
        of[name][_seconds(key, time) if at else 0.0] = floor
    for source in sources:
        last_s = max(of[source.name], default=0.0)
        if last_s > 0.0 and last_s > (duration_s := source.survey().duration_s):
            raise InputError(
                f"a floor begins {last_s:g} s after the first scan, but {source.name} has {duration_s:.1f} s"
            )
    return [OnFloors(source, of[source.name]) if of[source.name] else source for source in sources]


def _seconds(key: str, text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise InputError(
            f"a floor names '{key}'; expected NAME@TIME with seconds after the first scan, such as anna@44"
        )
    return seconds
