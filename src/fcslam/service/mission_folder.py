"""The folder of a service's missions.

detectors/<channel>/<version>.onnx   networks that robots may fetch
missions/<name>/mission.sqlite       what was received: all that must not be lost
                live/                the run folder of what is believed now
                joint.maps           the grids and poses that robots get, drawn more often than the run folder
                runs/<number>/       the run folders that were asked for
                worker.state         the worker's state some packets ago, for a quick restart; may be deleted
                worker.task          what the worker is doing, to refuse a packet that ends worker after worker
                worker.lock          held by the mission's worker
open                                 name of the open mission
lock                                 held by the service that uses the folder
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from fcslam.runs import Run
from fcslam.wire.checks import check_name


@dataclass(frozen=True, slots=True)
class MissionFolder:
    """One mission's files."""

    path: Path

    @classmethod
    def of(cls, root: Path, name: str) -> Self:
        """Files of a mission below the folder ``root``, there or not.

        Raises:
            PacketError: ``name`` is not a valid name.
        """
        check_name(name, "mission")
        return cls(root / "missions" / name)

    @property
    def name(self) -> str:
        """Name of the mission."""
        return self.path.name

    @property
    def store(self) -> Path:
        """The mission store's file."""
        return self.path / "mission.sqlite"

    @property
    def live(self) -> Path:
        """The run folder of the current estimate: a link that is replaced atomically."""
        return self.path / "live"

    @property
    def joint_maps(self) -> Path:
        """The joint maps of the current estimate, for robots."""
        return self.path / "joint.maps"

    @property
    def snapshot(self) -> Path:
        """The worker's state, from which the next worker goes on; it may be deleted."""
        return self.path / "worker.state"

    @property
    def worker_task(self) -> Path:
        """The present task of the worker, for the worker after it."""
        return self.path / "worker.task"

    @property
    def worker_lock(self) -> Path:
        """Held by the mission's worker."""
        return self.path / "worker.lock"

    def run(self, name: str) -> Path:
        """The run folder of a requested result."""
        return self.path / "runs" / name

    def publish(self, run: Run) -> None:
        """Make ``run`` the live one; the previous one stays for readers that have it open.

        Raises:
            OutputError: it cannot be written.
        """
        snapshots = self.path / "snapshots"
        before = int(self.live.resolve().name) if self.live.exists() else 0
        name = str(before + 1)
        run.save(snapshots / name, force=True)
        self.make_live(Path("snapshots") / name)
        for old in snapshots.iterdir():
            if old.name not in (str(before), name):
                shutil.rmtree(old, ignore_errors=True)

    def make_live(self, run_folder: Path) -> None:
        """Make a run folder the live one; its path is relative to this folder, or absolute."""
        link = self.path / ".live.partial"
        link.unlink(missing_ok=True)
        link.symlink_to(run_folder, target_is_directory=True)
        os.replace(link, self.live)
