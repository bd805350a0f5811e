"""Sessions: the packets of a robot from one start to the next; its odometry starts at zero.

To the cloud each session is a robot: only closures connect it to the robot's earlier sessions, as to any other robot.
It is named after the robot and the epoch: ``robot`` for epoch 0 and ``robot+1``, ``robot+2`` after it.
"""

import re
from dataclasses import replace

from fcslam.errors import PacketError
from fcslam.records import (
    Constraint,
    Correction,
    Keyscan,
    KeyscanFix,
    KeyscanId,
    Place,
    TagSighting,
    VoxelMap,
)
from fcslam.wire.checks import check_name
from fcslam.wire.messages import Acknowledgement, Body, DetectorUpdate, Hello, Packet

_SESSION = re.compile(r"(.+)\+(\d+)", re.ASCII)


def session_name(robot: str, epoch: int) -> str:
    """Name of the robot's session ``epoch``."""
    return f"{robot}+{epoch}" if epoch else robot


def robot_of(session: str) -> str:
    """The robot whose session has this name."""
    return robot_and_epoch(session)[0]


def robot_and_epoch(session: str) -> tuple[str, int]:
    """Robot and epoch of a session's name: the inverse of ``session_name``."""
    named = _SESSION.fullmatch(session)
    return (named[1], int(named[2])) if named else (session, 0)


def check_robot(robot: str) -> None:
    """Refuse a robot whose name cannot be used, or is that of another robot's session."""
    check_name(robot, "robot")
    taken = _SESSION.fullmatch(robot)
    if taken:
        raise PacketError(f"robot: '{robot}' is the name of a session of '{taken[1]}'; name it without '+{taken[2]}'")


def in_session(packet: Packet) -> Packet:
    """The packet with the session's name in place of the robot's."""
    check_robot(packet.robot)
    if packet.epoch == 0:
        return packet
    session = session_name(packet.robot, packet.epoch)
    return replace(packet, robot=session, body=_renamed(packet.body, session))


def _renamed(body: Body, session: str) -> Body:
    match body:
        case Keyscan() | Place() | TagSighting() | KeyscanFix() | VoxelMap():
            return replace(body, id=KeyscanId(session, body.id.number))
        case Hello() | Constraint() | Correction() | Acknowledgement() | DetectorUpdate():
            return replace(body, robot=session)
