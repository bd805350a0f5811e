"""Colours of all pictures of maps, as 0xRRGGBB. A robot has the same colour in every picture."""

import re
from collections.abc import Iterable
from typing import Final

from fcslam.records import Channel

PAPER: Final = 0xECEFF1
FLOOR: Final = 0xFFFFFF
WALL: Final = 0x1F2A33
INK: Final = 0x37474F
# Distinguishable with colour vision deficiency (after Okabe and Ito).
ROBOTS: Final = (0x0072B2, 0xE66100, 0x009E73, 0x7B4FB5, 0xE0A800, 0x56B4E9, 0x8C564B, 0x607D3B)
APPEARED, DISAPPEARED = ROBOTS[1], ROBOTS[0]
CLOSURES: Final = {Channel.LIDAR: 0xC2185B, Channel.CAMERA: 0x3D1E8F}
"""Colour of a closure by its channel."""


def robot_colors(sessions: Iterable[str]) -> dict[str, int]:
    """The colour of each session. All sessions of a robot have one, which is the same in every run of its fleet.

    A name chooses its colour, ``robot_2`` and ``ben`` the second one, or the next one that no earlier name has.
    """
    robots: dict[str, int] = {}
    for robot in sorted({_robot(session) for session in sessions}):
        number = re.search(r"\d+$", robot)
        wanted = int(number[0]) - 1 if number else ord(robot[:1].lower() or "a") - ord("a")
        order = [(wanted + k) % len(ROBOTS) for k in range(len(ROBOTS))]
        taken = set(robots.values())
        robots[robot] = next((k for k in order if k not in taken), order[0])
    return {session: ROBOTS[robots[_robot(session)]] for session in sessions}


def _robot(session: str) -> str:
    """A session's name ends in its number after a plus sign if the robot was started again."""
    return re.sub(r"\+\d+$", "", session)
