"""The mission file: packets, edits and configuration of a mission in one file. The service exports the same format.

A mission that goes on needs no recording of earlier robots: their packets take effect again.
"""

import fcntl
import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from fcslam.cloud.report import Track
from fcslam.cloud.sessions import robot_and_epoch, session_name
from fcslam.cloud.settings import CloudConfig
from fcslam.errors import PacketError, SourceError, StoreError
from fcslam.mission.driving import Leg
from fcslam.mission.edits import check_edit
from fcslam.mission.mission_store import CONFIG, MissionStore, StoredPacket, check_mission
from fcslam.records import Change, Edit, Undo
from fcslam.runs.folder import MISSION
from fcslam.sources.faults import Faults
from fcslam.storage.database import translate_errors
from fcslam.storage.files import replacing
from fcslam.untrusted import MOST_BYTES, LimitError, check_unpacked, open_file
from fcslam.wire.packets import SizedPacket, decode, unpacked_size

_log = logging.getLogger(__name__)

_AT_ONCE: Final = 1000
"""Packets that are read at once."""
_SQLITE: Final = b"SQLite format 3\0"
_COPIED_BYTES: Final = 1 << 20
"""Bytes of a file that are copied at once."""


@dataclass(frozen=True, eq=False)
class SavedMission:
    """The content of a mission file."""

    config: CloudConfig
    edits: tuple[Edit, ...]
    stored: tuple[StoredPacket, ...]
    """The packets as they are stored, in the order of their arrival; without refused ones."""
    refused: tuple[StoredPacket, ...]
    """Packets without effect; their numbers are used up."""
    tracks: Mapping[str, Track]
    """The scans of each session whose scans are known, by its name."""

    @property
    def robots(self) -> tuple[str, ...]:
        """Robots with a packet, in the order of their first one."""
        return tuple(dict.fromkeys(packet.robot for packet in self.stored))

    @cached_property
    def packets(self) -> Mapping[str, tuple[SizedPacket, ...]]:
        """The packets of each robot in the order of their times, decoded at the first use."""
        sent: dict[str, list[SizedPacket]] = {robot: [] for robot in self.robots}
        for stored in self.stored:
            sent[stored.robot].append(SizedPacket(decode(stored.data), stored.data))
        return {robot: tuple(sorted(its, key=lambda sized: sized.packet.order)) for robot, its in sent.items()}

    def session_count(self, robot: str) -> int:
        """How many sessions the robot had, counted with those without a packet."""
        return 1 + max((packet.epoch for packet in self.stored if packet.robot == robot), default=-1)

    def legs(self) -> list[Iterator[Leg]]:
        """Yield the legs of each robot, as ``driving`` gives them for recordings."""
        return [iter((self._way(robot),)) for robot in self.robots]

    def _way(self, robot: str) -> Leg:
        tracks = {name: track for name, track in self.tracks.items() if robot_and_epoch(name)[0] == robot}
        stamps = tuple(stamp for track in tracks.values() for stamp in track.stamps.tolist())
        return Leg(robot, self.packets[robot], stamps, tracks, Faults({}))


EMPTY: Final = SavedMission(CloudConfig(), (), (), (), {})
"""A mission before its first packet."""


def read_mission(path: Path) -> SavedMission:
    """Read a mission file; it is not changed."""
    path = mission_path(path)
    try:
        with opened_copy(path) as store:
            mission = stored_mission(store)
        check_packets(mission)
        _ = mission.packets
        return mission
    except (PacketError, LimitError) as error:
        raise SourceError(f"{path}: {error}") from error
    except StoreError as error:
        raise SourceError(str(error)) from error


def check_packets(mission: SavedMission) -> None:
    """Check what the packets of a mission expand to, before they are decoded."""
    check_unpacked(
        sum(len(packet.data) for packet in mission.stored),
        sum(unpacked_size(packet.data) for packet in mission.stored),
    )


