"""Bags that were cut off, not closed, or whose index is wrong: read in the order of their records, and said."""

import bz2
import random
import struct
from binascii import crc32
from contextlib import suppress

import lz4.frame
import pytest
from backports import zstd
from rosbags import rosbag1, rosbag2

from fcslam.errors import SourceError
from fcslam.sources import open_source
from fcslam.sources.bags.mcap_records import CHUNK, mcap_records
from fcslam.untrusted import unpack
from tests.sources.bag_messages import drive, save
from tests.sources.carmen_text import scans_of

pytestmark = pytest.mark.slow

SCANS = 200


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch):
    """Several chunks in a small bag."""
    write = rosbag2.storage_mcap.McapWriter.write

    def with_small_chunks(self, *message):
        write(self, *message)
        if self.chunk.bio.tell() > 20_000:
            self.close_chunk()

    monkeypatch.setattr(rosbag2.storage_mcap.McapWriter, "write", with_small_chunks)


def saved(path, compression="", scans=SCANS):
    if path.suffix != ".bag":
        return save(path, drive(scans), compression)
    init = rosbag1.Writer.__init__

    def with_small_chunks(self, *arguments):
        init(self, *arguments)
        self.chunk_threshold = 20_000

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rosbag1.Writer, "__init__", with_small_chunks)
        return save(path, drive(scans), compression)


def cut(bag, kept):
    content = bag.read_bytes()
    bag.write_bytes(content[: int(kept * len(content))])
    return bag


def read(bag):
    """Scans, and what is said about the bag."""
    source = open_source(bag)
    notes = " ".join(source.survey().notes)
    scans = scans_of(source)
    assert len(scans) == source.survey().scan_count
    return scans, notes


def assert_begins(scans, whole):
    assert [one.stamp for one in scans] == [one.stamp for one in whole[: len(scans)]]
    assert all((a.ranges_m == b.ranges_m).all() for a, b in zip(scans, whole, strict=False))
    assert all((a.T_odom_base == b.T_odom_base).all() for a, b in zip(scans[:-1], whole, strict=False))


KINDS = [("run.bag", ""), ("run.bag", "bz2"), ("run.bag", "lz4"), ("run.mcap", ""), ("run.mcap", "storage")]


@pytest.mark.parametrize(("name", "compression"), KINDS)
@pytest.mark.parametrize("kept", [0.3, 0.77, 0.999])
def test_a_bag_that_is_cut_off_is_read_up_to_there(tmp_path, name, compression, kept):
    whole, notes = read(saved(tmp_path / f"whole_{name}", compression))
    assert not notes
    scans, notes = read(cut(saved(tmp_path / name, compression), kept))
    assert_begins(scans, whole)
    assert len(scans) > (0.6 if compression else 0.85) * min(kept, 0.9) * SCANS
    assert "read in the order of its records, without an index" in notes
    if kept < 0.9:
        assert f"of {(tmp_path / name).stat().st_size / 1e6:.3f} MB, where it is cut off" in notes


@pytest.mark.parametrize("name", ["run.bag", "run.mcap"])
def test_one_chunk_that_is_cut_off_is_read_up_to_there(tmp_path, name):
    bag = save(tmp_path / name, drive(100), "storage" if name == "run.mcap" else "")
    scans, _ = read(cut(bag, 0.6))
    assert 45 < len(scans) < 75


@pytest.mark.parametrize("name", ["run.bag", "run.mcap"])
def test_what_is_cut_off_before_the_first_scan_is_refused(tmp_path, name):
    bag = saved(tmp_path / name)
    bag.write_bytes(bag.read_bytes()[:4200] if name == "run.bag" else bag.read_bytes()[:60])
    with pytest.raises(SourceError, match=r"the bag cannot be read \(.*\); copy it again, or mend it with"):
        open_source(bag).survey()


@pytest.mark.parametrize("name", ["run.bag", "run.mcap"])
def test_zeros_after_a_power_failure(tmp_path, name):
    whole, _ = read(saved(tmp_path / f"whole_{name}"))
    bag = cut(saved(tmp_path / name), 0.5)
    bag.write_bytes(bag.read_bytes() + bytes(100_000))
    scans, notes = read(bag)
    assert_begins(scans, whole)
    assert len(scans) > 0.4 * SCANS
    assert "cut off or damaged" in notes


