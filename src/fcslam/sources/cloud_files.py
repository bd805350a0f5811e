"""Reads folders of clouds of a 3D LiDAR, one file each turn: KITTI (.bin), PCD and PLY, in the order of their names.

Times come from ``times.txt`` or ``timestamps.txt`` in the folder or above it, one for each file; else from the names of
the files, in seconds with a point, or since 1970 in any usual unit; else turns are 0.1 s apart. Without a known
mounting, ``base`` is on the floor below the LiDAR.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from functools import cached_property
from io import StringIO
from math import isfinite
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fcslam.errors import SourceError
from fcslam.records import CloudScan
from fcslam.sources.bags.clouds import MOST_POINTS, TIMES, measured_cloud
from fcslam.sources.bags.messages import LONGEST_SWEEP_S
from fcslam.sources.clouds_in_space import BAND_LASER, CloudReader, CloudRecording, reader_of
from fcslam.sources.faults import Audit, Fault
from fcslam.sources.gate import FIRST_MESSAGES
from fcslam.sources.logs.archive import translate_errors
from fcslam.sources.point_clouds import CloudBand, CloudMounting, PointCloud
from fcslam.sources.source import Survey
from fcslam.untrusted import read_bytes, read_text

SUFFIXES: Final = (".bin", ".pcd", ".ply")
_TIME_FILES: Final = ("times.txt", "timestamps.txt")
_PERIOD_S: Final = 0.1
_MOST_BYTES: Final = 32 * MOST_POINTS
_LEAST_TIME: Final = 1e8
"""Smaller names without a point are numbers of files."""
_UNITS: Final = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""Least stamp in each unit, and the unit in seconds; smaller ones are seconds."""
_PCD_TYPES: Final = {"I": "i", "U": "u", "F": "f"}
_PLY_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


def cloud_files(folder: Path) -> list[Path]:
    """The clouds in a folder, or in that of KITTI below it; empty: it has none."""
    for place in (folder, folder / "velodyne", folder / "velodyne_points" / "data", folder / "data"):
        for suffix in SUFFIXES if place.is_dir() else ():
            if files := list(place.glob(f"*{suffix}")):
                return sorted(files, key=_in_order)
    return []


class CloudFolder(CloudRecording):
    """A folder of clouds as the recording of a robot with a 3D LiDAR and nothing else."""

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(path, name, "file")
        self._files = cloud_files(path)

    @cached_property
    def _stamps(self) -> list[float]:
        return self._times or [_PERIOD_S * number for number in range(len(self._files))]

    @cached_property
    def _times(self) -> list[float]:
        """Times of the clouds, seconds; empty if nothing gives them."""
        above = (self._files[0].parent, self._files[0].parent.parent, self.path)
        for file in (place / name for place in above for name in _TIME_FILES):
            if file.is_file():
                with translate_errors(file):
                    text = read_text(file)
                lines = [line.strip() for line in text.splitlines() if line.strip()]
                if len(lines) < len(self._files):
                    raise SourceError(
                        f"{file}: has {len(lines)} times for {len(self._files)} clouds; give one for each"
                    )
                return [_seconds(line, file) for line in lines[: len(self._files)]]
        if not all(re.fullmatch(r"[0-9]{1,19}(\.[0-9]+)?", file.stem) for file in self._files):
            return []
        numbers = [float(file.stem) for file in self._files]
        if not min(numbers) > _LEAST_TIME and not any("." in file.stem for file in self._files):
            return []
        unit_s = next((unit_s for least, unit_s in _UNITS if numbers[0] >= least), 1.0)
        return [number * unit_s for number in numbers]

    @cached_property
    def _reader(self) -> tuple[CloudReader, tuple[str, ...]]:
        first = [self._cloud(number) for number in range(len(self._files))[:FIRST_MESSAGES]]
        mounting = CloudMounting(np.eye(3), np.zeros(3), 0.0, is_height_known=False)
        reader, notes = reader_of(first, mounting, CloudBand(), str(self.path))
        if not self._times:
            assumed = f"nothing gives their times, so they count as {_PERIOD_S:g} s apart; write one each to times.txt"
            notes = (f"{self.path}: {assumed}", *notes)
        return reader, notes

    def _cloud(self, number: int) -> PointCloud:
        return read_cloud(self._files[number], self._stamps[number])

    def survey(self) -> Survey:
        """As in ``CloudRecording``."""
        _, notes = self._reader
        stamps = self._stamps
        return Survey(len(stamps), stamps[-1] - stamps[0], 0.0, (BAND_LASER,), self._audit.faults(), notes)

    def _scans(self, audit: Audit) -> Iterator[tuple[int, CloudScan]]:
        (reader, _), nothing = self._reader, np.zeros((0, 7))
        for number in range(len(self._files)):
            try:
                yield number + 1, reader.scan(self._cloud(number), nothing[:, :4], nothing)
            except (SourceError, ValueError):
                audit.add(Fault.BROKEN_MESSAGE, number + 1)


