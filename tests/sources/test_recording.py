"""The recording folder: what is written comes back to the last bit, whatever cuts it off or damages it."""

import contextlib
import copy
import math
import resource
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fcslam.errors import OutputError, SourceError
from fcslam.records import Beams, GroundTruth, LaserModel, LaserScan, Odometry, Sweep, frozen
from fcslam.sources import Fault, FaultCount, Recording, RecordingWriter, open_source, split, write_recording
from fcslam.sources.images import image_size
from fcslam.sources.recording.layout import ODOMETRY_FILE, SCANS_FILE, SWEEP_NUMBERS
from tests.sources.camera_records import CAMERA, LASER, drive, image, png, same, scan

GOLDEN = Path(__file__).parent / "golden" / "robot.fcslam"
FILES = ("meta.yaml", "scans.bin", "ranges.bin", "odometry.bin", "images.bin")
ENTRY = 8 + 8 + 24
HEADER, SCAN, IMAGE = 16, ENTRY + 4 + 4 + 8 + 8 + 8 + 4 + 64 + 4, ENTRY + 4 + 4 + 4 + 4
REAR = LaserModel(9, -1.0, 0.25, 8.0, (-0.25, 0.0, 3.0))
SWEEP = Sweep(0.1, 0.0, (0.5, 0.0, -1.5), (0.25, 0.0, 4.0))
UNKNOWN = (math.nan,) * 3

numbers = st.floats(-1e6, 1e6)
poses = st.tuples(numbers, numbers, numbers)
ranges = st.one_of(st.floats(0, 60, width=32), st.just(math.nan), st.just(math.inf))
times_s = st.floats(-2.0, 2.0)
speeds = st.tuples(*3 * [st.floats(-50.0, 50.0)])
sweeps = st.none() | st.builds(Sweep, times_s, times_s, speeds, speeds).filter(lambda s: s.first_s != s.last_s)


@st.composite
def recordings(draw):
    """Records in any order, whose clock steps back now and then: by less than 2 s in all, as scans farther back go."""
    records, stamp = [scan(5.0)], 5.0
    for _ in range(draw(st.integers(0, 12))):
        stamp += draw(st.sampled_from([-0.15, 0.0, 0.1, 0.7]))
        pose = draw(poses)
        kind = draw(st.sampled_from(["odometry", "scan", "image", "lost image"]))
        if kind == "odometry":
            records.append(Odometry(stamp, frozen(pose)))
        elif kind == "scan":
            laser = draw(st.sampled_from([LASER, REAR, LASER.with_beams(Beams(11, -3.0, math.tau / 11))]))
            values = draw(st.lists(ranges, min_size=laser.beam_count, max_size=laser.beam_count))
            known = pose if draw(st.booleans()) else UNKNOWN
            records.append(LaserScan(stamp, frozen(values, np.float32), laser, frozen(known), draw(sweeps)))
        else:
            records.append(image(stamp, pose if kind == "image" else None, png(shade=draw(st.integers(0, 255)))))
    return records


def runs_backwards(records):
    """Whether most scans step back in time; each laser has its own clock."""
    scans = [record for record in records if isinstance(record, LaserScan)]
    stamps = [[s.stamp for s in scans if (s.laser.T_base_laser == REAR.T_base_laser) is rear] for rear in (False, True)]
    return 2 * sum(after < before for kept in stamps for before, after in pairwise(kept)) > len(scans)


def sensed(records):
    return [record for record in records if not isinstance(record, GroundTruth)]


def written(tmp_path, records=None, name="robot.fcslam"):
    folder = tmp_path / name
    write_recording(folder, (LASER, REAR), CAMERA, drive() if records is None else records)
    return folder


def counts(source):
    kinds = [type(record).__name__ for record in source.records()]
    return {kind: kinds.count(kind) for kind in sorted(set(kinds))}


