"""Lossless streams of ranges, keypoints and descriptors: differences, deflated by zlib.

A stream is deflated if that is shorter than its plain bytes. The receiver tells the two apart by the length, because it
knows how many numbers to expect. No stream can hold more numbers.
"""

import zlib
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import PacketError
from fcslam.geometry.voxels import LOWEST, VOXEL_STEPS, voxel_keys
from fcslam.records import CODE_BYTES, Codes, Steps
from fcslam.wire.limits import BYTES_PER_AXIS, BYTES_PER_POINT, BYTES_PER_RANGE

RangeCodes = NDArray[np.uint16]
KeypointCodes = NDArray[np.int16]

_RAW: Final = -15
"""Window of zlib's raw format, without a header and a checksum."""
_BITS: Final = 8 * CODE_BYTES
_EARLIER: Final = np.tri(_BITS, k=-1, dtype=np.int16)


def pack_ranges(codes: RangeCodes) -> bytes:
    """Encode ranges (N,) in steps of 2 mm, 0 for an invalid one: differences of neighbouring beams modulo 2^16."""
    differences = np.diff(codes, prepend=np.uint16(0)).view(np.int16)
    return _deflate(_high_and_low((differences << 1 ^ differences >> 15).view(np.uint16)))


def unpack_ranges(data: bytes, count: int) -> RangeCodes:
    """Inverse of ``pack_ranges``: ``count`` ranges in steps of 2 mm, shape (count,)."""
    zigzag = _from_high_and_low(_inflate(data, BYTES_PER_RANGE * count, "keyscan: ranges"))
    return np.cumsum(zigzag >> 1 ^ -(zigzag & 1), dtype=np.uint16)


def pack_keypoints(codes: KeypointCodes) -> bytes:
    """Encode keypoints (N, axes) in steps of 1 cm, rows in ascending order: differences of rows, axis by axis."""
    differences = np.diff(codes, axis=0, prepend=np.zeros((1, codes.shape[1]), np.int16))
    return _deflate(_high_and_low(differences.T.ravel().view(np.uint16)))


def unpack_keypoints(data: bytes, count: int, axes: int) -> KeypointCodes:
    """Inverse of ``pack_keypoints``: ``count`` keypoints in steps of 1 cm, shape (count, axes)."""
    differences = _from_high_and_low(_inflate(data, BYTES_PER_AXIS * count * axes, "place: keypoints"))
    steps = differences.view(np.int16).reshape(axes, count)
    codes: KeypointCodes = np.ascontiguousarray(np.cumsum(steps, axis=1, dtype=np.int16).T)
    if codes.min(initial=0) == np.iinfo(np.int16).min:
        raise PacketError("place: a keypoint is beyond 32,767 steps")
    if not np.array_equal(ascending(codes), np.arange(count)):
        raise PacketError("place: keypoints are not in ascending order")
    return codes


def ascending(keypoints: NDArray[Any]) -> NDArray[np.int64]:
    """Order of keypoints (N, axes) on the wire, shape (N,): by x, then y, then z; equal ones keep their order."""
    return np.lexsort(keypoints.T[::-1])


def pack_descriptors(descriptors: Codes) -> bytes:
    """Encode descriptors (N, 32).

    Each bit is sent as its difference from the earlier bit that is most like it, or its opposite, in these descriptors.
    """
    bits = np.ascontiguousarray(np.unpackbits(descriptors, axis=1).T)
    words = np.packbits(np.pad(bits, ((0, 0), (0, -len(descriptors) % 64))), axis=1).view(np.uint64)
    different = np.zeros((_BITS, _BITS), np.int16)
    for word in words.T:  # no product of matrices: the threads of BLAS take ten times as long as one
        different += np.bitwise_count(word[:, None] ^ word)
    likeness = len(descriptors) - 2 * different
    like = (np.abs(likeness) * _EARLIER).argmax(axis=1)
    opposite = (likeness[np.arange(_BITS), like] < 0)[:, None]
    bits[1:] ^= bits[like[1:]] ^ opposite[1:]
    head = like.astype(np.uint8).tobytes() + np.packbits(opposite).tobytes()
    deflater = zlib.compressobj(wbits=_RAW, strategy=zlib.Z_HUFFMAN_ONLY)  # bytes repeat by chance only
    coded = deflater.compress(head + np.packbits(bits, axis=1).tobytes()) + deflater.flush()
    return min(descriptors.tobytes(), coded, key=len)


