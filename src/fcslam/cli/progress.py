"""Progress of long commands: a bar on a terminal, elsewhere a plain line every few seconds."""

from collections.abc import Callable
from threading import Event, Thread
from time import monotonic
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from fcslam.cli.output import print_line

LEAST_DONE_PERCENT = 10.0
"""Before this, the first items, which compile code or are short, say nothing about the others."""


class _TimeLeft(TimeRemainingColumn):
    def render(self, task: Task) -> Text:
        return super().render(task) if task.percentage >= LEAST_DONE_PERCENT else Text("")


class ProgressDisplay:
    """The stages of a command, with count, elapsed and remaining time each.

    It starts with the first stage, so a command may refuse bad input or start processes before. Any thread may call.

    Args:
        console: where to show progress; nothing is shown if it is quiet.
        heading: a line to print when the first stage starts.
        interval_s: time between two plain lines at first, in seconds. It grows to a twentieth of the elapsed time and
            at most a minute, so that logs of long runs stay short. A line without news comes a twelfth as often.
    """

    def __init__(self, console: Console, heading: str = "", interval_s: float = 5.0) -> None:
        self._console = console
        self._heading = heading
        self._interval_s = interval_s
        self._is_live = console.is_terminal and not console.is_dumb_terminal and not console.quiet
        self._count, self._elapsed, self._left = MofNCompleteColumn(), TimeElapsedColumn(), _TimeLeft()
        whole, cut = Column(no_wrap=True, overflow="ellipsis", max_width=20), Column(no_wrap=True, ratio=1)
        self._bars = Progress(
            TextColumn("{task.description}", markup=False, table_column=whole),
            BarColumn(bar_width=16),  # leaves room for some details at 80 columns
            self._count,
            self._elapsed,
            self._left,
            TextColumn("{task.fields[details]}", markup=False, table_column=cut),
            console=console,
            transient=True,
            expand=True,
            disable=not self._is_live,
            speed_estimate_period=3600.0,  # a round of training may take many minutes
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
        interval_s, printed, printed_s = self._interval_s, None, began
        while not self._ended.wait(interval_s):
            shown = [task for task in self._bars.tasks if task.visible and not task.finished]
            state = [(task.id, task.completed, task.fields["details"]) for task in shown]
            if shown and (state != printed or monotonic() >= printed_s + 12.0 * self._interval_s):
                print_line(self._console, "; ".join(map(self._line, shown)))
                printed, printed_s = state, monotonic()
            interval_s = max(self._interval_s, min((monotonic() - began) / 20.0, 60.0))

    def _line(self, task: Task) -> str:
        left = self._left.render(task).plain
        count = self._count.render(task).plain.strip() if task.total or task.completed else ""
        stage, elapsed = f"{task.description} {count}".strip(), self._elapsed.render(task).plain
        told = stage, elapsed, f"{left} left" if left else "", task.fields["details"]
        return ", ".join(filter(None, told))