def spoil(path, at, by=b"\xff"):
    content = bytearray(path.read_bytes())
    content[at : at + len(by)] = bytes(a ^ b for a, b in zip(content[at : at + len(by)], by, strict=True))
    path.write_bytes(content)


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(recordings())
def test_what_is_written_reads_back_to_the_last_bit(tmp_path_factory, records):
    source = open_source(written(tmp_path_factory.mktemp("recording"), records))
    if runs_backwards(records):
        with pytest.raises(SourceError, match="time runs backwards"):
            source.survey()
        return
    read = list(source.records())
    assert len(read) == len(records)
    assert all(map(same, records, read))


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def golden():
    """The records of the golden recording, whose second scan was measured during a turn."""
    turning = lambda record: replace(record, sweep=SWEEP) if record.stamp == 100.25 else record  # noqa: E731
    return [turning(record) if isinstance(record, LaserScan) else record for record in drive(3)]


def test_the_golden_recording_means_what_it_says():
    """Read by hand, as docs/reference/recording.md lays it out."""
    scans = (GOLDEN / "scans.bin").read_bytes()
    assert struct.unpack_from("<8sII", scans) == (b"FCSLAMsc", 3, SCAN)
    assert struct.unpack_from("<Qd3d", scans, HEADER + SCAN) == (4, 100.25, 0.125, 0.0, 0.0)
    *beams, offset, crc = struct.unpack_from("<IIddQI", scans, HEADER + SCAN + ENTRY)
    sweep = struct.unpack_from("<8d", scans, HEADER + SCAN + ENTRY + 36)
    assert sweep == (0.1, 0.0, 0.5, 0.0, -1.5, 0.25, 0.0, 4.0)
    assert all(map(math.isnan, struct.unpack_from("<8d", scans, HEADER + ENTRY + 36)))
    assert beams == [0, 12, LASER.angle_min_rad, LASER.angle_increment_rad]
    ranges = (GOLDEN / "ranges.bin").read_bytes()[offset : offset + 48]
    assert (offset, crc, struct.unpack("<12f", ranges)) == (48, zlib.crc32(ranges), (2.0,) * 12)
    images = (GOLDEN / "images.bin").read_bytes()
    assert struct.unpack_from("<8sII", images) == (b"FCSLAMim", 1, IMAGE)
    sequence, stamp, x, _, _, suffix, size = struct.unpack_from("<Qd3d4sI", images, HEADER + IMAGE)
    assert (sequence, stamp, x, suffix) == (5, 100.25, 0.125, b"png\0")
    assert (GOLDEN / "images" / "00000001.png").read_bytes() == png(shade=1)
    assert size == len(png(shade=1))


def test_the_golden_recording_is_read_and_written(tmp_path):
    source = Recording(GOLDEN, "robot")
    records = golden()
    assert all(map(same, sensed(records), source.records()))
    assert [truth.T_building_base[0] for truth in source.ground_truth()] == [1.0, 1.125, 1.25]
    assert contents(written(tmp_path, records)) == contents(GOLDEN)


def test_a_recording_without_odometry_says_so(tmp_path):
    records = [scan(5.0 + k, UNKNOWN) for k in range(3)]
    source = open_source(written(tmp_path, records))
    (note,) = source.survey().notes
    assert "no odometry, so scan matching alone gives the motion" in note
    assert source.survey().path_length_m == 0.0
    assert all(map(same, records, source.records()))


@pytest.mark.parametrize(
    "numbers",
    [(0.1, math.nan, *6 * (0.0,)), (0.1, 0.1, *6 * (0.0,)), (0.0, 9.0, *6 * (0.0,)), (0.0, 0.1, 0.0, 1e9, *4 * (0.0,))],
)
def test_a_sweep_that_no_scan_has_is_damage(tmp_path, numbers):
    folder = written(tmp_path)
    with (folder / "scans.bin").open("ab") as file:
        for sweep in (numbers, (math.nan,) * SWEEP_NUMBERS):
            file.write(SCANS_FILE.packed(1000, 200.0, (0.0, 0.0, 0.0), 0, *LASER.beams, 0, 0, sweep))
    source = open_source(folder)
    assert source.survey().scan_count == 21
    assert source.survey().faults[Fault.BROKEN_RECORD].count == 1


