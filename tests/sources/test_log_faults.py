import gzip
import lzma
import os
import tracemalloc
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fcslam.errors import SourceError
from fcslam.sources import Fault, FaultCount, open_source
from tests.sources.carmen_text import BEAMS, drive, flaser, odom, pose_at, refusal, save, scans_of

LOG = "\n".join(drive(3)) + "\n"


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "empty"),
        (gzip.compress(b"", mtime=0), "empty"),
        (b"#ROSBAG V2.0\nE\x00\x00\x00", "bag cannot be read"),
        (bytes(range(256)) * 300, "known format"),
        (b"\x00" * 5000, "known format"),
        (b"It was a dark and stormy night\n", "known format"),
        (b"\x1f\x8b\x08\x00garbage", "truncated or damaged"),
        (b"\xfd7zXZ\x00garbage", "truncated or damaged"),
        (b"BZh9garbage", "cannot be read"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, content, reason):
    assert reason in refusal(written(tmp_path / "run.clf", content))


def test_what_is_no_file_is_refused(tmp_path):
    """A pipe can be read only once."""
    os.mkfifo(tmp_path / "pipe.clf")
    for pipe in (tmp_path / "pipe.clf", Path(os.devnull)):
        assert "is a pipe or device" in refusal(pipe)
    assert "name too long" in refusal(tmp_path / ("a" * 400 + ".clf"))
    assert "no such file" in refusal(tmp_path / "missing.clf")
    assert "folder" in refusal(tmp_path)
    assert "cannot be read" in refusal(save(tmp_path / "run.log", drive(2)) / "inside.log")


@pytest.mark.slow
@pytest.mark.parametrize("compress", [gzip.compress, lzma.compress])
@pytest.mark.parametrize("kept", [0.2, 0.9, 0.999])
def test_a_truncated_archive_is_refused_wherever_it_ends(tmp_path, compress, kept):
    archive = compress("\n".join(drive(2000)).encode())
    path = written(tmp_path / "run.clf.gz", archive[: int(len(archive) * kept)])
    assert "truncated" in refusal(path)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([odom(k, pose_at(k)) for k in range(30)], "no laser scan"),
        (drive(30) + drive(31, 200, 9), "line 62: 31 scans are not of the laser of the first ones"),
        (drive(12) + ["??!"] * 30, "damaged"),
    ],
    ids=["no scan", "another laser", "damaged"],
)
def test_a_log_that_cannot_be_mapped_is_refused_with_the_reason(tmp_path, lines, words):
    assert words in refusal(save(tmp_path / "run.log", lines))


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        ([(1, 2, 0)] * 30, "never changes in 30 poses"),
        ([(0.1 * k, 0.1 * k, 0) for k in range(30)], "its heading is never set"),
    ],
)
def test_odometry_that_says_nothing_is_not_used(tmp_path, poses, words):
    source = open_source(save(tmp_path / "run.log", [flaser(k, pose) for k, pose in enumerate(poses)]))
    assert words in source.survey().notes[0]
    assert "no odometry" in source.survey().notes[1]
    assert all(np.isnan(record.T_odom_base).all() for record in source.records())


@pytest.mark.parametrize(
    "poses",
    [
        [(0.1 * k, 0, 0) for k in range(30)],
        [(1, 2, 0)] * 9,
        [(0, 0, 0.1 * k) for k in range(30)],
        [(0.5 * k + 1e6 * (k > 15), 0.1 * k, 0.01 * k) for k in range(30)],
    ],
    ids=["straight", "few scans", "a turn", "one long jump"],
)
def test_odometry_that_is_odd_but_right_is_used(tmp_path, poses):
    source = open_source(save(tmp_path / "run.log", [flaser(k, pose) for k, pose in enumerate(poses)]))
    assert not any("no odometry" in note for note in source.survey().notes)
    assert all(np.isfinite(record.T_odom_base).all() for record in source.records())


