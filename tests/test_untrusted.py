"""Files from somebody else: what they cannot do to whoever opens them, and that no reader goes past the one module."""

import ast
import bz2
import gzip
import os
import sqlite3
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from backports import zstd

from fcslam import untrusted
from fcslam.config import load
from fcslam.errors import InputError, SourceError
from fcslam.maps.occupancy_map import Occupancy, OccupancyMap, server_files
from fcslam.mission.localization import read_map
from fcslam.mission.mission import MissionConfig
from fcslam.runs import RobotTrajectory, Run, open_run
from fcslam.sources import open_source
from fcslam.sources.logs.archive import numbered_lines
from tests.sources.bag_messages import END, HEADER, counted, drive, mcap_file, mounted, save

SOURCE = Path(untrusted.__file__).parent
SECRET = "the content of a private file"
BOMB_BYTES = 1 << 30

OWN = {
    "__init__.py": "a file of the package",
    "compiled.py": "the cache of this user",
    "wire/keys.py": "the robot's own token",
    "cli/serving.py": "written by the training that this service started",
    "features/network_check.py": "the memory of this process",
    "features/detector.py": "no file",
    "learning": "the folder of this user's training",
    "mission/mission_file.py": "what this process wrote",
    "page/report.py": "files of the package",
    "page/routes.py": "files of the package",
    "service": "the folder of the service",
    "storage": "the folder of the service or of this user",
}
"""Where files of this user are read that nobody else wrote, by module or folder, and which ones."""
READERS = {
    "read_text", "read_bytes", "load", "loadtxt", "genfromtxt", "fromfile", "memmap", "imread", "safe_load",
    "copyfile", "ZipFile", "LZMAFile", "GzipFile", "BZ2File", "connect", "load_from_string", "InferenceSession",
}  # fmt: skip
MODULES = {"np", "cv2", "yaml", "shutil", "zipfile", "gzip", "lzma", "bz2", "sqlite3", "onnx"}


def reads(node):
    """Whether a call reads a file by its path."""
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
    owner = node.func.value.id if isinstance(node.func, ast.Attribute) and isinstance(node.func.value, ast.Name) else ""
    if name == "open":
        modes = [arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)]
        return owner in MODULES or any(set(mode) <= set("rbt") for mode in modes)
    return name in READERS and isinstance(node.func, ast.Attribute) and (owner in MODULES or name.startswith("read_"))


def test_no_reader_goes_past_the_one_module():
    found = set()
    for path in sorted(SOURCE.rglob("*.py")):
        name = path.relative_to(SOURCE).as_posix()
        if name == "untrusted.py" or any(name == own or name.startswith(f"{own}/") for own in OWN):
            continue
        calls = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
        found |= {f"{name}:{call.lineno}: {ast.unparse(call)[:80]}" for call in calls if reads(call)}
    assert not {line for line in found if "StringIO" not in line and "_PlainLoader" not in line}, (
        "of text that was read"
    )


@pytest.mark.parametrize("kind", ["link", "folder link", "pipe", "device", "way out"])
def test_only_regular_files_of_a_folder_are_opened(tmp_path, kind):
    folder, outside = tmp_path / "run", tmp_path / "outside"
    folder.mkdir()
    outside.mkdir()
    (outside / "file").write_text(SECRET)
    name = "file"
    match kind:
        case "link":
            (folder / name).symlink_to(outside / "file")
        case "folder link":
            (folder / "inner").symlink_to(outside)
            name = "inner/file"
        case "pipe":
            os.mkfifo(folder / name)
        case "device":
            (folder / name).symlink_to("/dev/zero")
        case "way out":
            name = "../outside/file"
    with pytest.raises(OSError, match=r"link|pipe|not inside"):
        untrusted.read_bytes(folder / name, folder)


def test_a_link_that_the_user_names_is_followed(tmp_path):
    (tmp_path / "file").write_text(SECRET)
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert untrusted.read_text(tmp_path / "link") == SECRET
    for kind in ("/dev/zero", tmp_path):
        with pytest.raises(OSError, match=r"pipe or device|a folder"):
            untrusted.read_bytes(Path(kind))


PACKERS = {
    "zlib": lambda data: zlib.compress(data, 9),
    "bz2": bz2.compress,
    "lz4": lz4.frame.compress,
    "zstd": zstd.compress,
}


@pytest.mark.parametrize("compression", PACKERS)
def test_every_decompressor_stops_at_its_limit(compression):
    with pytest.raises(untrusted.LimitError, match="unpack to more than"):
        untrusted.unpack(PACKERS[compression](bytes(1 << 26)), compression)
    content = np.random.default_rng(0).integers(0, 9, 100_000).astype(np.uint8).tobytes()
    packed = PACKERS[compression](content)
    assert untrusted.unpack(packed, compression) == content
    assert untrusted.unpack(packed, compression, 1000) == content[:1000]
    for damaged in (packed[:-9], b"?" + packed):
        with pytest.raises(ValueError, match=compression):
            untrusted.unpack(damaged, compression)


@pytest.mark.parametrize(
    ("packer", "content", "limit"),
    [(gzip.compress, bytes(1 << 26), "MB"), (bz2.compress, b"\n" * 6_000_000, "lines")],
    ids=["size", "lines"],
)
def test_a_log_that_expands_is_refused(tmp_path, packer, content, limit):
    path = tmp_path / "log.gz"
    path.write_bytes(packer(content))
    with pytest.raises(SourceError, match=f"unpack to more than .* {limit}"):
        list(numbered_lines(path))


