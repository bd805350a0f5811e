"""What happened in every round: rounds.csv, written as a whole after each."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fcslam.errors import OutputError, TrainingError
from fcslam.storage.files import write_file

ROUNDS_FILE: Final = "rounds.csv"
LOSS: Final = "loss_"
"""What the columns of losses begin with."""

Row = dict[str, str]


@dataclass(frozen=True, slots=True)
class RoundReport:
    """One round."""

    round_number: int
    """From 1; 0 is the start."""
    version: str
    """Of the mean of weights after it, which is what may be judged and released."""
    robots: tuple[str, ...] = ()
    """Whose updates counted."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Why the others' did not."""
    losses: Mapping[str, float] = field(default_factory=dict)
    """Means over robots and steps."""
    figures: Mapping[str, float] = field(default_factory=dict)
    """Of the validation, if there was one."""
    score: float = math.nan
    released: bool = False
    """Whether that mean is the best so far: the new version of the detector."""
    returned: bool = False
    """Whether it was so bad that the fleet goes on from the best one."""
    bytes_down: int = 0
    bytes_up: int = 0
    """Weights to and from all robots."""
    seconds: float = 0.0
    epsilon: float = math.inf
    """What the robot that was asked most often has given away so far at most, see ``privacy``."""

    def row(self) -> Row:
        """As a line of the table."""
        return {
            "round": str(self.round_number),
            "version": self.version,
            "score": f"{self.score:.6g}",
            "released": str(int(self.released)),
            "returned": str(int(self.returned)),
            "bytes_down": str(self.bytes_down),
            "bytes_up": str(self.bytes_up),
            "seconds": f"{self.seconds:.3f}",
            "epsilon": f"{self.epsilon:.6g}",
            "robots": " | ".join(self.robots),
            "left_out": " | ".join(f"{robot}: {reason}" for robot, reason in sorted(self.left_out.items())),
            **{f"{LOSS}{name}": f"{value:.6g}" for name, value in self.losses.items()},
            **{name: f"{value:.6g}" for name, value in self.figures.items()},
        }


def read_rows(path: Path, last: int) -> list[Row]:
    """Lines up to round ``last``; none if there is no file.

    Raises:
        TrainingError: the file is no table of rounds.
    """
    if not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [row for row in csv.DictReader(file) if int(row["round"]) <= last]
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise TrainingError(f"{path}: is no table of rounds ({error}); take it away") from error


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write all lines, in one piece, and the folder if there is none.

    Raises:
        OutputError: they cannot be written; the file that was there stays.
    """
    content = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(content, list(names), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, content.getvalue())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error}); make room and run the same command again") from error
