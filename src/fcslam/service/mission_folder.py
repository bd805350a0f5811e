"""The folder of a service's missions.

detectors/<channel>/<version>.onnx   networks that robots may fetch
missions/<name>/mission.sqlite       what was received: all that must not be lost
                live/                the run folder of what is believed now
                joint.maps           the grids and poses that robots get, drawn more often than the run folder
                runs/<number>/       the newest run folders that were asked for
                worker.state         the worker's state some packets ago, for a quick restart; may be deleted
                worker.task          what the worker is doing, to refuse a packet that ends worker after worker
                worker.lock          held by the mission's worker
open                                 name of the open mission
lock                                 held by the service that uses the folder
"""

import os
import shutil
from pathlib import Path
from typing import Self

from fcslam.runs import Run
from fcslam.wire.checks import check_name

KEPT = 4
"""Newest live runs, and newest results, that a mission keeps."""


class MissionFolder:
    """One mission's files."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.name
        self.store = path / "mission.sqlite"
        self.live = path / "live"
        """A link to a run folder, which is replaced atomically."""
        self.joint_maps = path / "joint.maps"
        self.snapshot = path / "worker.state"
        self.worker_task = path / "worker.task"
        self.worker_lock = path / "worker.lock"

    @classmethod
    def of(cls, root: Path, name: str) -> Self:
        """Files of a mission below the folder ``root``, there or not."""
        check_name(name, "mission")
        return cls(root / "missions" / name)

    def run(self, name: str) -> Path:
        """The run folder of a requested result."""
        return self.path / "runs" / name

    def result(self, name: str) -> Path | None:
        """The run folder of a requested result, if it is there."""
        return self.run(name).resolve() if self.run(name).is_dir() else None

    def publish(self, run: Run) -> None:
        """Make ``run`` the live one; those before it stay for a while, for readers that have them open."""
        snapshots = self.path / "snapshots"
        name = str(int(self.live.resolve().name) + 1 if self.live.exists() else 1)
        run.save(snapshots / name, force=True)
        link = self.path / ".live.partial"
        link.unlink(missing_ok=True)
        link.symlink_to(Path("snapshots") / name, target_is_directory=True)
        os.replace(link, self.live)
        keep_newest(snapshots)


def keep_newest(folder: Path) -> None:
    """Remove all but the newest run folders, whose names are numbers."""
    for old in sorted(int(run.name) for run in folder.iterdir() if run.name.isdecimal())[:-KEPT]:
        shutil.rmtree(folder / str(old), ignore_errors=True)