def test_damaged_ranges_cost_their_scan_alone(tmp_path):
    folder = written(tmp_path)
    spoil(folder / "ranges.bin", 48 * 3 + 5)
    source = open_source(folder)
    assert counts(source) == {"CameraImage": 20, "LaserScan": 19, "Odometry": 20}
    assert source.faults[Fault.BROKEN_RECORD] == FaultCount(1, 4)
    (folder / "ranges.bin").write_bytes((folder / "ranges.bin").read_bytes()[:-5])
    assert counts(open_source(folder))["LaserScan"] == 18


def test_a_scan_of_no_laser_of_the_recording_is_damage(tmp_path):
    folder = written(tmp_path)
    edit(folder, lambda content: content.update(lasers=content["lasers"][1:]))
    with pytest.raises(SourceError, match="20 scans are not of the laser of the first ones"):
        open_source(folder).survey()
    with (folder / "scans.bin").open("ab") as file:
        for beams in ((7, 9, -1.0, 0.25), (0, 2**32 - 1, -1.0, 0.25), (0, 9, math.nan, 0.25), (0, 9, -1.0, -0.25)):
            file.write(SCANS_FILE.packed(1000, 200.0, (0.0, 0.0, 0.0), *beams, 0, 0, (math.nan,) * SWEEP_NUMBERS))
    with pytest.raises(SourceError, match="20 scans are not of"):
        open_source(folder).survey()


def test_parts_and_names(tmp_path):
    source = open_source(written(tmp_path, name="anna.fcslam"))
    assert source.name == "anna"
    assert (source.survey().scan_count, source.survey().camera) == (20, CAMERA)
    assert source.survey().path_length_m == pytest.approx(19 * 0.125)
    parts = [list(part.records()) for part in split(source, 2)]
    assert [counts(part) for part in split(source, 2)] == [
        {"CameraImage": 10, "LaserScan": 10, "Odometry": 10},
        {"CameraImage": 10, "LaserScan": 10, "Odometry": 9},
    ]
    assert parts[1][0].T_odom_base.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("name", ["scans.bin", "odometry.bin", "images.bin"])
def test_a_file_cut_off_is_read_up_to_its_last_whole_frame(tmp_path, name):
    folder = written(tmp_path)
    (folder / name).write_bytes((folder / name).read_bytes()[:-5])
    source = open_source(folder)
    read = counts(source)
    assert sorted(read.values()) == [19, 20, 20]
    assert source.faults[Fault.CUT_RECORD].count == 1
    assert source.faults[Fault.CUT_RECORD].first_line == 20
    assert "record 20" in str(source.faults)


@pytest.mark.parametrize("at", [HEADER + 3 * SCAN, HEADER + 3 * SCAN + 20, HEADER + 4 * SCAN - 1])
def test_a_damaged_frame_is_lost_alone(tmp_path, at):
    folder = written(tmp_path)
    spoil(folder / "scans.bin", at)
    source = open_source(folder)
    assert source.survey().scan_count == 19
    assert counts(source) == {"CameraImage": 20, "LaserScan": 19, "Odometry": 20}
    assert source.faults[Fault.BROKEN_RECORD].count == 1


def test_a_recording_mostly_damaged_is_refused(tmp_path):
    folder = written(tmp_path)
    for k in range(20):
        spoil(folder / "scans.bin", HEADER + k * SCAN)
    for k in range(1, 20):
        spoil(folder / "odometry.bin", HEADER + k * 44)
    with pytest.raises(SourceError, match="most records are damaged"):
        open_source(folder).survey()


@pytest.mark.parametrize("harm", ["missing", "short", "other bytes", "folder"])
def test_an_image_that_is_not_there_is_left_out(tmp_path, harm):
    folder = written(tmp_path)
    path = folder / "images" / "00000007.png"
    if harm == "missing":
        path.unlink()
    elif harm == "short":
        path.write_bytes(path.read_bytes()[:-1])
    elif harm == "other bytes":
        spoil(path, 40)
    else:
        path.unlink()
        path.mkdir()
    source = open_source(folder)
    assert counts(source) == {"CameraImage": 19, "LaserScan": 20, "Odometry": 20}
    assert (source.faults[Fault.BROKEN_IMAGE].count, source.faults[Fault.BROKEN_IMAGE].first_line) == (1, 8)


