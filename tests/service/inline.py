"""The worker's background tasks, run at once."""

from collections.abc import Callable


class InlineTask:
    """A task that is done when it is started."""

    def __init__(self, task: Callable[[], None], _niceness: int) -> None:
        self.exitcode = 0
        try:
            task()
        except SystemExit as end:
            self.exitcode = end.code

    def terminate(self) -> None:
        pass

    def join(self) -> None:
        pass
