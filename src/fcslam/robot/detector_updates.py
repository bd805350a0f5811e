"""Detectors that the cloud has announced: fetched by the sender, taken by the front end between two records.

A recording that is resumed takes each where it took it before, so that it says the same again.
"""

import queue
from pathlib import Path

from fcslam.errors import FeatureError, StateError
from fcslam.records import DetectorFile
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.outbox import Outbox
from fcslam.storage.files import write_file


class DetectorUpdates:
    """From the thread that hears of a detector to the one that uses it."""

    def __init__(self, folder: Path, outbox: Outbox, frontend: RobotFrontend) -> None:
        """``folder``: for the files; the outbox keeps when each was taken."""
        self._folder = folder
        self._outbox = outbox
        self._frontend = frontend
        self._fetched: queue.SimpleQueue[DetectorFile] = queue.SimpleQueue()
        self._taken: dict[int, DetectorFile] = {}
        self.notice: str | None = None
        """What came of the last one."""

    def resume(self) -> None:
        """Look up what the session, once begun, took before it was stopped."""
        self._taken = self._outbox.detector_updates()

    def store(self, file: DetectorFile, content: bytes) -> None:
        """Called by the sender: here is what was announced.

        Raises:
            StateError: it cannot be written.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_file(self._path(file), content)  # a recording that is resumed may need the old one
        except OSError as error:
            raise StateError(
                f"{self._folder}: detector {file.version} cannot be kept there ({error}); make room, and --resume"
            ) from error
        self._fetched.put(file)

    def apply_due(self, record: int, catching_up: bool) -> None:
        """Called before each record, which are counted from 0: let the front end have what is due."""
        file = self._taken.get(record)
        is_news = not catching_up and record > max(self._taken, default=-1)
        if file is None and is_news and not self._fetched.empty():
            file = self._fetched.get()
            if file in self._taken.values():
                return
            self._outbox.record_detector_update(record, file)
            self._taken[record] = file
        if file is None:
            return
        try:
            self._frontend.set_detector(file, self._path(file))
            self.notice = f"detector {file.version} from now on"
        except FeatureError as error:
            self.notice = f"detector {file.version} not taken: {error}"

    def _path(self, file: DetectorFile) -> Path:
        return self._folder / f"{file.channel.value}-{file.version}.onnx"
