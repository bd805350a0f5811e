"""The data that the cloud keeps of each session, and the checks of a packet against the earlier ones of its session."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from fcslam.cloud.claims import LONGEST_MOTION_M, ClaimLimits, check_constraint, check_distance, check_voxel_map
from fcslam.cloud.packet_log import PacketNumber
from fcslam.cloud.sessions import in_session
from fcslam.errors import PacketError
from fcslam.geometry.beams import misfit
from fcslam.geometry.groups import group_of
from fcslam.lidar.scan import PointScan, keyscan_points
from fcslam.records import (
    Channel,
    Constraint,
    FloatArray,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    LaserModel,
    Place,
    VoxelMap,
)
from fcslam.storage.snapshot import from_state, to_state
from fcslam.storage.state_file import State
from fcslam.wire.messages import Hello, Packet

SCANS_KEPT: Final = 1000
"""Keyscans that are kept as points, 10 kB each: neighbouring submaps share most of theirs."""
_Body = TypeVar("_Body", Hello, Keyscan, VoxelMap)


@dataclass(slots=True)
class _KeptKeyscan:
    stamp: float
    sequence: int
    """Number of its packet."""
    keyscan: Keyscan | None
    """None: it was released, or not read yet."""
    is_released: bool = False
    holders: int = 0
    """How many places hold it."""


@dataclass(slots=True)
class _Session:
    hello: Hello
    """The newest one."""
    hello_sequence: int
    announced: set[tuple[Channel, str]] = field(default_factory=set)
    """Channels and detector versions of all hellos."""
    keyscans: list[_KeptKeyscan] = field(default_factory=list)
    connected: int = 0
    """How many keyscans are connected to the first one by motions; only these are used."""
    T_odom_base: FloatArray | None = None
    """Pose of the newest connected keyscan, by the motions alone, shape (P,)."""
    places: set[tuple[int, Channel, str]] = field(default_factory=set)
    """Keyscan, channel and detector version of every place."""
    spans: dict[tuple[int, Channel], tuple[int, int]] = field(default_factory=dict)
    """First and last keyscan behind the places at a keyscan, whichever detector described them."""
    fixes: dict[int, KeyscanFix] = field(default_factory=dict)
    """Fixes of satellite navigation, by keyscan."""
    voxel_maps: dict[int, int] = field(default_factory=dict)
    """Numbers of the packets of voxel maps, by keyscan."""


_KEPT = {
    name: kind for name, kind in get_type_hints(_Session).items() if name not in ("hello", "hello_sequence", "keyscans")
}
"""What a state has of each session as it is."""


class SessionStore:
    """Lasers, detectors, keyscans and places of every session; to the cloud each session is a robot.

    Packets of a session come in the order of their numbers. A refused packet changes nothing.
    """

    def __init__(self, limits: ClaimLimits, read: Callable[[PacketNumber], Packet] | None = None) -> None:
        """``read`` gives the packets of keyscans that ``restore`` names; None: nothing is restored."""
        self._limits = limits
        self._read = read
        self._floors: Mapping[str, str] = {}
        """Those that users gave to sessions."""
        self._sessions: dict[str, _Session] = {}
        """By name; those with a keyscan in the order of their first."""
        self._voxel_maps: dict[KeyscanId, VoxelMap] = {}
        """Those that were read."""
        self._unread: list[KeyscanId] = []
        """Keyscans that ``restore`` named; some may have been read since."""
        self.scan = lru_cache(SCANS_KEPT)(self._read_scan)
        """The points of a keyscan, by session and number."""

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots with at least one keyscan, in the order of their first."""
        return tuple(name for name, session in self._sessions.items() if session.keyscans)

    def add_hello(self, hello: Hello, sequence: int) -> None:
        """Note how to read the session's packets: at its start, or because there is a new detector or one more laser.

        ``sequence`` is the number of its packet.
        """
        session = self._sessions.get(hello.robot)
        if session is None:
            session = self._sessions[hello.robot] = _Session(hello, sequence)
        if session.hello.floor != hello.floor:
            raise PacketError(f"{hello.robot}: its new hello names another floor; a new floor needs a new session")
        if session.hello.lasers != hello.lasers[: len(session.hello.lasers)]:
            raise PacketError(f"{hello.robot}: its new hello changes or lacks an announced laser")
        session.hello, session.hello_sequence = hello, sequence
        session.announced.update(hello.detector_versions.items())

    def add_keyscan(self, keyscan: Keyscan, sequence: int) -> None:
        """The robot's next keyscan; ``sequence`` is the number of its packet."""
        robot, number = keyscan.id
        session = self._sessions.get(robot)
        if session is None:
            raise PacketError(f"{robot}: sends a keyscan before its hello")
        if number != len(session.keyscans):
            raise PacketError(f"{robot}: keyscan {number} where {len(session.keyscans)} is next")
        if number > session.connected:
            raise PacketError(f"{robot}: keyscan {number} before the motion to keyscan {number - 1}")
        self._check_laser(keyscan)
        session.keyscans.append(_KeptKeyscan(keyscan.stamp, sequence, keyscan))
        if number == 0:
            session.connected = 1
            self._sessions[robot] = self._sessions.pop(robot)

    def add_motion(self, motion: Constraint) -> None:
        """Connect the newest keyscan to the one before."""
        robot, session = motion.robot, self._sessions.get(motion.robot)
        new = len(session.keyscans) - 1 if session is not None else 0
        if session is None or session.connected != new or (motion.i, motion.j) != (new - 1, new):
            raise PacketError(f"{robot}: motion {motion.i} to {motion.j} does not lead to a new keyscan")
        check_constraint(motion, LONGEST_MOTION_M)
        before = session.T_odom_base
        T_odom_base = motion.T_i_j if before is None else group_of(before).compose(before, motion.T_i_j)
        check_distance(T_odom_base, robot, self._limits)
        session.T_odom_base, session.connected = T_odom_base, new + 1

    def add_place(self, place: Place) -> None:
        """A place of the robot."""
        self.require(place.id, KeyscanId(place.id.robot, place.last))
        robot, number = place.id
        session = self._sessions[robot]
        announced = sorted(version for channel, version in session.announced if channel is place.channel)
        if place.detector_version not in announced:
            raise PacketError(
                f"{robot}: a {place.channel} place of detector {place.detector_version}; "
                f"{', '.join(announced) or 'none'} was announced"
            )
        described = number, place.channel, place.detector_version
        if described in session.places:
            raise PacketError(f"{robot}: {place.channel} place {number} was described before")
        session.places.add(described)
        first, last = self.span(place.id, place.channel)
        session.spans[number, place.channel] = min(first, place.first), max(last, place.last)

    def add_fix(self, fix: KeyscanFix) -> None:
        """A fix of satellite navigation."""
        self.require(fix.id)
        robot, number = fix.id
        fixes = self._sessions[robot].fixes
        if number in fixes:
            raise PacketError(f"{robot}: keyscan {number} has a fix already")
        fixes[number] = fix

    def add_voxel_map(self, voxels: VoxelMap, sequence: int) -> None:
        """The surfaces around a keyscan; ``sequence`` is the number of its packet."""
        check_voxel_map(voxels)
        robot, number = voxels.id
        self.require(voxels.id, KeyscanId(robot, voxels.last))
        if number in self._sessions[robot].voxel_maps:
            raise PacketError(f"{robot}: keyscan {number} has a voxel map already")
        self._sessions[robot].voxel_maps[number] = sequence
        self._voxel_maps[voxels.id] = voxels

    def voxel_map(self, keyscan: KeyscanId) -> VoxelMap | None:
        """The voxel map around a keyscan; None if its robot sent none."""
        sequence = self._sessions[keyscan.robot].voxel_maps.get(keyscan.number)
        if sequence is None:
            return None
        if keyscan not in self._voxel_maps:
            self._voxel_maps[keyscan] = self._stored(PacketNumber(keyscan.robot, sequence), VoxelMap)
        return self._voxel_maps[keyscan]

    def voxel_maps(self, robot: str) -> tuple[VoxelMap, ...]:
        """The voxel maps of the robot, by keyscan."""
        found = (self.voxel_map(KeyscanId(robot, number)) for number in sorted(self._sessions[robot].voxel_maps))
        return tuple(voxels for voxels in found if voxels is not None)

    def fixes(self, robot: str) -> tuple[KeyscanFix, ...]:
        """The fixes of satellite navigation of the robot."""
        return tuple(self._sessions[robot].fixes.values())

    def require(self, *ids: KeyscanId) -> None:
        """Check that the keyscans are there."""
        for robot, number in ids:
            if not (robot in self._sessions and 0 <= number < self._sessions[robot].connected):
                raise PacketError(f"{robot}: names keyscan {number}, which it never sent")

    def hold(self, place: Place) -> bool:
        """Keep the keyscans of a place's submap until ``release``; False if some of them were released before."""
        held = self._sessions[place.id.robot].keyscans[place.first : place.last + 1]
        if any(kept.is_released for kept in held):
            return False
        for kept in held:
            kept.holders += 1
        return True

    def release(self, place: Place) -> None:
        """Undo ``hold``: drop the keyscans that no other place holds."""
        for kept in self._sessions[place.id.robot].keyscans[place.first : place.last + 1]:
            kept.holders -= 1
            if not kept.holders:
                kept.keyscan, kept.is_released = None, True

    def keyscans(self, robot: str) -> tuple[Keyscan, ...]:
        """Connected keyscans of a robot, without released ones."""
        kept = (self._keyscan(robot, number) for number in range(self._sessions[robot].connected))
        return tuple(keyscan for keyscan in kept if keyscan is not None)

    def numbers(self, robot: str, first: int = 0, last: int | None = None) -> NDArray[np.int64]:
        """Numbers of the ``keyscans`` from the first to the last one (inclusive), shape (N,)."""
        session = self._sessions[robot]
        end = session.connected if last is None else min(last + 1, session.connected)
        return np.array([k for k in range(first, end) if not session.keyscans[k].is_released], np.int64)

    def _read_scan(self, robot: str, number: int) -> PointScan:
        keyscan = self._keyscan(robot, number)
        assert keyscan is not None, "it was released"
        return keyscan_points(keyscan, self.lasers(robot))

    def read_ahead(self, most: int) -> bool:
        """Read up to ``most`` of the keyscans that ``restore`` named, with their voxel maps; False: all are read."""
        chosen, self._unread = self._unread[-most:], self._unread[:-most]
        for keyscan in chosen:
            self._keyscan(*keyscan)
            self.voxel_map(keyscan)
        return bool(chosen)

    def span(self, place: KeyscanId, channel: Channel) -> tuple[int, int]:
        """First and last keyscan that the place was described on; without a place there, the keyscan itself."""
        return self._sessions[place.robot].spans.get((place.number, channel), (place.number, place.number))

    def stamp(self, keyscan: KeyscanId) -> float:
        """When the keyscan was taken."""
        return self._sessions[keyscan.robot].keyscans[keyscan.number].stamp

    def nearest(self, robot: str, stamp: float) -> KeyscanId:
        """The robot's connected keyscan whose stamp is nearest."""
        return KeyscanId(robot, int(np.abs(self.stamps(robot) - stamp).argmin()))

    def stamps(self, robot: str) -> FloatArray:
        """When the robot's connected keyscans were taken, shape (N,), released or not."""
        session = self._sessions[robot]
        return np.array([kept.stamp for kept in session.keyscans[: session.connected]])

    def name_floors(self, floors: Mapping[str, str]) -> None:
        """Take over the floors that users gave, by session."""
        self._floors = dict(floors)

    def floor(self, robot: str) -> str:
        """Floor that a user gave to the session, or else the one that it named; empty if neither is known."""
        return self._floors.get(robot, self._sessions[robot].hello.floor)

    def lasers(self, robot: str) -> tuple[LaserModel, ...]:
        """The lasers that the robot announced."""
        return self._sessions[robot].hello.lasers

    def state(self) -> State:
        """The state that ``restore`` needs. Packets are stored anyway, so keyscans are named by theirs."""
        return {
            name: {
                "hello": session.hello_sequence,
                "keyscans": {
                    "stamps": np.array([kept.stamp for kept in session.keyscans]),
                    "sequences": np.array([kept.sequence for kept in session.keyscans], np.int64),
                    "released": np.array([kept.is_released for kept in session.keyscans], np.bool_),
                    "holders": np.array([kept.holders for kept in session.keyscans], np.int64),
                },
                **{attribute: to_state(getattr(session, attribute)) for attribute in _KEPT},
            }
            for name, session in self._sessions.items()
        }

    def restore(self, state: State) -> None:
        """Take over a ``state``; keyscans are read when they are needed."""
        for name, stored in state.items():
            columns = (stored["keyscans"][key].tolist() for key in ("stamps", "sequences", "released", "holders"))
            self._sessions[name] = _Session(
                self._stored(PacketNumber(name, stored["hello"]), Hello),
                stored["hello"],
                keyscans=[
                    _KeptKeyscan(stamp, sequence, None, is_released, holders)
                    for stamp, sequence, is_released, holders in zip(*columns, strict=True)
                ],
                **{attribute: from_state(kind, stored[attribute]) for attribute, kind in _KEPT.items()},
            )
            kept = enumerate(self._sessions[name].keyscans)
            self._unread += [KeyscanId(name, number) for number, keyscan in kept if not keyscan.is_released]

    def _keyscan(self, robot: str, number: int) -> Keyscan | None:
        """A keyscan, read if it was not yet; None if it was released."""
        kept = self._sessions[robot].keyscans[number]
        if kept.keyscan is None and not kept.is_released:
            kept.keyscan = self._stored(PacketNumber(robot, kept.sequence), Keyscan)
        return kept.keyscan

    def _stored(self, number: PacketNumber, kind: type[_Body]) -> _Body:
        assert self._read is not None, "only a restored store names packets"
        body = in_session(self._read(number)).body
        assert isinstance(body, kind), "a packet never changes"
        return body

    def _check_laser(self, keyscan: Keyscan) -> None:
        robot, lasers = keyscan.id.robot, self.lasers(keyscan.id.robot)
        if keyscan.laser >= len(lasers):
            raise PacketError(f"{robot}: a keyscan of laser {keyscan.laser}, {len(lasers)} announced")
        announced = lasers[keyscan.laser]
        reason = None if keyscan.beams is None else misfit(keyscan.beams, announced.beams)
        if reason is not None:
            raise PacketError(f"{robot}: a keyscan is not of laser {keyscan.laser}: {reason}")
        if keyscan.beams is None and len(keyscan.ranges_m) != announced.beam_count:
            raise PacketError(f"{robot}: {len(keyscan.ranges_m)} beams, {announced.beam_count} announced")
