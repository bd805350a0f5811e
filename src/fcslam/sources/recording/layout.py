"""Layout of a recording's folder: file names, binary frames, and the sensors' geometry in meta.yaml.

``scans.bin``, ``odometry.bin`` and ``images.bin`` have a header and frames of constant size, each with a checksum. So
damage affects single frames, and the length of a file shows a frame that a crash cut off. The frames of all files share
one sequence of numbers, which is the order of the recording. The ranges of a scan, as many as it has beams, are in
``ranges.bin``, and its frame says where.
"""

from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from struct import Struct
from typing import Any, Literal, Self
from zlib import crc32

import numpy as np
import yaml
from pydantic import ValidationError, model_validator

from fcslam.config import StrictModel, one_line, parse_yaml
from fcslam.errors import SourceError
from fcslam.geometry.beams import is_field_of_view
from fcslam.records import Beams, CameraModel, LaserModel, Sweep
from fcslam.sources.images import check_camera
from fcslam.storage.files import write_file
from fcslam.untrusted import read_bytes

META = "meta.yaml"
SCANS = "scans.bin"
RANGES = "ranges.bin"
IMAGES = "images"
GROUND_TRUTH = "ground_truth.tum"
VERSION = 3
RANGE = np.dtype("<f4")
"""A range in metres."""

_HEADER = Struct("<8sII")
HEADER_BYTES = _HEADER.size
CRC_BYTES = 4

_MAX_META_BYTES = 1 << 16
_MAX_LASERS = 8
_MAX_BEAMS = 1 << 16
_MAX_RANGE_M = 1e6
_LONGEST_SWEEP_S, _FASTEST, _STEEPEST = 2.0, 50.0, 500.0
"""Limits of a sweep: times in seconds, velocities in m/s and rad/s, accelerations in m/s^2 and rad/s^2."""

_ENTRY: list[Any] = [("sequence", "<u8"), ("stamp", "<f8"), ("T_odom_base", "<f8", (3,))]
_CRC: list[Any] = [("crc32", "<u4")]


@dataclass(frozen=True)
class FrameFile:
    """One of the files of frames."""

    name: str
    magic: bytes
    frame: np.dtype[np.void]
    version: int = 1

    @property
    def frame_bytes(self) -> int:
        """Size of a frame with its checksum."""
        return self.frame.itemsize

    @property
    def header(self) -> bytes:
        """The first bytes of the file."""
        return _HEADER.pack(self.magic, self.version, self.frame_bytes)

    def packed(self, *values: Any) -> bytes:
        """A frame of ``values``, in the order of its fields, and its checksum."""
        frame = np.zeros((), dtype=self.frame)
        for name, value in zip(self.frame.names or (), values, strict=False):
            frame[name] = value
        content = frame.tobytes()[:-CRC_BYTES]
        return content + crc32(content).to_bytes(CRC_BYTES, "little")


def is_whole(frame: bytes | memoryview) -> bool:
    """Whether a frame's checksum is correct."""
    return crc32(frame[:-CRC_BYTES]) == int.from_bytes(frame[-CRC_BYTES:], "little")


ODOMETRY_FILE = FrameFile("odometry.bin", b"FCSLAMod", np.dtype([*_ENTRY, *_CRC]))
IMAGES_FILE = FrameFile(
    "images.bin", b"FCSLAMim", np.dtype([*_ENTRY, ("suffix", "S4"), ("size", "<u4"), ("file_crc32", "<u4"), *_CRC])
)


_BEAMS: list[Any] = [("laser", "<u4"), ("beam_count", "<u4"), ("angle_min_rad", "<f8"), ("angle_increment_rad", "<f8")]
_PLACE: list[Any] = [("offset", "<u8"), ("ranges_crc32", "<u4")]
SWEEP_NUMBERS = 8
_SWEEP: list[Any] = [("sweep", "<f8", (SWEEP_NUMBERS,))]
SCANS_FILE = FrameFile(SCANS, b"FCSLAMsc", np.dtype([*_ENTRY, *_BEAMS, *_PLACE, *_SWEEP, *_CRC]), version=3)


def image_path(folder: Path, index: int, suffix: str) -> Path:
    """The file of the image whose frame is number ``index`` (from 0) of images.bin."""
    return folder / IMAGES / f"{index:08d}.{suffix}"


class Meta(StrictModel):
    """The sensors of the robot."""

    version: Literal[3] = 3
    lasers: tuple[LaserModel, ...]
    camera: CameraModel | None = None

    @model_validator(mode="after")
    def _is_sane(self) -> Self:
        if not 1 <= len(self.lasers) <= _MAX_LASERS:
            raise ValueError(f"a recording has 1 to {_MAX_LASERS} lasers")
        for laser in self.lasers:
            check_beams(laser.beams)
            if not 0.0 < laser.max_range_m <= _MAX_RANGE_M or not all(map(isfinite, laser.T_base_laser)):
                raise ValueError("no sane range or pose of the laser")
        if self.camera is not None:
            check_camera(self.camera)
        return self


def check_beams(beams: Beams) -> None:
    """Raise ValueError for beams that no laser has."""
    if not 2 <= beams.beam_count <= _MAX_BEAMS:
        raise ValueError(f"a laser has 2 to {_MAX_BEAMS} beams")
    if not (is_field_of_view(beams) and beams.angle_increment_rad > 0.0):
        raise ValueError("no sane field of view of the laser")


def check_sweep(sweep: Sweep) -> None:
    """Raise ValueError for a sweep that no scan has."""
    first_s, last_s, velocity, acceleration = sweep
    limits = *2 * (_LONGEST_SWEEP_S,), *3 * (_FASTEST,), *3 * (_STEEPEST,)
    numbers = first_s, last_s, *velocity, *acceleration
    is_within = all(abs(number) <= limit for number, limit in zip(numbers, limits, strict=True))  # false for NaN
    if not is_within or first_s == last_s:
        raise ValueError("no sane times of the beams, or no sane motion during the scan")


def write_meta(folder: Path, meta: Meta) -> None:
    """Write meta.yaml atomically."""
    content = meta.model_dump(mode="json", exclude_none=True)
    if meta.camera is not None:
        translation_m, rotation = meta.camera.T_base_camera
        content["camera"]["T_base_camera"] = {"translation_m": list(translation_m), "rotation": list(rotation)}
    write_file(folder / META, yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def read_meta(folder: Path) -> Meta:
    """The sensors of the recording in ``folder``.

    Raises:
        SourceError: meta.yaml is missing, damaged, too large or of another version.
    """
    path = folder / META
    try:
        content = parse_yaml(read_bytes(path, folder, _MAX_META_BYTES))
    except FileNotFoundError as error:
        raise SourceError(f"{path}: is missing; it says how the laser measures, so copy the whole folder") from error
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read ({one_line(str(error))}); copy it again") from error
    version = content.get("version") if isinstance(content, dict) else None
    if type(version) is not int:
        raise SourceError(f"{path}: does not describe a recording (no version); copy it again")
    if version != VERSION:
        raise SourceError(f"{path}: is of version {str(version)[:20]}, but {VERSION} is read here; update fcslam")
    try:
        return Meta.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or META
        raise SourceError(f"{path}: {where}: {one_line(first['msg'])}; copy it again") from error
