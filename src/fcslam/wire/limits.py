"""Every limit of the format, version 1. A packet beyond one of them is neither written nor read."""

from fcslam.records import Channel

PROTOCOL_VERSION = 1

MAXIMUM_PACKET_BYTES = 96 * 1024
"""The largest packet, a place with the most keypoints, has 78 kB."""

MAXIMUM_SEQUENCE = 2**63 - 1
"""Epochs and sequence numbers fit a signed 64-bit column."""
MAXIMUM_NUMBER = 2**31 - 1
"""Numbers of keyscans, versions and maps."""

MAXIMUM_BEAMS = 4096
BYTES_PER_RANGE = 3
"""The longest varint of a difference between two 16-bit ranges."""
MAXIMUM_RANGES_BYTES = BYTES_PER_RANGE * MAXIMUM_BEAMS
"""Length of a keyscan's ranges, both before and after inflating."""

MAXIMUM_KEYPOINTS = 2048
KEYPOINT_AXES = {Channel.LIDAR: 2, Channel.CAMERA: 3}
"""Coordinates of a keypoint; a camera sees how high it is, too."""
BYTES_PER_AXIS = 2

MAXIMUM_NETWORK_BYTES = 64 * 1024 * 1024
"""Of a detector's file; those of today have 0.5 to 5 MB."""
DIGEST_BYTES = 32

MAXIMUM_COORDINATE_M = 1e6
MAXIMUM_LASER_RANGE_M = 1e3
MAXIMUM_INFORMATION = 2.0**40
"""A standard deviation of 1 micrometre or 1 microradian; a power of two, so float32 keeps it."""
MINIMUM_INFORMATION = 2.0**-20
"""A standard deviation of 1 km or 1000 rad. Both bounds hold for the diagonal."""
MINIMUM_CORRELATION_EIGENVALUE = 1e-6
"""Well above the rounding of float32: what is positive definite here stays so."""

MAXIMUM_BATCH_BYTES = 1024 * 1024
MAXIMUM_BATCH_PACKETS = 1024
"""Of packets that travel together, their lengths included in the bytes."""