def test_arrays_that_expand_are_not_read(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(1 << 23))
    with pytest.raises(OSError, match="unpack to more than"):
        untrusted.read_arrays(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE VIEW schema AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT sum(x) FROM n",
        "CREATE TABLE t (a, b AS (zeroblob(1000000000)))",
        "CREATE VIRTUAL TABLE t USING fts5(a)",
    ],
)
def test_a_database_has_tables_only(tmp_path, statement):
    path = tmp_path / "bag.db3"
    save(path, [mounted(), *drive(3)])
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE IF EXISTS schema")
        database.execute(statement)
    database.close()
    with pytest.raises(SourceError, match="only tables are read"):
        open_source(path).survey()


def test_a_query_without_an_end_is_stopped(tmp_path):
    with sqlite3.connect(tmp_path / "a.db") as database:
        database.execute("CREATE TABLE t (a)")
    database.close()
    opened = untrusted.open_database(tmp_path / "a.db")
    with pytest.raises(sqlite3.OperationalError, match="interrupted"):
        opened.execute(
            "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT sum(x) FROM n"
        ).fetchone()
    opened.close()


MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}\n" for n in range(1, 12))


@pytest.fixture
def run(tmp_path):
    """A run folder that can be read."""
    drawn = OccupancyMap(np.array([[Occupancy.OCCUPIED, Occupancy.FREE]], np.uint8), 0.05, (0.0, 0.0))
    trajectory = RobotTrajectory("a", 0, np.zeros(1), np.zeros((1, 3)))
    Run({"a": trajectory}, map_files=server_files("map", drawn)).save(tmp_path / "run")
    return tmp_path / "run"


FILES = ("robots.csv", "trajectories/a.tum", "closures.csv", "metrics.json", "config.yaml", "pose_graph.g2o", "map.pgm")


@pytest.mark.parametrize("name", [*FILES, "map_9.bin", "mission.fcslam"])
@pytest.mark.parametrize("kind", ["link", "device", "pipe"])
def test_a_run_folder_reads_no_file_but_its_own(run, tmp_path, name, kind):
    assert open_run(run).maps
    (tmp_path / "private").write_text(SECRET)
    (run / name).unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(run / name)
    else:
        (run / name).symlink_to(tmp_path / "private" if kind == "link" else "/dev/zero")
    with pytest.raises(InputError) as caught:
        open_run(run)
    assert SECRET not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_table_of_the_run_in_which_a_robot_is_localized_is_its_own(run, tmp_path):
    assert read_map(run).cells.any()
    (run / "robots.csv").rename(tmp_path / "private")
    (run / "robots.csv").symlink_to(tmp_path / "private")
    with pytest.raises(InputError, match="is a link"):
        read_map(run)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("0.05", "1.0e+300", "`resolution` is 1e"),
        ("0.05", "1.0e-300", "`resolution` is 1e"),
        ("[0.0,", "[1.0e+300,", "`origin` is"),
        ("image: map.pgm\n", MERGES, "aliases"),
    ],
)
def test_a_description_of_a_map_that_cannot_be_is_refused(run, old, new, reason):
    (run / "map.yaml").write_text((run / "map.yaml").read_text().replace(old, new))
    with pytest.raises(InputError, match=reason):
        _ = open_run(run).maps


def test_settings_that_expand_are_refused(tmp_path):
    (tmp_path / "config.yaml").write_text(MERGES)
    with pytest.raises(InputError, match="aliases"):
        load(MissionConfig, tmp_path / "config.yaml")


def test_an_image_that_fills_the_memory_is_not_decoded():
    header = b"IHDR" + struct.pack(">IIBBBBB", 40_000, 40_000, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    with pytest.raises(untrusted.LimitError, match="40000 x 40000"):
        untrusted.check_image(png)
    with pytest.raises(ValueError, match="cannot be read"):
        untrusted.check_image(b"?" * 100)


OPEN = r"""
import re, sys, time
from pathlib import Path
from fcslam.errors import FcslamError
from fcslam.sources import open_source
from fcslam.sources.logs.archive import numbered_lines
began = time.process_time()
try:
    open_source(Path(sys.argv[1])).survey()
except FcslamError as error:
    print(error)
print(int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1]) // 1024)
"""


@pytest.mark.parametrize("stated", [100, 1 << 31])
def test_a_chunk_that_expands_takes_little_memory(tmp_path, stated):
    """It is refused by the size that it states, and unpacked to this size at most."""
    chunk = struct.pack("<QQQI", 0, 1, stated, 0) + counted("<I", b"zstd")
    chunk += counted("<Q", zstd.compress(bytes(BOMB_BYTES)))
    path = mcap_file(tmp_path / "bomb.mcap", [HEADER, (0x06, chunk), *END])
    ended = subprocess.run([sys.executable, "-c", OPEN, path], capture_output=True, text=True, check=True, timeout=60)
    *reason, peak_mb = ended.stdout.splitlines()
    assert len(reason) == 1
    assert stated < 1000 or "a chunk of 2147 MB would fill the memory" in reason[0]
    assert int(peak_mb) < 500


def test_files_of_a_folder_are_named_once_and_are_its_own(tmp_path):
    path = tmp_path / "bag"
    save(path, [mounted(), *drive(3)])
    open_source(path).survey()
    (data,) = [file for file in path.iterdir() if file.name != "metadata.yaml"]
    data.rename(tmp_path / "elsewhere")
    data.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SourceError, match="is a link"):
        open_source(path).survey()
