"""The data that the cloud keeps of each session, and the checks of a packet against the earlier ones of its session."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np

from fcslam.cloud.claims import LONGEST_MOTION_M, ClaimLimits, check_constraint, check_distance, check_tile
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.sessions import in_session
from fcslam.errors import PacketError
from fcslam.geometry import se2
from fcslam.geometry.beams import misfit
from fcslam.maps.fusion import joined_tiles
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.records import (
    Channel,
    Constraint,
    FloatArray,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    MapTile,
    Place,
    frozen,
)
from fcslam.storage.state_file import State
from fcslam.wire.messages import Hello, Packet

_Body = TypeVar("_Body", Hello, Keyscan, MapTile)


class SessionStore:
    """Lasers, detectors, keyscans and places of every session; to the cloud each session is a robot.

    Packets of a session come in the order of their numbers. A refused packet changes nothing.
    """

    def __init__(self, limits: ClaimLimits, read: Callable[[PacketNumber], Packet] | None = None) -> None:
        """``read`` gives the packets of keyscans that ``restore`` names; None: nothing is restored."""
        self._limits = limits
        self._read = read
        self._hellos: dict[str, Hello] = {}
        self._floors: Mapping[str, str] = {}
        """Those that users gave to sessions."""
        self._hello_sequences: dict[str, int] = {}
        """Number of the packet of the newest hello."""
        self._stamps: dict[str, list[float]] = {}
        """Stamps of the keyscans, in seconds."""
        self._keyscans: dict[str, list[Keyscan | int | None]] = {}
        """None where it was released, the number of its packet where that was not read yet."""
        self._unread: list[KeyscanId] = []
        """Keyscans that ``restore`` named; some may have been read since."""
        self._sequences: dict[str, list[int]] = {}
        """Number of every keyscan's packet."""
        self._holders: dict[str, list[int]] = {}
        """How many places hold each keyscan."""
        self._connected: dict[str, int] = {}
        """How many keyscans are connected to the first one by motions; only these are used."""
        self._T_odom_base: dict[str, FloatArray] = {}
        """Pose of the newest connected keyscan, by the motions alone, shape (3,)."""
        self._announced: dict[str, set[tuple[Channel, str]]] = {}
        """Channels and detector versions of all hellos."""
        self._tiles: dict[str, dict[tuple[int, int], MapTile]] = {}
        """Tiles of the session's own map, by column and row."""
        self._tile_sequences: dict[str, list[int]] = {}
        """Numbers of their packets."""
        self._fixes: dict[str, dict[int, KeyscanFix]] = {}
        """Of satellite navigation, by keyscan."""
        self._places: set[tuple[KeyscanId, Channel, str]] = set()
        """Keyscan, channel and detector version of every place."""
        self._spans: dict[tuple[KeyscanId, Channel], tuple[int, int]] = {}
        """First and last keyscan behind the places at a keyscan, whichever detector described them."""

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots with at least one keyscan, in the order of their first."""
        return tuple(self._connected)

    def add_hello(self, hello: Hello, sequence: int) -> None:
        """Note how to read the session's packets: at its start, or because there is a new detector or one more laser.

        ``sequence`` is the number of its packet.

        Raises:
            PacketError: an announced laser is missing or changed, or the floor is another one.
        """
        before = self._hellos.get(hello.robot)
        if before is not None and before.floor != hello.floor:
            raise PacketError(f"{hello.robot}: its new hello names another floor; a new floor needs a new session")
        if before is not None and before.lasers != hello.lasers[: len(before.lasers)]:
            raise PacketError(f"{hello.robot}: its new hello changes or lacks an announced laser")
        self._hellos[hello.robot] = hello
        self._hello_sequences[hello.robot] = sequence
        self._announced.setdefault(hello.robot, set()).update(hello.detector_versions.items())

    def add_keyscan(self, keyscan: Keyscan, sequence: int) -> None:
        """The robot's next keyscan; ``sequence`` is the number of its packet.

        Raises:
            PacketError: it is not the next, does not fit the laser, or the motion to the one before is missing.
        """
        robot, number = keyscan.id
        if robot not in self._hellos:
            raise PacketError(f"{robot}: sends a keyscan before its hello")
        known = len(self._stamps.get(robot, ()))
        if number != known:
            raise PacketError(f"{robot}: keyscan {number} where {known} is next")
        if number > self._connected.get(robot, 0):
            raise PacketError(f"{robot}: keyscan {number} before the motion to keyscan {number - 1}")
        self._check_laser(keyscan)
        self._keyscans.setdefault(robot, []).append(keyscan)
        self._sequences.setdefault(robot, []).append(sequence)
        self._stamps.setdefault(robot, []).append(keyscan.stamp)
        self._holders.setdefault(robot, []).append(0)
        if number == 0:
            self._connected[robot] = 1

    def add_motion(self, motion: Constraint) -> None:
        """Connect the newest keyscan to the one before.

        Raises:
            PacketError: it does not, the keyscan has one already, or no robot moves or measures like this.
        """
        robot, connected = motion.robot, self._connected.get(motion.robot, 0)
        if connected == len(self._stamps.get(robot, ())) or (motion.i, motion.j) != (connected - 1, connected):
            raise PacketError(f"{robot}: motion {motion.i} to {motion.j} does not lead to a new keyscan")
        check_constraint(motion, LONGEST_MOTION_M)
        before = self._T_odom_base.get(robot)
        T_odom_base = motion.T_i_j if before is None else se2.compose(before, motion.T_i_j)
        check_distance(T_odom_base, robot, self._limits)
        self._T_odom_base[robot] = T_odom_base
        self._connected[robot] = connected + 1

    def add_place(self, place: Place) -> None:
        """A place of the robot.

        Raises:
            PacketError: its keyscans are not there, this detector described it before, or was not announced.
        """
        self.require(place.id, KeyscanId(place.id.robot, place.last))
        robot, number = place.id
        announced = sorted(version for channel, version in self._announced[robot] if channel is place.channel)
        if place.detector_version not in announced:
            raise PacketError(
                f"{robot}: a {place.channel} place of detector {place.detector_version}; "
                f"{', '.join(announced) or 'none'} was announced"
            )
        described = place.id, place.channel, place.detector_version
        if described in self._places:
            raise PacketError(f"{robot}: {place.channel} place {number} was described before")
        self._places.add(described)
        first, last = self.span(place.id, place.channel)
        self._spans[place.id, place.channel] = min(first, place.first), max(last, place.last)

    def add_tile(self, tile: MapTile, sequence: int) -> None:
        """A tile of the session's own map; ``sequence`` is the number of its packet.

        Raises:
            PacketError: the session has no keyscan, or no robot has such a map.
        """
        self.require(KeyscanId(tile.robot, 0))
        earlier = self._tiles.get(tile.robot, {})
        check_tile(tile, earlier, self._limits)
        self._tiles[tile.robot] = {**earlier, (tile.column, tile.row): tile}
        self._tile_sequences.setdefault(tile.robot, []).append(sequence)

    def add_fix(self, fix: KeyscanFix) -> None:
        """A fix of satellite navigation.

        Raises:
            PacketError: its keyscan is not there, or has one already.
        """
        self.require(fix.id)
        robot, number = fix.id
        fixes = self._fixes.setdefault(robot, {})
        if number in fixes:
            raise PacketError(f"{robot}: keyscan {number} has a fix already")
        fixes[number] = fix

    def fixes(self, robot: str) -> tuple[KeyscanFix, ...]:
        """The fixes of satellite navigation of the robot."""
        return tuple(self._fixes.get(robot, {}).values())

    def own_map(self, robot: str) -> OccupancyMap | None:
        """The map that the session sent, in its own frame; None if it sent none."""
        return joined_tiles(self._tiles[robot].values()) if robot in self._tiles else None

    def require(self, *ids: KeyscanId) -> None:
        """Check that the keyscans are there.

        Raises:
            PacketError: one is not.
        """
        for robot, number in ids:
            if not 0 <= number < self._connected.get(robot, 0):
                raise PacketError(f"{robot}: names keyscan {number}, which it never sent")

    def hold(self, place: Place) -> bool:
        """Keep the keyscans of a place's submap until ``release``; False if some of them were released before."""
        robot, numbers = place.id.robot, slice(place.first, place.last + 1)
        if None in self._keyscans[robot][numbers]:
            return False
        self._holders[robot][numbers] = [count + 1 for count in self._holders[robot][numbers]]
        return True

    def release(self, place: Place) -> None:
        """Undo ``hold``: drop the keyscans that no other place holds."""
        robot, holders = place.id.robot, self._holders[place.id.robot]
        for number in range(place.first, place.last + 1):
            holders[number] -= 1
            if not holders[number]:
                self._keyscans[robot][number] = None

    def keyscans(self, robot: str, first: int = 0, last: int | None = None) -> tuple[Keyscan, ...]:
        """Connected keyscans first to last (inclusive) of a robot, without released ones and those
        whose ranges stay on the robot."""
        end = self._connected[robot] if last is None else last + 1
        for number in range(first, end):
            self._read_keyscan(robot, number)
        kept = (keyscan for keyscan in self._keyscans[robot][first:end] if isinstance(keyscan, Keyscan))
        return tuple(keyscan for keyscan in kept if len(keyscan.ranges_m))

    def read_ahead(self, most: int) -> bool:
        """Read up to ``most`` of the keyscans that ``restore`` named; False: all are read."""
        chosen, self._unread = self._unread[-most:], self._unread[:-most]
        for robot, number in chosen:
            self._read_keyscan(robot, number)
        return bool(chosen)

    def span(self, place: KeyscanId, channel: Channel) -> tuple[int, int]:
        """First and last keyscan that the place was described on; without a place there, the keyscan itself."""
        return self._spans.get((place, channel), (place.number, place.number))

    def stamp(self, keyscan: KeyscanId) -> float:
        """When the keyscan was taken."""
        return self._stamps[keyscan.robot][keyscan.number]

    def nearest(self, robot: str, stamp: float) -> KeyscanId:
        """The robot's connected keyscan whose stamp is nearest."""
        return KeyscanId(robot, int(np.abs(self.stamps(robot) - stamp).argmin()))

    def stamps(self, robot: str) -> FloatArray:
        """When the robot's connected keyscans were taken, shape (N,), released or not."""
        return np.array(self._stamps[robot][: self._connected[robot]])

    def detector_versions(self, robot: str) -> Mapping[Channel, str]:
        """The detectors of the robot now; none before its hello."""
        return self._hellos[robot].detector_versions if robot in self._hellos else {}

    def name_floors(self, floors: Mapping[str, str]) -> None:
        """Take over the floors that users gave, by session."""
        self._floors = dict(floors)

    def vocabularies(self, robot: str) -> Mapping[Channel, bytes]:
        """Digests of the vocabularies of the words that the robot sends now; nothing before its hello."""
        return self._hellos[robot].vocabularies if robot in self._hellos else {}

    def floor(self, robot: str) -> str:
        """Floor that a user gave to the session, or else the one that it named; empty if neither is known."""
        return self._floors.get(robot, self._hellos[robot].floor)

    def lasers(self, robot: str) -> tuple[LaserModel, ...]:
        """The lasers that the robot announced."""
        return self._hellos[robot].lasers

    def state(self) -> State:
        """The state that ``restore`` needs. Packets are stored anyway, so keyscans are named by theirs."""
        return {
            "robots": list(self._connected),
            "hellos": dict(self._hello_sequences),
            "announced": {robot: sorted(announced) for robot, announced in self._announced.items()},
            "places": sorted(self._places),
            "spans": [(*place, *span) for place, span in self._spans.items()],
            "tiles": dict(self._tile_sequences),
            "keyscans": {
                robot: {
                    "stamps": np.array(self._stamps[robot]),
                    "sequences": np.array(sequences, np.int64),
                    "held": np.array([keyscan is not None for keyscan in self._keyscans[robot]]),
                    "holders": np.array(self._holders[robot], np.int64),
                }
                for robot, sequences in self._sequences.items()
            },
            "connected": list(self._connected.values()),
            "T_odom_base": {robot: np.array(pose) for robot, pose in self._T_odom_base.items()},
            "fixes": {
                robot: np.array(
                    [
                        (number, fix.latitude_deg, fix.longitude_deg, fix.altitude_m, fix.sigma_m, *fix.antenna_xy)
                        for number, fix in fixes.items()
                    ]
                )
                for robot, fixes in self._fixes.items()
            },
        }

    def restore(self, state: State) -> None:
        """Take over a ``state``; keyscans are read when they are needed."""
        self._hello_sequences = state["hellos"]
        for robot, sequence in self._hello_sequences.items():
            self._hellos[robot] = self._stored(PacketNumber(robot, sequence), Hello)
        for robot, announced in state["announced"].items():
            self._announced[robot] = {(Channel(channel), version) for channel, version in announced}
        self._places = {(KeyscanId(*place), Channel(channel), version) for place, channel, version in state["places"]}
        self._spans = {
            (KeyscanId(*place), Channel(channel)): (first, last) for place, channel, first, last in state["spans"]
        }
        for robot, kept in state["keyscans"].items():
            self._stamps[robot], self._holders[robot] = kept["stamps"].tolist(), kept["holders"].tolist()
            self._sequences[robot] = kept["sequences"].tolist()
            held = zip(self._sequences[robot], kept["held"].tolist(), strict=True)
            self._keyscans[robot] = [sequence if is_held else None for sequence, is_held in held]
            self._unread += [KeyscanId(robot, number) for number in np.flatnonzero(kept["held"]).tolist()]
        self._tile_sequences = state["tiles"]
        for robot, sequences in self._tile_sequences.items():
            tiles = (self._stored(PacketNumber(robot, sequence), MapTile) for sequence in sequences)
            self._tiles[robot] = {(tile.column, tile.row): tile for tile in tiles}
        for robot, rows in state["fixes"].items():
            for number, latitude, longitude, altitude, sigma, *antenna in rows.tolist():
                id, (x, y) = KeyscanId(robot, int(number)), antenna
                self._fixes.setdefault(robot, {})[id.number] = KeyscanFix(
                    id, latitude, longitude, altitude, sigma, (x, y)
                )
        self._connected = dict(zip(state["robots"], state["connected"], strict=True))
        self._T_odom_base = {robot: frozen(pose) for robot, pose in state["T_odom_base"].items()}

    def _read_keyscan(self, robot: str, number: int) -> None:
        if isinstance(sequence := self._keyscans[robot][number], int):
            self._keyscans[robot][number] = self._stored(PacketNumber(robot, sequence), Keyscan)

    def _stored(self, number: PacketNumber, kind: type[_Body]) -> _Body:
        """The content of a stored packet."""
        assert self._read is not None, "only a restored store names packets"
        body = in_session(self._read(number)).body
        assert isinstance(body, kind), "a packet never changes"
        return body

    def _check_laser(self, keyscan: Keyscan) -> None:
        robot, lasers = keyscan.id.robot, self.lasers(keyscan.id.robot)
        if keyscan.laser >= len(lasers):
            raise PacketError(f"{robot}: a keyscan of laser {keyscan.laser}, {len(lasers)} announced")
        if not len(keyscan.ranges_m):
            return
        announced = lasers[keyscan.laser]
        reason = None if keyscan.beams is None else misfit(keyscan.beams, announced.beams)
        if reason is not None:
            raise PacketError(f"{robot}: a keyscan is not of laser {keyscan.laser}: {reason}")
        if keyscan.beams is None and len(keyscan.ranges_m) != announced.beam_count:
            raise PacketError(f"{robot}: {len(keyscan.ranges_m)} beams, {announced.beam_count} announced")