def test_a_bag_that_was_not_closed(tmp_path):
    bag = saved(tmp_path / "run.bag")
    whole, _ = read(bag)
    content = bytearray(bag.read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = bytes(8)
    (tmp_path / "run.bag.active").write_bytes(content)
    scans, notes = read(tmp_path / "run.bag.active")
    assert_begins(scans, whole)
    assert len(scans) == SCANS
    assert "without an index (Bag is not indexed, reindex before reading)" in notes


def index_entries(content):
    """Where the entries of the index of a ROS 1 bag lie: 4 bytes seconds, 4 nanoseconds, 4 offset."""
    at = 0
    while (at := content.find(b"\x04\x00\x00\x00op=\x04", at) + 1) > 0:
        header = content.rfind(struct.pack("<I", 47), 0, at)
        count = (size := struct.unpack_from("<I", content, header + 51)[0]) // 12
        assert size == 12 * count
        yield [header + 55 + 12 * k for k in range(count)]


@pytest.mark.parametrize("field", [0, 4, 8])
@pytest.mark.parametrize("at", [0.0, 0.6])
def test_an_index_that_contradicts_its_chunks(tmp_path, field, at):
    """Times or offsets that are not those of the messages: rosbags stops in the middle."""
    bag = saved(tmp_path / "run.bag")
    whole, _ = read(bag)
    content = bytearray(bag.read_bytes())
    entries = list(index_entries(content))
    assert len(entries) > 10
    for entry in entries[int(at * len(entries)) :][3]:
        content[entry + field] ^= 1
    bag.write_bytes(content)
    scans, notes = read(bag)
    assert_begins(scans, whole)
    assert len(scans) == SCANS
    assert "without an index" in notes


def test_an_index_that_lacks_messages(tmp_path):
    bag = saved(tmp_path / "run.bag")
    content = bytearray(bag.read_bytes())
    content[-4] ^= 1  # the last count in the information on the last chunk
    bag.write_bytes(content)
    scans, notes = read(bag)
    assert len(scans) == SCANS
    assert "the index contradicts its chunks" in notes


def test_damage_in_the_middle_is_said(tmp_path):
    whole, _ = read(saved(tmp_path / "whole.mcap"))
    bag = saved(tmp_path / "run.mcap")
    content = bytearray(bag.read_bytes())
    with bag.open("rb") as file:
        chunks = [record for record in mcap_records(file) if record.opcode == CHUNK]
    for chunk in chunks:  # checksums, as rosbag2 writes them
        checksum = crc32(content[chunk.start + 40 : chunk.end])
        content[chunk.start + 24 : chunk.start + 28] = checksum.to_bytes(4, "little")
    content[chunks[len(chunks) // 2].end - 500] ^= 0xFF
    bag.write_bytes(content)
    scans, notes = read(bag)
    assert_begins(scans, whole)
    assert 0.25 * SCANS < len(scans) < 0.75 * SCANS
    assert "where it is cut off or damaged" in notes


def test_a_chunk_that_would_fill_the_memory_ends_the_reading(tmp_path):
    bag = cut(saved(tmp_path / "run.bag", "bz2"), 0.7)
    content = bytearray(bag.read_bytes())
    at = content.rindex(b"size=") + len(b"size=")
    content[at : at + 4] = b"\xff" * 4
    bag.write_bytes(content)
    scans, _ = read(bag)
    assert 0.4 * SCANS < len(scans) < 0.8 * SCANS


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_unpacking_ends_at_the_limit(compression):
    packers = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstd.compress}
    packed = packers[compression](bytes(5_000_000))
    assert len(unpack(packed, compression, 1_000_000)) == 1_000_000
    assert unpack(packed, compression, 9_000_000) == bytes(5_000_000)


@pytest.mark.parametrize("name", ["run.bag", "run.mcap"])
def test_damage_anywhere_never_breaks_the_reader(tmp_path, name):
    good = cut(saved(tmp_path / name, scans=60), 0.8).read_bytes()
    rng = random.Random(7)
    for _ in range(60):
        content = bytearray(good)
        for _ in range(rng.randint(1, 4)):
            content[rng.randrange(13, len(content))] ^= rng.randint(1, 255)
        (tmp_path / name).write_bytes(content)
        with suppress(SourceError):
            scans_of(open_source(tmp_path / name))