def edit(folder, change):
    path = folder / "meta.yaml"
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content))


def test_without_calibration_the_laser_goes_on(tmp_path):
    folder = written(tmp_path)
    edit(folder, lambda content: content.pop("camera"))
    source = open_source(folder)
    (note,) = source.survey().notes
    assert "no calibration of the camera" in note
    assert "20 images" in note
    assert source.survey().camera is None
    assert counts(source) == {"LaserScan": 20, "Odometry": 20}
    assert not source.faults


def test_without_the_images_file_the_laser_goes_on(tmp_path):
    folder = written(tmp_path)
    (folder / "images.bin").unlink()
    source = open_source(folder)
    assert "images.bin is missing" in source.survey().notes[0]
    assert counts(source) == {"LaserScan": 20, "Odometry": 20}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.update(version=4), "version 4"),
        (lambda content: content.pop("version"), "no version"),
        (lambda content: content.pop("lasers"), "laser"),
        (lambda content: content.update(lasers=[]), "1 to 8 lasers"),
        (
            lambda content: content.update(lasers=[copy.deepcopy(content["lasers"][0]) for _ in range(9)]),
            "1 to 8 lasers",
        ),
        (lambda content: content.update(extra=1), "extra"),
        (lambda content: content["lasers"][0].update(beam_count=10**9), "beams"),
        (lambda content: content["lasers"][0].update(angle_increment_rad=math.nan), "field of view|finite"),
        (lambda content: content["lasers"][0].update(max_range_m=-1.0), "range"),
        (lambda content: content["camera"].update(fx=0.0), "fx"),
        (lambda content: content["camera"].update(width=1 << 20), "width"),
        (lambda content: content["camera"]["T_base_camera"].update(rotation=[0, 0, 0, 2]), "quaternion"),
    ],
)
def test_a_hostile_description_is_refused_in_one_line(tmp_path, change, words):
    folder = written(tmp_path)
    edit(folder, change)
    with pytest.raises(SourceError, match=words) as refusal:
        open_source(folder).survey()
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 500


@pytest.mark.parametrize("text", [b"", b"[", b"\xff\xfe", b"- 1", b"a: " * 2000, b"version: 1\n" + b"#" * 70000])
def test_a_description_that_is_none(tmp_path, text):
    folder = written(tmp_path)
    (folder / "meta.yaml").write_bytes(text)
    with pytest.raises(SourceError, match=r"meta\.yaml"):
        open_source(folder).survey()


@pytest.mark.parametrize("name", FILES[:-1])
def test_a_file_that_is_missing_is_named(tmp_path, name):
    folder = written(tmp_path)
    (folder / name).unlink()
    with pytest.raises(SourceError, match=f"{name}: is missing"):
        open_source(folder).survey()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["meta.yaml", "scans.bin", "ranges.bin", "odometry.bin", "images.bin", "images/00000001.png"]),
    st.data(),
)
def test_no_damage_ends_in_anything_but_fewer_records_or_a_refusal(tmp_path_factory, name, data):
    folder = written(tmp_path_factory.mktemp("recording"), drive(4))
    size = (folder / name).stat().st_size
    by = data.draw(st.binary(min_size=1, max_size=4))
    spoil(folder / name, data.draw(st.integers(0, size - len(by))), by)
    with contextlib.suppress(SourceError):
        assert len(list(open_source(folder).records())) <= 12


def test_poses_that_are_no_number_are_damage_even_with_a_right_checksum(tmp_path):
    folder = written(tmp_path)
    with (folder / "odometry.bin").open("ab") as file:
        file.write(ODOMETRY_FILE.packed(1000, 200.0, (math.nan, 0.0, 0.0)))
        file.write(ODOMETRY_FILE.packed(1001, math.inf, (0.0, 0.0, 0.0)))
    source = open_source(folder)
    assert counts(source)["Odometry"] == 20
    assert source.faults[Fault.BROKEN_RECORD].count == 2


