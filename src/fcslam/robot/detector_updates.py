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
        """``folder`` holds the files; the outbox records when each was applied."""
        self._folder = folder
        self._outbox = outbox
        self._frontend = frontend
        self._fetched: queue.SimpleQueue[DetectorFile] = queue.SimpleQueue()
        self._applied: dict[int, DetectorFile] = {}
        self._last: tuple[DetectorFile, Future[list[Body]]] | None = None
        """The last update, and whether the back end took it."""

    @property
    def notice(self) -> str | None:
        """Outcome of the last update, once it is known."""
        if self._last is None or not self._last[1].done():
            return None
        file, error = self._last[0], self._last[1].exception()
        if error is not None:
            return f"detector {file.version} not taken: {error}"
        return f"detector {file.version} from now on"

    def resume(self) -> None:
        """Load the updates that this recording applied before it was interrupted."""
        self._applied = self._outbox.detector_updates()

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

    @property
    def has_news(self) -> bool:
        """Whether a detector waits that the front end has not got."""
        return not self._fetched.empty()

    def is_due(self, record: int) -> bool:
        """Whether an interrupted recording applied a detector before this record."""
        return record in self._applied

    def apply_due(self, record: int, catching_up: bool) -> None:
        """Give the front end the detector that is due before this record, counted from 0."""
        file = self._applied.get(record)
        is_new = not catching_up and record > max(self._applied, default=-1)
        if file is None and is_new and not self._fetched.empty():
            file = self._fetched.get()
            if self._applied and file == self._applied[max(self._applied)]:
                return
            self._outbox.record_detector_update(record, file)
            self._applied[record] = file
        if file is not None:
            self._last = file, self._frontend.set_detector(file, self._path(file))

    def _path(self, file: DetectorFile) -> Path:
        return self._folder / f"{file.channel.value}-{file.version}.onnx"