DAMAGED_SCANS = {
    "cut": lambda line: line[:40],
    "one range lost": lambda line: line.replace(" 1.0", "", 1),
    "a range is a word": lambda line: line.replace(" 1.0 ", " one ", 1),
    "a range has two points": lambda line: line.replace(" 1.0 ", " 1.0.0 ", 1),
    "wrong count": lambda line: line.replace(f"FLASER {BEAMS}", "FLASER 77"),
    "negative count": lambda line: line.replace(f"FLASER {BEAMS}", f"FLASER -{BEAMS}"),
    "count is no number": lambda line: line.replace(f"FLASER {BEAMS}", "FLASER many"),
    "huge count": lambda line: line.replace(f"FLASER {BEAMS}", "FLASER " + "9" * 5000),
    "pose is nan": lambda line: " ".join([*line.split()[:-9], "nan", *line.split()[-8:]]),
    "pose is far off": lambda line: " ".join([*line.split()[:-9], "1e30", *line.split()[-8:]]),
    "stamp is infinite": lambda line: " ".join([*line.split()[:-3], "inf", "robot", "0"]),
    "binary": lambda _: "\x00\x7f\x01" * 20,
    "name lost": lambda line: line[7:],
    "only the name": lambda _: "FLASER",
}


@pytest.mark.parametrize("damage", DAMAGED_SCANS.values(), ids=DAMAGED_SCANS)
@pytest.mark.parametrize("where", [0, 7, 19])
def test_one_broken_line_is_skipped_counted_and_located(tmp_path, damage, where):
    lines = [flaser(step, pose_at(step)) for step in range(20)]
    lines[where] = damage(lines[where])
    source = open_source(save(tmp_path / "run.log", ["# CARMEN Logfile", *lines]))
    stamps = [scan.stamp for scan in scans_of(source)]
    assert stamps == [step for step in range(20) if step != where]
    assert source.faults[Fault.BROKEN_LINE] == FaultCount(1, where + 2)
    assert f"broken lines skipped: 1 (first: line {where + 2})" in str(source.faults)


def test_a_few_misfits_are_skipped_and_counted(tmp_path):
    lines = drive(200)
    lines[101] = flaser(120.0, pose_at(50), ranges=(1.0,) * 5)
    lines[301] = flaser(3.0, pose_at(150))
    source = open_source(save(tmp_path / "run.log", lines))
    assert len(scans_of(source)) == source.survey().scan_count == 198
    assert source.faults[Fault.OTHER_BEAMS] == FaultCount(1, 102)
    assert source.faults[Fault.MISPLACED_SCAN].first_line == 302
    assert source.survey().faults.counts == source.faults.counts


@pytest.mark.parametrize(
    ("stamps", "duration_s", "reversals", "repeated"),
    [
        ([0.0, 1.0, 0.5, 2.0, 2.0, 1.1, 3.0], 3.0, FaultCount(2, 3, pytest.approx(0.9)), FaultCount(1, 5)),
        ([*range(50), 9000, *range(51, 100)], 9000.0, FaultCount(1, 52, 9000 - 51), FaultCount()),
    ],
    ids=["small steps back", "one far ahead"],
)
def test_scans_of_an_odd_clock_are_kept_in_file_order(tmp_path, stamps, duration_s, reversals, repeated):
    source = open_source(save(tmp_path / "run.log", [flaser(t, pose_at(k)) for k, t in enumerate(stamps)]))
    assert [scan.stamp for scan in scans_of(source)] == stamps
    assert source.survey().duration_s == duration_s
    assert (source.faults[Fault.TIME_REVERSAL], source.faults[Fault.REPEATED_STAMP]) == (reversals, repeated)


