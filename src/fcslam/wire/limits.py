"""All limits of the format. Packets beyond a limit are neither written nor read."""

from fcslam.records import Channel

VERSION, SPACE_VERSION = 10, 11
"""The versions that are written and read; a change of the schema, a unit or a limit makes another one. A packet has the
second one if it holds a voxel map or a pose in space."""

MAXIMUM_PACKET_BYTES = 96 * 1024
"""The largest packet, a place with the most keypoints, has 78 kB."""

MAXIMUM_SEQUENCE = 2**63 - 1
"""Sequence numbers fit a signed 64-bit column."""
MAXIMUM_EPOCH = 2**31 - 1
"""A robot that starts every second needs 68 years."""
MAXIMUM_LASERS = 8
"""Lasers of one robot."""
MAXIMUM_BEAMS = 4096
MAXIMUM_TAGS = 32
"""Tags that one keyscan sees."""
BYTES_PER_RANGE = 2

MAXIMUM_KEYPOINTS = 2048
KEYPOINT_AXES = {Channel.LIDAR: 2, Channel.CAMERA: 3}
"""Coordinates of a keypoint; a camera sees how high it is, too."""
BYTES_PER_AXIS = 2

BYTES_PER_POINT = 5
MAXIMUM_ORIGINS = 256
"""Positions of the scanner in a voxel map."""

MAXIMUM_COORDINATE_M = 1e6
MAXIMUM_LASER_RANGE_M = 1e3
MAXIMUM_INFORMATION = 2.0**40
"""A standard deviation of 1 micrometre or 1 microradian; a power of two, so float32 keeps it."""
MINIMUM_INFORMATION = 2.0**-20
"""A standard deviation of 1 km or 1000 rad. Both bounds hold for the diagonal."""
MINIMUM_CORRELATION_EIGENVALUE = 1e-6
"""Well above the rounding of float32, so that positive definite matrices stay positive definite."""

MAXIMUM_BATCH_BYTES = 1024 * 1024
MAXIMUM_BATCH_PACKETS = 1024
"""Limits of a batch; the bytes include the length of each packet."""
