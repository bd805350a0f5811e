"""One recording in several files: parts joined by commas, or a folder without metadata."""

import pytest

from fcslam.errors import SourceError
from fcslam.sources import open_source
from tests.sources.bag_messages import drive, odom, pose_at, save, scan
from tests.sources.camera_records import same
from tests.sources.carmen_text import refusal, scans_of

pytestmark = pytest.mark.slow


def parts(folder, suffix, count=3, scans=60):
    """A drive cut into files; tf_static is in the first one only."""
    messages = sorted(drive(scans), key=lambda message: message.bag_time)
    bounds = [len(messages) * k // count for k in range(count + 1)]
    folder.mkdir(exist_ok=True)
    return [save(folder / f"run_{k}{suffix}", messages[bounds[k] : bounds[k + 1]]) for k in range(count)]


def joined(files):
    return ",".join(map(str, files))


def assert_same(one, other):
    assert len(one) == len(other)
    assert all(map(same, one, other))


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_parts_are_one_recording(tmp_path, suffix):
    whole = scans_of(open_source(save(tmp_path / f"whole{suffix}", drive(60))))
    files = parts(tmp_path / "run", suffix)
    for path in (joined(files), joined(files[::-1]), tmp_path / "run"):
        source = open_source(path)
        assert source.name == "run"
        assert source.survey().scan_count == 60
        assert not source.survey().notes
        assert_same(scans_of(source), whole)


def test_a_folder_of_bag_folders_is_one_recording(tmp_path):
    whole = scans_of(open_source(save(tmp_path / "whole.mcap", drive(60))))
    messages = sorted(drive(60), key=lambda message: message.bag_time)
    (tmp_path / "drive").mkdir()
    for number, cut in enumerate((messages[:100], messages[100:])):
        assert (save(tmp_path / "drive" / f"part_{number}", cut) / "metadata.yaml").is_file()
    (tmp_path / "drive" / "notes").mkdir()
    for is_closed in (True, False):
        if not is_closed:  # the recorder of the last part was killed
            (tmp_path / "drive" / "part_1" / "metadata.yaml").unlink()
        source = open_source(tmp_path / "drive")
        assert source.name == "drive"
        assert_same(scans_of(source), whole)


def test_a_folder_of_bag_folders_of_several_robots_is_refused(tmp_path):
    (tmp_path / "fleet").mkdir()
    for name in ("anna", "ben"):
        save(tmp_path / "fleet" / name, drive(60))
    with pytest.raises(SourceError, match=r"has scans in /scan of the same time as .*give each as .*NAME=PATH"):
        open_source(tmp_path / "fleet").survey()


def test_the_last_part_may_be_cut_off(tmp_path):
    files = parts(tmp_path / "run", ".mcap")
    files[-1].write_bytes(files[-1].read_bytes()[:-3000])
    source = open_source(tmp_path / "run")
    assert 45 < len(scans_of(source)) <= 60
    assert "run_2.mcap: is cut off or damaged, read up to" in " ".join(source.survey().notes)


def test_each_topic_in_a_file_of_its_own(tmp_path):
    whole = scans_of(open_source(save(tmp_path / "whole.mcap", drive(60))))
    for topic in ("/scan", "/odom", "/tf_static"):
        save(tmp_path / f"{topic[1:]}.mcap", [message for message in drive(60) if message.topic == topic])
    source = open_source(joined(tmp_path / f"{name}.mcap" for name in ("scan", "odom", "tf_static")), name="anna")
    assert source.name == "anna"
    assert_same(scans_of(source), whole)


def test_recordings_of_several_days_are_no_parts(tmp_path):
    files = [save(tmp_path / f"run_{k}.bag", drive(60, start=100.0 + 90_000.0 * k)) for k in range(2)]
    assert "run_1.bag: begins 89988 s after" in refusal(joined(files))
    assert "give each as a recording of its own" in refusal(joined(files))
    near = [save(tmp_path / f"near_{k}.bag", drive(60, start=100.0 + 50.0 * k)) for k in range(2)]
    assert open_source(joined(near)).survey().scan_count == 120


def test_what_is_no_part(tmp_path):
    bag = save(tmp_path / "run.bag", drive(20))
    log = tmp_path / "run.log"
    log.write_text("FLASER 2 1 1 0 0 0 0 0 0 1 host 1\n")
    assert "a file is given twice" in refusal(joined([bag, tmp_path / "." / "run.bag"]))
    assert "bags of ROS 1 and of ROS 2" in refusal(joined([bag, save(tmp_path / "run.mcap", drive(20))]))
    assert "a CARMEN log is not a part of several" in refusal(joined([bag, log]))
    assert "no such file" in refusal(joined([bag, tmp_path / "run_2.bag"]))


def test_a_name_with_a_comma_is_a_name(tmp_path):
    bag = save(tmp_path / "run,1.bag", drive(20))
    assert len(scans_of(open_source(bag))) == 20


def test_parts_that_were_given_one_by_one_are_hinted_at(tmp_path):
    later = save(tmp_path / "run_1.bag", [*drive(20)[1:], odom(104.1, pose_at(4.1)), scan(104.05)])
    assert "if it is in another part of this recording, give both joined by a comma" in refusal(later)
