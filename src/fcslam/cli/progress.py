"""Progress of long commands: a bar on a terminal, elsewhere a plain line every few seconds."""

from collections.abc import Callable
from threading import Event, Thread
from time import monotonic
from typing import Final, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn
from rich.table import Column
from rich.text import Text

from fcslam.cli.output import print_line

INTERVAL_S: Final = 5.0
"""Time between two plain lines. It grows to a twentieth of the elapsed time, so that logs of long runs stay short."""
LONGEST_INTERVAL_S: Final = 60.0
SPEED_PERIOD_S: Final = 3600.0
"""Remaining times follow the speed over this period: a round of training may take many minutes."""
BAR_WIDTH: Final = 16
LONGEST_STAGE: Final = 20
"""Widths in characters that leave room for count, remaining time and some details at 80 columns."""


class ProgressDisplay:
    """The stages of a command, with count and remaining time each.

    The display starts with the first stage, so a command may refuse bad input or start processes before. Its methods
    may be called from any thread.

    Args:
        console: where to show progress; nothing is shown if it is quiet.
        heading: a line to print when the first stage starts.
        interval_s: time between two plain lines at first, in seconds.
    """

    def __init__(self, console: Console, heading: str = "", interval_s: float = INTERVAL_S) -> None:
        self._console = console
        self._heading = heading
        self._interval_s = interval_s
        self._is_live = console.is_terminal and not console.is_dumb_terminal and not console.quiet
        self._bars = Progress(
            _text("{task.description}", max_width=LONGEST_STAGE),
            BarColumn(bar_width=BAR_WIDTH),
            _TextOf(_count),
            _TextOf(_time),
            _text("{task.fields[details]}", ratio=1),
            console=console,
            transient=True,
            expand=True,
            disable=not self._is_live,
            speed_estimate_period=SPEED_PERIOD_S,
        )
        self._tasks: dict[str, TaskID] = {}
        self._printer: Thread | None = None
        self._ended = Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._printer is not None:
            self._printer.join()
        if self._is_live and self._tasks:
            self._bars.stop()

    def start(self, stage: str, total: int | None = None) -> Callable[[], None]:
        """Begin a stage of ``total`` items, None if unknown; returns the function to call after each item.

        A stage of unknown length ends when the next one begins.
        """
        task = self._begin(stage, total)
        return lambda: self._bars.advance(task)

    def show(self, stage: str, done: int, total: int, details: str = "") -> None:
        """Show that ``done`` of the ``total`` items of a stage are done; begins the stage if it is new."""
        task = self._tasks[stage] if stage in self._tasks else self._begin(stage, total)
        if done < total and self._bars.tasks[self._bars.task_ids.index(task)].finished:
            self._bars.reset(task)  # the same stage of another round
        self._bars.update(task, completed=done, total=total, details=details, visible=True)

    def _begin(self, stage: str, total: int | None) -> TaskID:
        if not self._tasks:
            self._start_display()
        for task in self._bars.tasks:
            if task.finished or task.total is None:
                self._bars.update(task.id, visible=False)
        self._tasks[stage] = self._bars.add_task(stage, total=total, details="")
        return self._tasks[stage]

    def _start_display(self) -> None:
        if self._heading:
            print_line(self._console, self._heading)
        if self._is_live:
            self._bars.start()
        elif not self._console.quiet:
            self._printer = Thread(target=self._print_lines, daemon=True)
            self._printer.start()

    def _print_lines(self) -> None:
        began = monotonic()
        interval_s = self._interval_s
        while not self._ended.wait(interval_s):
            line = "; ".join(_line(task) for task in self._bars.tasks if task.visible and not task.finished)
            if line:
                print_line(self._console, line)
            interval_s = max(self._interval_s, min((monotonic() - began) / 20.0, LONGEST_INTERVAL_S))


def _text(text: str, max_width: int | None = None, ratio: int | None = None) -> TextColumn:
    column = Column(no_wrap=True, overflow="ellipsis", max_width=max_width, ratio=ratio)
    return TextColumn(text, markup=False, table_column=column)


class _TextOf(ProgressColumn):
    """A column with a text that a function makes of the task."""

    max_refresh = 0.5

    def __init__(self, text: Callable[[Task], str]) -> None:
        super().__init__(Column(no_wrap=True))
        self._text = text

    def render(self, task: Task) -> Text:
        return Text(self._text(task))


def _count(task: Task) -> str:
    if task.total is None:
        return f"{task.completed:.0f}" if task.completed else ""
    return f"{task.completed:.0f}/{task.total:.0f}"


def _time(task: Task) -> str:
    """Remaining time if it is known, else elapsed time."""
    if task.total is None or task.finished:
        return _clock(task.finished_time if task.finished else task.elapsed)
    return f"{_clock(task.time_remaining)} left"


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return "-:--:--"
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def _line(task: Task) -> str:
    stage = " ".join(filter(None, (task.description, _count(task))))
    return ", ".join(filter(None, (stage, _time(task), task.fields["details"])))