def unpack_descriptors(data: bytes, count: int) -> Codes:
    """Inverse of ``pack_descriptors``: ``count`` descriptors, shape (count, 32)."""
    if len(data) >= CODE_BYTES * count:
        return np.frombuffer(_inflate(data, CODE_BYTES * count, "place: descriptors"), np.uint8).reshape(-1, CODE_BYTES)
    columns = -(-count // 8)
    coded = np.frombuffer(_inflate(data, _BITS + CODE_BYTES + _BITS * columns, "place: descriptors"), np.uint8)
    like, opposite = coded[:_BITS], np.unpackbits(coded[_BITS : _BITS + CODE_BYTES])
    bits = np.unpackbits(coded[_BITS + CODE_BYTES :].reshape(_BITS, columns), axis=1, count=count)
    for bit in range(1, _BITS):
        bits[bit] ^= bits[like[bit]] ^ opposite[bit]
    return np.packbits(bits.T, axis=1)


def pack_points(points: Steps, seen_from: NDArray[np.uint8]) -> bytes:
    """Encode the points (N, 3) of a voxel map, by voxels in ascending order, and their origins (N,): differences of
    voxels, places in them, origins."""
    steps = np.diff(voxel_keys(points), prepend=0).astype("<u4").view(np.uint8).reshape(-1, 4)[:, :3]
    place = (points % VOXEL_STEPS) @ (VOXEL_STEPS**2, VOXEL_STEPS, 1)
    return _deflate(steps.T.tobytes() + place.astype(np.uint8).tobytes() + seen_from.tobytes())


def unpack_points(data: bytes, count: int) -> tuple[Steps, NDArray[np.uint8]]:
    """Inverse of ``pack_points``: ``count`` points, shape (count, 3), and their origins, shape (count,)."""
    plain = _inflate(data, BYTES_PER_POINT * count, "voxel map: points")
    planes = np.frombuffer(plain, np.uint8).reshape(BYTES_PER_POINT, count)
    steps = planes[:3].astype(np.int64)
    keys = np.cumsum(steps[0] | steps[1] << 8 | steps[2] << 16)
    place = planes[3].astype(np.int64)
    if keys.max(initial=0) >= 1 << 24 or place.max(initial=0) >= VOXEL_STEPS**3:
        raise PacketError("voxel map: a point is outside its bounds")
    voxels = np.stack((keys >> 16, keys >> 8 & 255, keys & 255), axis=1) + LOWEST
    within = np.stack((place // VOXEL_STEPS**2, place // VOXEL_STEPS % VOXEL_STEPS, place % VOXEL_STEPS), axis=1)
    return np.asarray(VOXEL_STEPS * voxels + within, np.int16), planes[4]


def _high_and_low(numbers: NDArray[np.uint16]) -> bytes:
    """All low bytes, then all high bytes, which are mostly equal."""
    return numbers.astype("<u2").view(np.uint8).reshape(-1, 2).T.tobytes()


def _from_high_and_low(data: bytes) -> NDArray[np.uint16]:
    pairs = np.frombuffer(data, np.uint8).reshape(2, len(data) // 2).T
    return np.ascontiguousarray(pairs).view("<u2").ravel().astype(np.uint16)


def _deflate(plain: bytes) -> bytes:
    return min(plain, zlib.compress(plain, wbits=_RAW), key=len)


def _inflate(data: bytes, size: int, what: str) -> bytes:
    """The ``size`` plain bytes of a stream; never takes memory for more."""
    if len(data) == size:
        return data
    if len(data) > size:
        raise PacketError(f"{what}: {len(data)} bytes, at most {size}")
    stream = zlib.decompressobj(_RAW)
    try:
        plain = stream.decompress(data, size)
        is_whole = len(plain) == size and not stream.decompress(stream.unconsumed_tail, 1) and stream.eof
    except zlib.error as error:
        raise PacketError(f"{what}: not a deflated stream") from error
    if not is_whole or stream.unused_data:
        raise PacketError(f"{what}: the stream ends early or has bytes after its end")
    return plain
