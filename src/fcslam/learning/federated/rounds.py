"""Federated rounds in reports: the outcome of each round, and the table of them."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from fcslam.errors import writing
from fcslam.storage.files import write_file

ROUNDS_FILE: Final = "rounds.csv"
LOSS: Final = "loss_"
"""Prefix of the columns of losses."""
Row = Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A version beside the released one; without arguments: it was not evaluated."""

    metrics: Mapping[str, float] = field(default_factory=dict)
    """Medians over the evaluators, or means over held-out pairs with their gains."""
    score: float = math.nan
    """By which versions are compared, in [0, 1]."""
    gain: float = math.nan
    """Gain of the score over that of the released version."""
    released: bool = False
    """Whether it is the new detector."""
    reason: str = ""
    """The gate's reason for releasing it or not; empty without a gate."""
    scores: Mapping[str, float] = field(default_factory=dict)
    """By evaluator."""


@dataclass(frozen=True, slots=True)
class RoundReport:
    """The outcome of a round."""

    round_number: int
    """From 1."""
    version: str
    """Detector version of the moving average of weights after the round, which is evaluated and released."""
    robots: tuple[str, ...] = ()
    """Robots whose updates were aggregated."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Reasons by robot why other updates were not, and other problems of the round by what they concern."""
    losses: Mapping[str, float] = field(default_factory=dict)
    """Means over robots and steps."""
    evaluation: Evaluation = Evaluation()
    returned: bool = False
    """The version was so bad that training returned to the best one."""
    bytes_down: int = 0
    """Size of the weights that were sent to all robots."""
    bytes_up: int = 0
    """Size of the weights that all robots sent."""
    seconds: float = math.nan
    """Duration of the round."""

    @property
    def released(self) -> bool:
        """The version is the best so far and becomes the new detector."""
        return self.evaluation.released

    def row(self) -> Row:
        """The cells of the table by column."""
        return {
            "round": str(self.round_number),
            "version": self.version,
            "score": f"{self.evaluation.score:.6g}",
            "released": str(int(self.released)),
            "returned": str(int(self.returned)),
            "reason": self.evaluation.reason,
            "bytes_down": str(self.bytes_down),
            "bytes_up": str(self.bytes_up),
            "seconds": f"{self.seconds:.3f}",
            "robots": " | ".join(self.robots),
            "left_out": " | ".join(f"{robot}: {reason}" for robot, reason in sorted(self.left_out.items())),
            **{f"{LOSS}{name}": f"{value:.6g}" for name, value in self.losses.items()},
            **{name: f"{value:.6g}" for name, value in self.evaluation.metrics.items()},
        }


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Replace the table atomically; its folder is created if it does not exist."""
    content = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(content, list(names), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, content.getvalue())
