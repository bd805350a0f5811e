"""Which format a recording has."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fcslam.errors import SourceError
from fcslam.sources.archive import head
from fcslam.sources.carmen import CARMEN
from fcslam.sources.cmu import CMU
from fcslam.sources.dialect import Dialect
from fcslam.sources.duke import DUKE
from fcslam.sources.mines import MINES
from fcslam.sources.source import Source
from fcslam.sources.textlog import TextLog


@dataclass(frozen=True, slots=True)
class Format:
    """A kind of recording."""

    name: str
    recognises: Callable[[Path, bytes], bool]
    """Told by the path and the first bytes (decompressed; none of a folder)."""
    open: Callable[[Path], Source]


def _text_format(dialect: Dialect) -> Format:
    return Format(dialect.name, lambda _, head: dialect.recognises(head), lambda path: TextLog(path, dialect))


FORMATS: tuple[Format, ...] = tuple(map(_text_format, (CARMEN, CMU, DUKE, MINES)))
"""Asked in this order; a new format is one more entry."""


def open_source(path: Path) -> Source:
    """The recording at ``path``; what it holds decides the format, not its name.

    Reads only the beginning: ``Source.survey`` finds what is wrong further on.

    Raises:
        SourceError: the file is missing, empty, unreadable, a damaged archive, or of no known format.
    """
    path = Path(path)
    content = b"" if path.is_dir() else head(path)
    for kind in FORMATS:
        if kind.recognises(path, content):
            return kind.open(path)
    *others, last = (kind.name for kind in FORMATS)
    known = f"{', '.join(others)} or {last}"
    if path.is_dir():
        raise SourceError(f"{path}: is a folder and no recording; give the file of a recording ({known})")
    raise SourceError(f"{path}: no recording of a known format (it starts with {content[:16]!r}); give a {known}")