def test_a_recording_without_scans(tmp_path):
    with pytest.raises(SourceError, match="no laser scan"):
        open_source(written(tmp_path, [image(1.0)])).survey()


@pytest.mark.slow
def test_what_is_on_the_disk_when_the_process_dies_is_whole(tmp_path):
    script = f"""
import os, sys
sys.path[:0] = [{str(Path(__file__).parents[2])!r}, {str(Path(__file__).parents[2] / "src")!r}]
from tests.sources.camera_records import CAMERA, LASER, drive
from fcslam.sources import RecordingWriter
from pathlib import Path
writer = RecordingWriter.create(Path({str(tmp_path / "run.fcslam")!r}), (LASER,), CAMERA)
for record in drive():
    writer.write(record)
os._exit(9)
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 9
    source = Recording(tmp_path / "run.fcslam", "run")
    assert all(map(same, sensed(drive()), source.records()))
    assert len(list(source.ground_truth())) == 20


def test_a_full_disk_leaves_what_was_written(tmp_path):
    """A limit on file sizes stands for the disk: the system writes a part of a frame, then no more."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    done = []

    def write_on(writer):
        for record in sensed(drive()):
            writer.write(record)
            done.append(record)

    with RecordingWriter.create(tmp_path / "run.fcslam", (LASER,), CAMERA) as writer:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
        try:
            with pytest.raises(OutputError, match=r"run\.fcslam: cannot be written .* can be read") as refusal:
                write_on(writer)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "\n" not in str(refusal.value)
    source = open_source(tmp_path / "run.fcslam")
    read = list(source.records())
    assert len(read) == len(done) > 10
    assert all(map(same, done, read))
    assert not source.faults


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (scan(math.nan), "finite"),
        (scan(1.0, (math.inf, 0.0, 0.0)), "finite"),
        (scan(1.0, (math.nan, 0.0, 0.0)), "finite"),
        (Odometry(1.0, frozen(UNKNOWN)), "finite"),
        (replace(scan(1.0), sweep=Sweep(0.0, math.inf)), "no sane times of the beams"),
        (image(1.0, encoded=png(9, 6)), "9 x 6"),
        (image(1.0, encoded=b"GIF89a"), "neither JPEG nor PNG"),
        (image(1.0, encoded=png()[:12]), "ends in its header"),
        (image(1.0, camera=None), "not of the recording's camera"),
    ],
)
def test_records_that_cannot_be_kept(tmp_path, item, words):
    with (
        RecordingWriter.create(tmp_path / "run.fcslam", (LASER,), CAMERA) as writer,
        pytest.raises(OutputError, match=words),
    ):
        writer.write(item)


def test_a_place_that_is_taken_or_not_there(tmp_path):
    folder = written(tmp_path)
    with pytest.raises(OutputError, match="is not empty"):
        RecordingWriter.create(folder, (LASER,))
    with pytest.raises(OutputError, match="cannot be written"):
        RecordingWriter.create(tmp_path / "missing" / "run.fcslam", (LASER,))
    with pytest.raises(OutputError, match=r"cannot hold these sensors \(.*a recording has 1 to 8 lasers\)"):
        RecordingWriter.create(tmp_path / "blind.fcslam", ())


@given(st.integers(1, 300), st.integers(1, 300), st.sampled_from([".jpg", ".png"]), st.booleans())
@settings(max_examples=30, deadline=None)
def test_the_size_of_an_image_is_what_others_read(width, height, suffix, progressive):
    pixels = np.zeros((height, width, 3), np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)] if suffix == ".jpg" else []
    assert image_size(cv2.imencode(suffix, pixels, options)[1].tobytes()) == (width, height)


@given(st.binary(max_size=60), st.sampled_from([b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"]))
def test_no_bytes_make_the_size_end_in_anything_but_a_value_error(content, start):
    with contextlib.suppress(ValueError):
        image_size(start + content)
