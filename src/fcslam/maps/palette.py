"""Colours of all pictures of maps, as 0xRRGGBB. A robot has the same colour in every picture."""

from typing import Final

from fcslam.records import Channel

PAPER: Final = 0xECEFF1
FLOOR: Final = 0xFFFFFF
WALL: Final = 0x1F2A33
APPEARED: Final = 0xE66100
DISAPPEARED: Final = 0x0072B2
FURNITURE: Final = 0xB0BEC5
INK: Final = 0x37474F
# Distinguishable with colour vision deficiency (after Okabe and Ito).
ROBOTS: Final = (0x0072B2, 0xE66100, 0x009E73, 0x7B4FB5, 0xE0A800, 0x56B4E9, 0x8C564B, 0x607D3B)
CLOSURES: Final = {Channel.LIDAR: 0xC2185B, Channel.CAMERA: 0x3D1E8F}
"""Colour of a closure by its channel."""
