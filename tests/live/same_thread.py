"""An executor without a thread: it does a task at once, or on request."""

import threading
from concurrent.futures import BrokenExecutor, Executor, Future


class SameThread(Executor):
    def __init__(self):
        self._tasks = []
        self._alone = threading.RLock()  # one task at a time, as in the only worker of a process pool
        self.holds = self.is_broken = False

    def submit(self, function, /, *arguments):
        future = Future()
        self._tasks.append((future, function, arguments))
        if not self.holds:
            self.work()
        return future

    def work(self):
        tasks, self._tasks = self._tasks, []
        for future, function, arguments in tasks:
            try:
                if self.is_broken:
                    raise BrokenExecutor("it was killed")
                with self._alone:
                    result = function(*arguments)
                future.set_result(result)
            except Exception as error:
                future.set_exception(error)
