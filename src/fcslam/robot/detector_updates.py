"""Detector updates: downloaded by the sender, used by the front end from the next record on.

A resumed recording switches at the same records again, so that it produces the same packets.
"""

import queue
from concurrent.futures import Future
from pathlib import Path

from fcslam.errors import InputError
from fcslam.records import DetectorFile
from fcslam.robot.frontend import RobotFrontend
from fcslam.robot.outbox import Outbox
from fcslam.storage.files import write_file
from fcslam.wire.messages import Body


class DetectorUpdates:
    """Passes new detectors from the thread that downloads them to the one that uses them."""

    def __init__(self, folder: Path, outbox: Outbox, frontend: RobotFrontend) -> None:
        """``folder`` holds the files; the outbox records when each was applied, also before an interruption."""
        self._folder, self._outbox, self._frontend = folder, outbox, frontend
        self._fetched: queue.SimpleQueue[DetectorFile] = queue.SimpleQueue()
        self._applied = outbox.detector_updates()
        self._last: tuple[DetectorFile, Future[list[Body]]] | None = None
        """The last update, and whether the back end took it."""

    @property
    def notice(self) -> str | None:
        """Outcome of the last update, once it is known."""
        if self._last is None or not self._last[1].done():
            return None
        file, error = self._last[0], self._last[1].exception()
        return f"detector {file.version} " + ("from now on" if error is None else f"not taken: {error}")

    def store(self, file: DetectorFile, content: bytes) -> None:
        """Store a downloaded detector. Called by the sender."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_file(self._path(file), content)  # a resumed recording may need the old one
        except OSError as error:
            raise InputError(
                f"{self._folder}: cannot store detector {file.version} ({error}); free some space, then use --resume"
            ) from error
        self._fetched.put(file)

    def is_due(self, record: int) -> bool:
        """Whether a new detector waits, or an interrupted recording applied one before this record."""
        return record in self._applied or not self._fetched.empty()

    def apply_due(self, record: int, catching_up: bool) -> None:
        """Give the front end the detector that is due before this record, counted from 0."""
        newest = max(self._applied, default=-1)
        if not catching_up and record > newest and not self._fetched.empty():
            file = self._fetched.get()
            if file == self._applied.get(newest):
                return
            self._outbox.record_detector_update(record, file)
            self._applied[record] = file
        if record in self._applied:
            file = self._applied[record]
            self._last = file, self._frontend.set_detector(file, self._path(file))

    def _path(self, file: DetectorFile) -> Path:
        return self._folder / f"{file.channel.value}-{file.version}.onnx"
