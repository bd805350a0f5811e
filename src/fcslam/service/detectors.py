"""Networks that robots may fetch, and which of them they are told to take."""

import tempfile
import threading
from pathlib import Path

from fcslam.features.detector_file import describe_detector_file
from fcslam.records import Channel, DetectorFile

LONGEST_FILE_BYTES = 64 * 2**20
STAGING = ".staging"
"""How folders are called of networks that are not taken in yet."""
_ANNOUNCED = "announced"
"""Beside the files of a channel: the version that robots are told of."""


class DetectorShelf:
    """One folder: ``<channel>/<version>.onnx``."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lock = threading.Lock()
        self._announced = {
            channel: describe_detector_file(self.path(channel, told.read_text(encoding="utf-8")))
            for channel in Channel
            if (told := root / channel / _ANNOUNCED).is_file()
        }

    def path(self, channel: Channel, version: str) -> Path:
        """Where the file of a version is, if it is there."""
        return self._root / channel / f"{version}.onnx"

    def versions(self) -> list[tuple[str, str]]:
        """Channel and version of every file."""
        return [
            (channel, path.stem) for channel in sorted(Channel) for path in sorted(self._root.glob(f"{channel}/*.onnx"))
        ]

    def announced(self) -> dict[Channel, DetectorFile]:
        """What robots are told to take, by channel."""
        with self._lock:
            return dict(self._announced)

    def announce(self, content: bytes) -> DetectorFile:
        """Take in a network's file and tell robots of it from now on.

        Raises:
            FeatureError: it is no network that this fcslam runs.
        """
        self._root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._root, prefix=STAGING) as folder:
            staging = Path(folder) / "network.onnx"
            staging.write_bytes(content)
            file = describe_detector_file(
                staging
            )  # loads the network: robots that ask what is announced do not wait for that
            place = self.path(file.channel, file.version)
            place.parent.mkdir(exist_ok=True)
            with self._lock:
                staging.replace(place)
                staging.write_text(file.version, encoding="utf-8")
                staging.replace(place.parent / _ANNOUNCED)
                self._announced[file.channel] = file
        return file
