"""The exceptions. An ``InputError`` gives exit code 2 and one line that says what is wrong, where, and what to do."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_SYSTEM_ERROR = re.compile(r"\[Errno -?\d+\] ([^:()]+)(?:: '([^']*)')?")
"""How Python writes an error of the operating system: its number, its text, and often the file."""


class FcslamError(Exception):
    """Base class of all exceptions of fcslam.

    In the message, an error of the operating system has no number, and no file if the message begins with that file.
    """

    def __init__(self, message: str) -> None:
        super().__init__(_SYSTEM_ERROR.sub(lambda found: _readable(found, message), message))


@contextmanager
def writing(path: Path, advice: str = "free disk space and run the same command again") -> Iterator[None]:
    """Report an error of the operating system in this block as one of writing ``path``; ``advice``: what to do then."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error}); {advice}") from error


def printable(text: str) -> str:
    """The text without the line breaks and control characters that a terminal would obey: recordings hold any names."""
    return "".join(letter if letter.isprintable() else " " if letter.isspace() else "?" for letter in text)


def _readable(system_error: re.Match[str], message: str) -> str:
    text, file = system_error.groups()
    return text if file is None or message.startswith(file) else f"{text}: '{file}'"


class InputError(FcslamError):
    """An input of the user is wrong; the message says what, where and what to do."""


class SourceError(InputError):
    """A recording cannot be read."""


class FeatureError(InputError):
    """Network weights, images or extracted features cannot be used."""


class CloudError(InputError):
    """The cloud permanently rejects a robot: its token, its name, its certificate or its packets."""


class OversizeError(CloudError):
    """The cloud or a proxy rejects a request of this size; a smaller one may be accepted."""


class UnavailableError(FcslamError):
    """The cloud is unreachable or busy; the same request may succeed later."""

    def __init__(self, message: str, retry_after_s: float = 0.0) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s
        """Time to wait before the next attempt, as the cloud asks; 0 if it does not."""


class StoreError(InputError):
    """A mission cannot be stored or read: a full disk, a damaged or foreign file, an unreachable database."""

    def __init__(self, message: str, is_away: bool = False) -> None:
        super().__init__(message)
        self.is_away = is_away
        """Whether it is a database, which may be back soon."""


class PacketError(FcslamError):
    """Received bytes are not a valid packet; the message says why."""

    def __init__(self, message: str, index: int | None = None) -> None:
        super().__init__(message)
        self.index = index
        """Index of the packet in its batch, if the packets before it are stored."""


class PacketConflictError(PacketError):
    """A packet has the number of a different packet that is already stored."""