def test_a_log_whose_stamps_have_lost_their_digits_has_a_scan_a_second(tmp_path):
    lines = [line(1.01893e9, pose_at(k)) for k in range(30) for line in (odom, flaser)]
    source = open_source(save(tmp_path / "run.log", lines))
    assert [scan.stamp for scan in scans_of(source)] == [float(k) for k in range(30)]
    assert all(record.stamp <= 30.0 for record in source.records())
    assert source.faults[Fault.NO_STAMP] == FaultCount(30, 2)


def test_bad_ranges_become_nan_and_are_counted(tmp_path):
    ranges = ("1.0", "nan", "-0.5", "inf", "-inf", "0", "81.9", "1e300")
    source = open_source(save(tmp_path / "run.log", [flaser(k, pose_at(k), ranges=ranges) for k in range(2)]))
    first = scans_of(source)[0].ranges_m
    np.testing.assert_array_equal(np.isnan(first), [False, True, True, True, True, False, False, False])
    assert np.isfinite(first[[0, 5, 6, 7]]).all()
    assert first[7] > 50.0
    assert source.faults[Fault.INVALID_RANGE] == FaultCount(8, 1)


def test_faults_belong_to_the_latest_pass(tmp_path):
    lines = drive(20)
    lines[7] = "???"
    source = open_source(save(tmp_path / "run.log", lines))
    for _ in range(2):
        assert len(scans_of(source)) == 19
        assert source.faults[Fault.BROKEN_LINE].count == 1
    assert bool(source.faults)
    assert source.faults[Fault.INVALID_RANGE] == FaultCount()


def test_a_file_without_line_ends_does_not_fill_the_memory(tmp_path):
    path = written(tmp_path / "run.log.gz", gzip.compress(b"FLASER 180 " + b"1.0 " * 5_000_000, compresslevel=1))
    tracemalloc.start()
    refusal(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 << 20


def survives(path):
    """Reads or refuses; anything else is an error of the reader."""
    with suppress(SourceError):
        source = open_source(path)
        count = source.survey().scan_count
        assert sum(1 for _ in scans_of(source)) <= count


fuzz = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
magic = st.sampled_from([b"", b"\x1f\x8b\x08", b"\xfd7zXZ\x00", b"BZh9", b"FLASER 2 ", b"ODOM 1 2 3 4\n"])


@fuzz
@given(magic, st.binary(max_size=300))
def test_random_bytes_never_break_the_reader(tmp_path, start, content):
    survives(written(tmp_path / "run.log", start + content))


words = st.one_of(
    st.sampled_from(["FLASER", "RAWLASER1", "ODOM", "ROBOTLASER1", "PARAM", "#"]),
    st.sampled_from(["2", "3", "0", "-1", "nan", "inf", "1e400"]),
    st.floats().map(str),
    st.integers().map(str),
)


@pytest.mark.parametrize("count", ["-2", "-1", "0", "1"])
def test_a_count_of_ranges_that_cannot_be_is_a_broken_line(tmp_path, count):
    line = " ".join(["ROBOTLASER1", "0", "0", "3", "0", "8", "0", "0", count, "1", *["0"] * 14])
    survives(save(tmp_path / "run.log", ["ODOM 0 0 0 0 0 0 0 h 0", line]))


@pytest.mark.slow
@fuzz
@given(
    st.lists(st.lists(words, max_size=30).map(" ".join), max_size=12),
)
def test_random_words_never_break_the_reader(tmp_path, lines):
    survives(save(tmp_path / "run.log", ["ODOM 0 0 0 0 0 0 0 h 0", *lines]))


@pytest.mark.slow
@fuzz
@given(st.data())
def test_a_flipped_archive_never_breaks_the_reader(tmp_path, data):
    compress = data.draw(st.sampled_from([gzip.compress, lzma.compress]))
    archive = bytearray(compress("\n".join(drive(30)).encode()))
    archive[data.draw(st.integers(6, len(archive) - 1))] ^= data.draw(st.integers(1, 255))
    survives(written(tmp_path / "run.clf.xz", bytes(archive)))