def _in_order(file: Path) -> list[str | float]:
    """Orders files by the numbers in their names, with as many digits as they have."""
    return [float(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+(?:\.\d+)?)", file.stem))]


def read_cloud(path: Path, stamp: float) -> PointCloud:
    """The cloud in a file."""
    with translate_errors(path):
        content = read_bytes(path, most=_MOST_BYTES)
    try:
        values = {".bin": _kitti, ".pcd": _pcd, ".ply": _ply}[path.suffix](content)
        points = np.stack([values[axis].astype(np.float64) for axis in "xyz"], axis=1)
        times = next((values[name] for name in TIMES if name in (values.dtype.names or ())), None)
        return measured_cloud(stamp, "", points, times, LONGEST_SWEEP_S)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise SourceError(f"{path}: is not a cloud that can be read ({error}); write it again") from error


def _kitti(content: bytes) -> NDArray[Any]:
    return np.frombuffer(content, [(name, "<f4") for name in ("x", "y", "z", "intensity")])


def _pcd(content: bytes) -> NDArray[Any]:
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = content.index(b"\n", at)
        key, *words = content[at:end].decode("ascii", "replace").split() or ["#"]
        header[key], at = words, end + 1
    names = [name if name != "_" else f"_{k}" for k, name in enumerate(header["FIELDS"])]
    kinds = [f"<{_PCD_TYPES[kind]}{int(size)}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    counts = map(int, header.get("COUNT", ["1"] * len(names)))
    if header["DATA"] not in (["ascii"], ["binary"]):
        raise ValueError(f"DATA {' '.join(header['DATA'])}: convert it to binary with pcl_convert_pcd_ascii_binary")
    fields = list(zip(names, kinds, counts, strict=True))
    return _rows(content[at:], fields, int(header["POINTS"][0]), header["DATA"] == ["ascii"])


def _ply(content: bytes) -> NDArray[Any]:
    end = content.index(b"end_header")
    lines = [line.split() for line in content[:end].decode("ascii", "replace").splitlines()]
    begin = content.index(b"\n", end) + 1
    elements = [words for words in lines if words[:1] == ["element"]]
    if lines[0] != ["ply"] or elements[0][1] != "vertex":
        raise ValueError("its first element is not `vertex`")
    after = lines.index(elements[0]) + 1
    until = lines.index(elements[1]) if len(elements) > 1 else len(lines)
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[lines[1][1]]
    properties = [words for words in lines[after:until] if words[:1] == ["property"]]
    fields = [(words[-1], order + _PLY_TYPES[words[1]], 1) for words in properties]
    return _rows(content[begin:], fields, int(elements[0][2]), not order)


def _rows(content: bytes, fields: list[tuple[str, str, int]], count: int, is_text: bool) -> NDArray[Any]:
    """The points, by the names of the fields, with their types and numbers of values."""
    layout = [(name, "f8" if is_text else kind, (many,) if many > 1 else ()) for name, kind, many in fields]
    if not is_text:
        return np.frombuffer(content, layout, count)
    lines = content.decode("ascii").splitlines()[:count]
    if not 0 < count == len(lines):
        raise ValueError(f"{len(lines)} lines for {count} points")
    return np.loadtxt(StringIO("\n".join(lines)), layout, ndmin=1)


def _seconds(text: str, file: Path) -> float:
    with suppress(ValueError):
        if isfinite(seconds := float(text)):
            return seconds
    try:  # KITTI's raw data has nanoseconds
        stamp = datetime.fromisoformat(text)
        return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
    except ValueError as error:
        raise SourceError(f"{file}: {text!r} is not a time; give seconds, or dates as in KITTI") from error
