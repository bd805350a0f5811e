"""The mission file: packets, edits and configuration of a mission in one file. The service exports the same format.

A mission that goes on needs no recording of earlier robots: their packets take effect again.
"""

import fcntl
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from fcslam.cloud.edits import check_edit
from fcslam.cloud.report import Track
from fcslam.cloud.sessions import robot_and_epoch, session_name
from fcslam.cloud.settings import CloudConfig
from fcslam.driving import Leg
from fcslam.errors import InputError, PacketError, SourceError, StoreError
from fcslam.records import Change, Edit, Undo
from fcslam.runs.folder import MISSION, STATE
from fcslam.service.mission_store import CONFIG, MissionStore, StoredPacket, check_mission
from fcslam.sources.faults import Faults
from fcslam.storage.database import translate_errors
from fcslam.storage.files import replacing
from fcslam.storage.own_files import read_own
from fcslam.storage.state_file import State, code_version, parse_state, state_bytes
from fcslam.wire.packets import SizedPacket, decode

_log = logging.getLogger(__name__)

_AT_ONCE: Final = 1000
"""Packets that are read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class SavedMission:
    """The content of a mission file."""

    config: CloudConfig
    edits: tuple[Edit, ...]
    packets: Mapping[str, tuple[SizedPacket, ...]]
    """By robot, in the order of their times; without refused ones."""
    refused: tuple[StoredPacket, ...]
    """Packets without effect; their numbers are used up."""
    tracks: Mapping[str, Track]
    """The scans of each session whose scans are known, by its name."""
    state: State | None = None
    """The state of the cloud after all packets, if this user's program left one beside the file."""

    @property
    def in_order(self) -> list[SizedPacket]:
        """All packets in canonical order."""
        return sorted(chain.from_iterable(self.packets.values()), key=lambda sized: sized.packet.order)

    def epochs(self, robot: str) -> int:
        """How many sessions the robot had, counted with those without a packet."""
        return 1 + max((sized.packet.epoch for sized in self.packets.get(robot, ())), default=-1)

    def legs(self) -> list[Iterator[Leg]]:
        """Yield the legs of each robot, as ``driving`` gives them for recordings."""
        return [iter((self._leg(robot, packets),)) for robot, packets in self.packets.items()]

    def _leg(self, robot: str, packets: tuple[SizedPacket, ...]) -> Leg:
        tracks = {name: track for name, track in self.tracks.items() if robot_and_epoch(name)[0] == robot}
        stamps = tuple(stamp for track in tracks.values() for stamp in track.stamps.tolist())
        return Leg(robot, packets, stamps, tracks, Faults({}))


EMPTY: Final = SavedMission(CloudConfig(), (), {}, (), {})
"""A mission before its first packet."""


def read_mission(path: Path) -> SavedMission:
    """Read a mission file; it is not changed.

    Raises:
        SourceError: there is none, it is damaged or of another version, or a packet in it cannot be read.
    """
    path = mission_path(path)
    try:
        with opened_copy(path) as store:
            return replace(_read(store), state=_state_beside(path))
    except PacketError as error:
        raise SourceError(f"{path}: {error}") from error
    except StoreError as error:
        raise SourceError(str(error)) from error


@contextmanager
def opened_copy(path: Path | None) -> Iterator[MissionStore]:
    """Open a copy of a mission file, which itself is not changed; None: a mission before its first packet.

    Raises:
        StoreError: the file is damaged or of another version, or cannot be read.
    """
    with TemporaryDirectory() as place:  # opening the file for reading would leave files beside it
        copy = Path(place) / MISSION
        if path is not None:
            check_mission(path)
            with translate_errors(path):
                shutil.copyfile(path, copy)
        with closing(MissionStore(copy)) as store:
            yield store


def mission_state_bytes(mission: bytes, state: State) -> bytes:
    """The state of the cloud that made a mission file, for ``Run.state``."""
    return state_bytes(_fits(mission), state)


