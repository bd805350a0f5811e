"""The page over recordings that are being mapped. Copies of the mapping process write run folders for it, now and then.

So the mapping is as it would be without a page: it neither waits for a picture nor computes one.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from socket import socket
from tempfile import TemporaryDirectory

import cv2

from fcslam.errors import FcslamError
from fcslam.mission.mission import MissionCloud
from fcslam.page.shown_run import ShownRun
from fcslam.page.viewer import ReadOnly, run_viewer, viewer_app
from fcslam.processes import RecurringTask, Start, start_copy
from fcslam.service.mission_folder import MissionFolder
from fcslam.service.worker import LIVE_EVERY_S, LIVE_LOOK_S

SHARE = 0.5
"""Share of the time for writing. Copies have a low priority, so they mostly use what the mapping leaves."""

_log = logging.getLogger(__name__)


class LiveMap:
    """Writes the map so far beside the mapping, for at most half of the time, at a low priority."""

    def __init__(self, folder: MissionFolder, clock: Callable[[], float], start: Start) -> None:
        """``start`` runs a task in a copy of this process."""
        self._folder, self._clock = folder, clock
        self._task = RecurringTask(start, clock, SHARE, LIVE_EVERY_S)
        self._look_at = clock() + LIVE_EVERY_S

    def look(self, cloud: MissionCloud) -> None:
        """Start to write the map so far if the one before is written and some time ago; returns at once."""
        now = self._clock()
        if now < self._look_at:
            return
        self._look_at = now + LIVE_LOOK_S
        if self._task.end():
            _log.warning("the live map stays as it was: its writer failed")
        if self._task.is_due:
            self._task.begin(lambda: self._write(cloud))

    def finish(self, run_folder: Path) -> None:
        """Show the finished run from now on."""
        self.stop()
        self._folder.make_live(run_folder.resolve())

    def stop(self) -> None:
        """Write no further map."""
        self._task.stop()

    def _write(self, cloud: MissionCloud) -> None:
        try:
            self._folder.publish(cloud.run_so_far())
        except (FcslamError, OSError) as error:  # the next one may succeed
            _log.warning("the live map stays as it was: %s", error)


@contextmanager
def live_page(listening: socket, name: str) -> Iterator[LiveMap]:
    """Serve the page from a process of its own until the block ends."""
    cv2.setNumThreads(1)  # a copy of this process would wait for threads that it does not have
    with TemporaryDirectory() as place:
        folder = MissionFolder(Path(place))
        server = start_copy(lambda: _serve(listening, folder.live, name), niceness=0)
        live = LiveMap(folder, time.monotonic, start_copy)
        try:
            yield live
        finally:
            live.stop()
            server.terminate()
            server.join()


def _serve(listening: socket, place: Path, name: str) -> None:
    with ShownRun(place, name) as shown:
        run_viewer(viewer_app(ReadOnly(shown)), listening)
