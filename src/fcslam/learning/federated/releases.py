"""The versions of the detector that a learning fleet released, and which one its robots are to use.

<folder>/0.onnx, 1.onnx ...   the detector from which training started, and the released versions
<folder>/1.npz ...            their weights
<folder>/releases.json        their detector versions, which of them were taken back, and which one is in use
"""

import json
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fcslam.errors import OutputError, TrainingError
from fcslam.learning.arrays import write_arrays
from fcslam.learning.federated.weights import Weights
from fcslam.storage.files import write_file
from fcslam.untrusted import read_arrays

INDEX: Final = "releases.json"


@dataclass(slots=True)
class Releases:
    """Any thread may call."""

    folder: Path
    versions: list[str] = field(default_factory=list)
    """Detector versions; the first is the one from which training started."""
    taken_back: set[int] = field(default_factory=set)
    """Numbers of versions that turned out worse."""
    in_use: int = 0
    """Number of the version that robots are to use."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def opened(cls, folder: Path, start: bytes, version: str) -> "Releases":
        """The releases in a folder, or those of a new fleet, which starts from a detector's file.

        Raises:
            TrainingError: the folder holds something else.
            OutputError: it cannot be written.
        """
        path = folder / INDEX
        try:
            if path.exists():
                known = json.loads(path.read_text(encoding="utf-8"))
                return cls(folder, list(map(str, known["versions"])), set(map(int, known["taken_back"])),
                           int(known["in_use"]))  # fmt: skip
            folder.mkdir(parents=True, exist_ok=True)
            write_file(folder / "0.onnx", start)
        except (ValueError, KeyError, TypeError) as error:
            raise TrainingError(f"{path}: is not a list of releases ({error}); name another folder") from error
        except OSError as error:
            raise OutputError(f"{folder}: cannot be used ({error}); free disk space") from error
        releases = cls(folder, [version])
        releases._write()
        return releases

    def detector(self, number: int) -> Path:
        """The file of a version."""
        return self.folder / f"{number}.onnx"

    @property
    def is_judged(self) -> bool:
        """Whether the version in use is a released one, which may turn out worse."""
        return self.in_use > 0

    @property
    def pair(self) -> tuple[int, int]:
        """Numbers of the version in use and of the one before it that was not taken back."""
        with self._lock:
            return self.in_use, self._before(self.in_use)

    def add(self, version: str, detector: bytes, weights: Weights) -> int:
        """Keep a released version, which is in use from now on; returns its number.

        Raises:
            OutputError: it cannot be written.
        """
        with self._lock:
            number = len(self.versions)
            try:
                write_arrays(self.folder / f"{number}.npz", dict(weights))
                write_file(self.detector(number), detector)
            except OSError as error:
                raise OutputError(f"{self.folder}: cannot be written ({error}); free disk space") from error
            self.versions.append(version)
            self.in_use = number
            self._write()
            return number

    def take_back(self, number: int) -> int:
        """Take a version back; if it is in use, the one before it is from now on. Returns the number of that in use."""
        with self._lock:
            self.taken_back.add(number)
            if self.in_use == number:
                self.in_use = self._before(number)
            self._write()
            return self.in_use

    def fallback(self, version: str, initial: Weights) -> Weights | None:
        """The weights to go on from if a version was taken back; None if it was not.

        Args:
            version: of the coordinator's best weights.
            initial: weights of the first version.
        """
        with self._lock:
            if version not in {self.versions[number] for number in self.taken_back}:
                return None
            return _weights(self.folder / f"{self.in_use}.npz") if self.in_use else initial

    def _before(self, number: int) -> int:
        return max((each for each in range(number) if each not in self.taken_back), default=0)

    def _write(self) -> None:
        index = {"versions": self.versions, "taken_back": sorted(self.taken_back), "in_use": self.in_use}
        try:
            write_file(self.folder / INDEX, json.dumps(index))
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error}); free disk space") from error


def _weights(path: Path) -> Weights:
    try:
        return read_arrays(path)
    except (OSError, ValueError) as error:
        raise TrainingError(f"{path}: cannot be read ({error})") from error