@contextmanager
def opened_copy(path: Path | None) -> Iterator[MissionStore]:
    """Open a copy of a mission file, which itself is not changed; None: a mission before its first packet."""
    with TemporaryDirectory() as place:  # opening the file for reading would leave files beside it
        copy = Path(place) / MISSION
        if path is not None:
            with translate_errors(path), open_file(path, most=MOST_BYTES) as file, copy.open("wb") as copied:
                shutil.copyfileobj(file, copied, _COPIED_BYTES)
            try:
                check_mission(copy)  # what is read later, whatever becomes of the file
            except StoreError as error:
                raise StoreError(str(error).replace(str(copy), str(path))) from error
        with closing(MissionStore(copy, is_checked=path is not None)) as store:
            yield store


def mission_bytes(
    config: CloudConfig,
    edits: Sequence[Edit],
    packets: Sequence[StoredPacket],
    refused: Sequence[StoredPacket],
    tracks: Mapping[str, Track],
) -> bytes:
    """The mission file of a mission; its packets in the order in which they took effect, the rest as it stores them."""
    with TemporaryDirectory() as place:
        with opened_copy(None) as store:
            store.configure(config)
            store.put([*packets, *refused], 0.0)
            for edit in edits:
                store.edit(edit.content, edit.author, edit.time_s)
            for name, track in tracks.items():
                store.put_track(*robot_and_epoch(name), track)
            store.export(Path(place) / MISSION)
        return (Path(place) / MISSION).read_bytes()


def edit_mission(path: Path, contents: Sequence[Change | Undo], author: str, time_s: float) -> list[Edit]:
    """Append edits to a mission file or that of a run folder, all or none, at ``time_s`` seconds since 1970.

    Two people may edit at once: one waits for the other.
    """
    path = mission_path(path)
    try:
        with _exclusively(path), opened_copy(path) as store:
            edits = []
            for content in contents:  # in the copy: one may rest on those before it
                check_edit(content)
                store.check_named(content)
                edits.append(store.edit(content, author, time_s))
            with TemporaryDirectory() as place, replacing(path) as unfinished:
                store.export(Path(place) / MISSION)  # an export has an unfinished file of its own beside it
                shutil.copyfile(Path(place) / MISSION, unfinished)
        return edits
    except StoreError as error:
        raise SourceError(str(error)) from error
    except OSError as error:
        raise SourceError(f"{path}: cannot be edited ({error}); the file is as before") from error


def mission_path(path: Path) -> Path:
    """The mission file that a user names by itself or by its run folder."""
    path = path / MISSION if os.path.isdir(path) else path
    if not os.path.exists(path):
        raise SourceError(f"{path}: no such file; `fcslam map` writes {MISSION} into each run folder")
    if os.path.getsize(path) and not is_mission(path):
        raise SourceError(f"{path}: not a mission file; `fcslam map` writes {MISSION} into each run folder")
    return path


def is_mission(path: Path) -> bool:
    """Whether a file is a database, as mission files are under any name."""
    with translate_errors(path), open_file(path) as file:
        return file.read(len(_SQLITE)) == _SQLITE


@contextmanager
def _exclusively(path: Path) -> Iterator[None]:
    """Wait until nobody else edits the file."""
    while True:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):  # nobody replaced it meanwhile
                yield
                return


def as_stored(sized: SizedPacket) -> StoredPacket:
    """A packet as a mission file stores it."""
    packet, label = sized.packet, sized.label
    return StoredPacket(packet.robot, packet.epoch, packet.sequence, packet.time, label.kind, label.channel, sized.data)


def stored_mission(store: MissionStore) -> SavedMission:
    """What a store holds."""
    packets: list[StoredPacket] = []
    last = 0
    while arrived := store.arrivals(last, _AT_ONCE):
        packets += (stored for _, stored in arrived)
        last, _ = arrived[-1]
    return SavedMission(
        config=CloudConfig.model_validate_json(store.fact(CONFIG) or "{}"),
        edits=tuple(store.edits()),
        stored=tuple(packet for packet in packets if packet.refusal is None),
        refused=tuple(packet for packet in packets if packet.refusal is not None),
        tracks={session_name(robot, epoch): track for (robot, epoch), track in store.tracks().items()},
    )
