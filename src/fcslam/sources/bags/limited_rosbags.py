"""The readers of rosbags with limits on what a file from somebody else expands to.

rosbags decompresses without a limit, expands the YAML of the QoS profiles that a bag stores, and runs the views of a
database. The first two are replaced where rosbags looks them up; SQLite gets its limits by a hook of apsw.
"""

import os
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final
from urllib.parse import quote

from fcslam.config import parse_yaml
from fcslam.untrusted import (
    MOST_STREAM_RATIO,
    STEPS,
    LimitError,
    check_file,
    check_unpacked,
    longest_value,
    most_unpacked,
    open_zstd,
    read_text,
    step_counter,
    unpack,
)

METADATA: Final = "metadata.yaml"
_MOST_METADATA_BYTES: Final = 1 << 20


def ros1_reader(path: Path) -> Any:
    """A reader of a ROS 1 bag, not yet opened."""
    _limit_rosbags()
    from rosbags import rosbag1

    class Reader(rosbag1.Reader):
        """Refuses an index that is read again and again, as many chunks with one index, and chunks without end."""

        def __init__(self, path: Path) -> None:
            super().__init__(path)
            self._index_left = path.stat().st_size
            self._unpacked_left = most_unpacked(self._index_left, 10 * MOST_STREAM_RATIO)

        def read_index_data(self, pos: int, indexes: Any) -> None:
            """As in rosbags."""
            assert self.bio is not None
            begin = self.bio.tell()
            super().read_index_data(pos, indexes)
            self._index_left -= self.bio.tell() - begin
            if self._index_left < 0:
                raise LimitError("its chunks share their index")

        def read_chunk(self) -> Any:
            """As in rosbags; messages of chunks that overlap unpack a chunk more than once."""
            chunk = super().read_chunk()

            def unpacked(packed: bytes) -> bytes:
                content = chunk.decompressor(packed)
                self._unpacked_left -= len(content)
                if self._unpacked_left < 0:
                    raise LimitError("its chunks unpack to more than the limit for a file of this size")
                return content

            return chunk._replace(decompressor=unpacked)

    return Reader(path)


def ros2_reader(path: Path, suffix: str) -> Any:
    """A reader of a file of ROS 2 with ``suffix``, or of a folder with its metadata (``dir``), not yet opened."""
    _limit_rosbags()
    from rosbags import rosbag2

    if suffix == "dir":
        check_metadata(path)
        return rosbag2.Reader(path)
    # rosbags puts the path of a database into a URI as it is
    return rosbag2.Reader.STORAGE_PLUGINS[suffix](Path(quote(os.fsencode(path))) if suffix == ".db3" else path)


def check_metadata(folder: Path) -> None:
    """Check metadata.yaml and the files that it names."""
    described = parse_yaml(read_text(folder / METADATA, folder, _MOST_METADATA_BYTES), _MOST_METADATA_BYTES)
    try:
        names = [Path(name).name for name in described["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{METADATA} names no files") from error
    if len(set(names)) < len(names):
        raise ValueError(f"{METADATA} names a file twice")
    for name in names:
        check_file(folder / name, folder)


def check_chunks(reader: Any) -> None:
    """Check that chunks of an opened MCAP file that overlap in time, which rosbags unpacks at once, fit in memory."""
    size = os.stat(reader.path).st_size
    unpacked, ends = 0, [(chunk.message_end_time, -chunk.uncompressed_size) for chunk in reader.chunks]
    begins = [(chunk.message_start_time, chunk.uncompressed_size) for chunk in reader.chunks]
    for _, change in sorted(begins + ends, key=lambda at: (at[0], -at[1])):
        unpacked += change
        check_unpacked(size, unpacked)


@cache
def _limit_rosbags() -> None:
    """Put limits into rosbags, once in a process."""
    import apsw
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as folders
    from rosbags.rosbag2 import storage_mcap, storage_sqlite3

    ros1.decompressors |= {kind: partial(unpack, compression=kind) for kind in ("bz2", "lz4")}
    # One byte more than stated is enough for rosbags to refuse the chunk.
    storage_mcap.DECOMPRESSORS |= {
        "lz4": lambda packed, size: unpack(packed, "lz4", size + 1),
        "zstd": lambda packed, size: unpack(packed, "zstd", size + 1),
    }
    zstd = SimpleNamespace(decompress=partial(unpack, compression="zstd"), open=lambda file, _: open_zstd(file))
    setattr(folders, "zstd", zstd)  # noqa: B010
    for module in (folders, storage_mcap, storage_sqlite3):
        setattr(module, "parse_qos", lambda _: [])  # noqa: B010
    apsw.connection_hooks.append(_limit_database)


def _limit_database(connection: Any) -> None:
    import apsw

    try:
        size = os.stat(connection.filename).st_size
    except UnicodeDecodeError as error:
        raise ValueError("rename it: a path that is not UTF-8 cannot be a database") from error
    connection.config(apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0)
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, longest_value(size))
    connection.set_progress_handler(step_counter(size), STEPS)
