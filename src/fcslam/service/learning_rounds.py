"""The rounds of a federated training, as its server writes them, for viewers of the page."""

import csv
import math
from pathlib import Path
from typing import Final

from fcslam.errors import EvaluationError
from fcslam.service.http.responses import LearningRound

ROUNDS_FILE: Final = "rounds.csv"
"""In the output folder of `fcslam tools federate`."""
MOST_ROUNDS: Final = 10_000
_LOSS = "loss_"
_MEASURES = ("repeatability", "mma_3px", "revisit_recall", "places_found")


def read_rounds(folder: Path) -> list[LearningRound]:
    """The rounds so far, oldest first; none before the first one is done.

    Raises:
        EvaluationError: the table is damaged.
    """
    path = folder / ROUNDS_FILE
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [_round(row) for row, _ in zip(csv.DictReader(file), range(MOST_ROUNDS), strict=False)]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise EvaluationError(f"{path}: is not a table of rounds ({error})") from error


def _round(row: dict[str, str]) -> LearningRound:
    numbers = {
        name: float(text) for name, text in row.items() if (name.startswith(_LOSS) or name in _MEASURES) and text
    }
    known = {name: number for name, number in numbers.items() if math.isfinite(number)}
    return LearningRound(
        round=int(row["round"]),
        version=row["version"],
        released=row["released"] == "1",
        robots=[robot for robot in row["robots"].split(" | ") if robot],
        left_out=row["left_out"],
        reason=row.get("reason") or "",
        losses={name.removeprefix(_LOSS): number for name, number in known.items() if name.startswith(_LOSS)},
        measures={name: number for name, number in known.items() if name in _MEASURES},
    )
