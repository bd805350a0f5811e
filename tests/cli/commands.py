"""Real commands that serve a page or an API, each in a process of its own."""

import os
import re
import signal
import subprocess
import sys


class Command:
    """A command that has said where it serves."""

    def __init__(self, *words, **environment):
        command = [sys.executable, "-m", "fcslam.cli", *map(str, words)]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", **environment}
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        self.url = re.search(r"https?://\S+:\d+", self.process.stdout.readline())[0]

    def kill(self):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()

    def stop(self, number=signal.SIGTERM):
        self.process.send_signal(number)
        self.process.wait(60)
        self.process.stdout.close()

    close = stop


class Service(Command):
    """A service at a port of its own."""

    def __init__(self, data, *options):
        super().__init__("serve", "--data", data, "--port", 0, *options)
