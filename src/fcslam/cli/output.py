"""Where commands write: messages on stderr, answers on stdout, and new folders named by the time."""

from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from fcslam.runs import MapVerdict

RUNS, RECORDINGS, FEATURES, TRAINING = "runs", "recordings", "features", "training"
CHANGES = "changes"
"""Default parents of output folders."""
ELSEWHERE = "choose another place"
"""Advice where a file or folder cannot be written."""
MOST_NAMES = 6
"""Sessions of a map that are named; of more, the number is printed."""


def new_folder(parent: str, now: datetime | None = None) -> Path:
    """A folder that does not exist yet, ``parent/YYYY-MM-DD-HHMMSS`` in local time, with ``-2``, ``-3`` ... if taken.

    The folder is not created.
    """
    first = Path(parent) / f"{now or datetime.now():%Y-%m-%d-%H%M%S}"
    later = (first.with_name(f"{first.name}-{number}") for number in count(2))
    return next(later_one for later_one in later if not later_one.exists()) if first.exists() else first


def notices(quiet: bool = False) -> "Console":
    """The console for progress and notices: stderr, or nothing if ``quiet``."""
    from rich.console import Console

    return Console(stderr=True, quiet=quiet)


def answers() -> "Console":
    """The console for the answer of a command: stdout."""
    from rich.console import Console

    return Console()


def print_line(console: "Console", text: str) -> None:
    """Print ``text`` as it stands: no markup, no colours, no line breaks at the console's width."""
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def once_printer(console: "Console") -> Callable[[str], None]:
    """A function that prints each different line once."""
    printed = set[str]()

    def print_once(line: str) -> None:
        if line not in printed:
            printed.add(line)
            print_line(console, line)

    return print_once


def verdict_lines(verdicts: "Sequence[MapVerdict]") -> "Iterator[str]":
    """Whether to use each map, and what that rests on."""
    for one in verdicts:
        names = f"{len(one.robots)} sessions" if len(one.robots) > MOST_NAMES else ", ".join(one.robots)
        yield f"map {one.map_index} ({names}): {one}"
        yield from (f"  {line}" for line in one.details)
