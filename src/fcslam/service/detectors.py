"""Detectors (ONNX networks) that robots may download, and the announced version of each channel."""

import tempfile
import threading
from pathlib import Path

from fcslam.features.detector_file import describe_detector_file
from fcslam.records import PLACE_CHANNELS, Channel, DetectorFile
from fcslam.storage.files import write_file

_ANNOUNCED = "announced"
"""File that names a channel's announced version."""


class DetectorStore:
    """One folder: ``<channel>/<version>.onnx``."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lock = threading.Lock()
        self._announced = {
            channel: describe_detector_file(self.path(channel, announced.read_text(encoding="utf-8")))
            for channel in PLACE_CHANNELS
            if (announced := root / channel / _ANNOUNCED).is_file()
        }

    def path(self, channel: Channel, version: str) -> Path:
        """Path of a version's file, which may not exist."""
        return self._root / channel / f"{version}.onnx"

    def versions(self) -> list[tuple[str, str]]:
        """Channel and version of every file."""
        return [
            (channel, path.stem)
            for channel in sorted(PLACE_CHANNELS)
            for path in sorted(self._root.glob(f"{channel}/*.onnx"))
        ]

    def announced(self) -> dict[Channel, DetectorFile]:
        """The announced detectors, by channel."""
        with self._lock:
            return dict(self._announced)

    def announce(self, content: bytes) -> DetectorFile:
        """Add a network and announce it to the robots."""
        self._root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._root) as folder:  # the file system of the store has room for it
            unchecked = Path(folder) / "network.onnx"
            unchecked.write_bytes(content)
            file = describe_detector_file(unchecked)  # without the lock: it loads the network
        place = self.path(file.channel, file.version)
        place.parent.mkdir(parents=True, exist_ok=True)
        with self._lock:
            write_file(place, content)
            write_file(place.parent / _ANNOUNCED, file.version)
            self._announced[file.channel] = file
        return file
