"""Bags that were cut off or not closed: read up to there, and said."""

from binascii import crc32

import pytest

from fcslam.errors import SourceError
from fcslam.sources import open_source
from tests.sources.bag_messages import drive, mcap_places, save
from tests.sources.carmen_text import scans_of

pytestmark = pytest.mark.slow

SCANS = 200


def saved(path, compression="", scans=SCANS):
    """A small bag with several chunks."""
    return save(path, drive(scans), compression, chunk_bytes=20_000)


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
    if kept < 0.9:
        assert "is cut off or damaged, read up to" in notes
        assert f"of {(tmp_path / name).stat().st_size / 1e6:.3f} MB" in notes


@pytest.mark.parametrize(("name", "compression", "kept"), [("run.bag", "", 0.6), ("run.mcap", "", 0.5)])
def test_one_chunk_that_is_cut_off_is_read_up_to_there(tmp_path, name, compression, kept):
    scans, _ = read(cut(save(tmp_path / name, drive(100), compression), kept))
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
    assert "is cut off or damaged, read up to" in notes


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
    assert not notes


def test_damage_in_the_middle_is_said(tmp_path):
    whole, _ = read(saved(tmp_path / "whole.mcap"))
    bag = saved(tmp_path / "run.mcap")
    content = bytearray(bag.read_bytes())
    chunks = [(start, end) for opcode, start, end in mcap_places(content) if opcode == 0x06]
    for start, end in chunks:  # checksums, as rosbag2 writes them
        content[start + 24 : start + 28] = crc32(content[start + 40 : end]).to_bytes(4, "little")
    content[chunks[len(chunks) // 2][1] - 500] ^= 0xFF
    bag.write_bytes(content)
    scans, notes = read(bag)
    assert_begins(scans, whole)
    assert 0.25 * SCANS < len(scans) < 0.75 * SCANS
    assert "is cut off or damaged, read up to" in notes


def test_a_chunk_that_would_fill_the_memory_ends_the_reading(tmp_path):
    bag = cut(saved(tmp_path / "run.bag", "bz2"), 0.7)
    content = bytearray(bag.read_bytes())
    at = content.rindex(b"size=") + len(b"size=")
    content[at : at + 4] = b"\xff" * 4
    bag.write_bytes(content)
    scans, notes = read(bag)
    assert 0.4 * SCANS < len(scans) < 0.8 * SCANS
    assert "a chunk of 4295 MB would fill the memory" in notes
