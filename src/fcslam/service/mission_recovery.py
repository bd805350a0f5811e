"""Checks a mission's file before it is opened, and recovers a damaged one."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fcslam.errors import StoreError
from fcslam.service.mission_store import (
    APPLIED,
    CONFIG,
    CONFIG_COPY,
    CORRECTIONS,
    EDITS,
    FACTS,
    FINALIZATIONS,
    PACKETS,
    SCHEMA,
    TRACKS,
    VERSION,
)
from fcslam.storage.database import Database, translate_errors
from fcslam.storage.recovery import find_damage, keep, replace
from fcslam.storage.salvage import Row

DAMAGED = "it was damaged in the cloud's file, and the robot had deleted it"
"""Reason of a refused packet."""
_TOLD = 20
"""Numbers of packets in a message."""


class LostPacket(NamedTuple):
    """A packet that cannot be read any more."""

    robot: str
    epoch: int
    sequence: int

    def __str__(self) -> str:
        return f"packet {self.sequence} of epoch {self.epoch} of {self.robot}"


def recover_mission(path: Path) -> str | None:
    """Check a mission's file that nobody has open, and recover it if it is damaged.

    Packets that cannot be read any more become refused ones, so that those after them take effect. The files as they
    were found are kept beside it.

    Returns:
        The damage and the losses, in a line; None if nothing is damaged or there is no file.

    Raises:
        StoreError: the configuration or an edit is lost, or the disk is full; the file is as it was.
    """
    damage = find_damage(path, SCHEMA, VERSION)
    if damage is None:
        return None
    if damage.rows is None:
        return f"{path}: {damage.found}; no packet is lost; the file as it was found is in {damage.kept}"
    facts = _facts(damage.rows["facts"])
    edits = _numbered(damage.rows["edits"])
    if CONFIG not in facts or len(edits) < max(edits, default=0):
        lost = "its configuration" if CONFIG not in facts else "one of its edits"
        raise StoreError(
            f"{path}: {damage.found}, and {lost} cannot be read; put a copy of the file in its place, or move the "
            "mission's folder away to begin a new one"
        )
    with translate_errors(path):
        kept = keep(path)
        rebuilt = path.with_name(f".{path.name}.partial")
        for left in path.parent.glob(f"{rebuilt.name}*"):
            left.unlink()
        packets, lost_packets = _packets(damage.rows["packets"])
        database = Database(rebuilt, SCHEMA, VERSION)
        try:
            with database.transaction() as connection:
                for table, rows in (
                    (PACKETS, packets),
                    (CORRECTIONS, _newest(damage.rows["corrections"])),
                    (EDITS, edits.values()),
                    (FINALIZATIONS, _numbered(damage.rows["finalizations"]).values()),
                    (TRACKS, {row[:2]: row for row in damage.rows["tracks"]}.values()),
                    (FACTS, facts.items()),
                ):
                    connection.insert(table, rows)
        finally:
            database.close()
        replace(path, rebuilt)
    told = ", ".join(map(str, lost_packets[:_TOLD])) + (", ..." if len(lost_packets) > _TOLD else "")
    return (
        f"{path}: {damage.found}; {len(packets) - len(lost_packets)} packets are recovered, {len(lost_packets)} are "
        f"lost{told and ': '}{told}; the file as it was found is in {kept}"
    )


def _packets(rows: Sequence[Row]) -> tuple[list[Row], list[LostPacket]]:
    """All packets in the order of their arrival, with a refused one in place of each that is lost; and those."""
    known: dict[tuple[Any, ...], Row] = {}
    for row in rows:  # a packet may be found before and after it was refused
        if row[1:4] not in known or row[8] is not None:
            known[row[1:4]] = row
    found = sorted(known.values())
    holes = sorted(set(range(1, 1 + max((int(row[0]) for row in found), default=0))) - {row[0] for row in found})
    numbers: dict[tuple[Any, Any], set[int]] = {}
    for _, robot, epoch, sequence, *_ in found:
        numbers.setdefault((robot, epoch), set()).add(int(sequence))
    # Without a hole in the arrivals a number that is missing did not arrive yet.
    lost = [
        LostPacket(robot, epoch, sequence)
        for (robot, epoch), present in numbers.items()
        for sequence in range(max(present))
        if holes and sequence not in present
    ]
    placeholders = [(0, *packet, 0.0, 0.0, None, None, DAMAGED, b"") for packet in lost]
    return [(arrival, *row[1:]) for arrival, row in enumerate([*found, *placeholders], start=1)], lost


def _facts(rows: Iterable[Row]) -> dict[str, str]:
    """The facts; the count of applied packets only grows."""
    facts: dict[str, str] = {}
    for name, value in rows:
        if name != APPLIED or int(value) > int(facts.get(name, -1)):
            facts[name] = value
    if CONFIG_COPY in facts:
        facts.setdefault(CONFIG, facts[CONFIG_COPY])
    return facts


def _numbered(rows: Iterable[Row]) -> dict[int, Row]:
    """Rows by their number, the answered one of a request that is found before and after its answer."""
    return {row[0]: row for row in sorted(rows, key=lambda row: (row[0], sum(value is not None for value in row)))}


def _newest(rows: Iterable[Row]) -> Iterable[Row]:
    """The newest correction of each session."""
    return {row[:2]: row for row in sorted(rows, key=lambda row: row[2])}.values()