def _state_beside(path: Path) -> State | None:
    """The state that fits this program and the mission file at ``path``; None if there is none."""
    place = path.with_name(STATE)
    if path.name != MISSION or not place.exists():
        return None
    data = read_own(place)
    if data is None:
        _log.info("%s: is not of this user, or was changed; all packets take effect again", place)
        return None
    try:
        return parse_state(place, data, _fits(path.read_bytes()))
    except InputError as error:
        _log.info("%s; all packets take effect again", error)
        return None


def _fits(mission: bytes) -> str:
    return f"{code_version()} {blake2b(mission, digest_size=16).hexdigest()}"


def mission_bytes(
    config: CloudConfig,
    edits: Sequence[Edit],
    packets: Sequence[SizedPacket],
    refused: Sequence[StoredPacket],
    tracks: Mapping[str, Track],
) -> bytes:
    """The mission file of a mission.

    Args:
        config: settings of the cloud.
        edits: all edits, in their order.
        packets: the packets in the order in which they took effect.
        refused: packets without effect.
        tracks: the scans of each session, by its name.
    """
    with TemporaryDirectory() as place:
        with opened_copy(None) as store:
            store.configure(config)
            store.put([*map(_stored, packets), *refused], 0.0)
            for edit in edits:
                store.edit(edit.content, edit.author, edit.time_s)
            for name, track in tracks.items():
                store.put_track(*robot_and_epoch(name), track)
            store.export(Path(place) / MISSION)
        return (Path(place) / MISSION).read_bytes()


def edit_mission(path: Path, contents: Sequence[Change | Undo], author: str, time_s: float) -> list[Edit]:
    """Append edits to a mission file, all or none. Two people may edit at once: one waits for the other.

    Args:
        path: the file, or the run folder that holds it.
        contents: what to append.
        author: who edits.
        time_s: now, seconds since 1970.

    Raises:
        SourceError: as ``read_mission``, or the file cannot be written.
        EditError: an edit names a session or a time that the mission does not have, or what cannot be undone.
    """
    path = mission_path(path)
    try:
        with _exclusively(path), opened_copy(path) as store:
            edits = []
            for content in contents:  # in the copy: one may rest on those before it
                check_edit(content)
                store.check_named(content)
                edits.append(store.edit(content, author, time_s))
            with replacing(path) as unfinished:
                store.export(unfinished)
        return edits
    except StoreError as error:
        raise SourceError(str(error)) from error
    except OSError as error:
        raise SourceError(f"{path}: cannot be edited ({error}); the file is as before") from error


def mission_path(path: Path) -> Path:
    """The mission file that a user names by itself or by its run folder.

    Raises:
        SourceError: there is none.
    """
    path = path / MISSION if path.is_dir() else path
    if not path.is_file():
        raise SourceError(f"{path}: no mission file; `fcslam map` writes one into each run folder")
    return path


@contextmanager
def _exclusively(path: Path) -> Iterator[None]:
    """Wait until nobody else edits the file."""
    while True:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):  # nobody replaced it meanwhile
                yield
                return


def _stored(sized: SizedPacket) -> StoredPacket:
    packet, label = sized.packet, sized.label
    return StoredPacket(packet.robot, packet.epoch, packet.sequence, packet.time, label.kind, label.channel, sized.data)


def _read(store: MissionStore) -> SavedMission:
    packets: dict[str, list[SizedPacket]] = {}
    refused, last = [], 0
    while arrived := store.arrivals(last, _AT_ONCE):
        for arrival, stored in arrived:
            last = arrival
            if stored.refusal is None:
                packets.setdefault(stored.robot, []).append(SizedPacket(decode(stored.data), stored.data))
            else:
                refused.append(stored)
    return SavedMission(
        config=CloudConfig.model_validate_json(store.fact(CONFIG) or "{}"),
        edits=tuple(store.edits()),
        packets={robot: tuple(sorted(sent, key=lambda sized: sized.packet.order)) for robot, sent in packets.items()},
        refused=tuple(refused),
        tracks={session_name(robot, epoch): track for (robot, epoch), track in store.tracks().items()},
    )
