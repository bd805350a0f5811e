"""Runs of viewed missions: each is read once, and a run that was replaced is not kept."""

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor

import pytest

from fcslam.runs import Run, open_run
from fcslam.service import viewed_mission
from fcslam.service.viewed_mission import viewed_run


@pytest.fixture
def reads(monkeypatch):
    """The run folders that were read."""
    found = []
    monkeypatch.setattr(
        viewed_mission, "open_run", lambda folder, **how: found.append(folder) or open_run(folder, **how)
    )
    return found


def test_of_many_who_ask_at_once_one_reads(tmp_path, reads):
    Run({}).save(tmp_path / "1")
    with ThreadPoolExecutor(8) as pool:
        runs = list(pool.map(viewed_run, [tmp_path / "1"] * 50))
    assert len(reads) == 1 == len(set(map(id, runs)))


def test_only_the_newest_run_of_a_mission_is_kept(tmp_path, reads):
    for name in ("a/1", "a/2", "b/1"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Run({}).save(tmp_path / name)
    replaced, other = (weakref.ref(viewed_run(tmp_path / name)) for name in ("a/1", "b/1"))
    viewed_run(tmp_path / "a/2")
    gc.collect()
    assert replaced() is None
    assert viewed_run(tmp_path / "b/1") is other()
    assert len(reads) == 3


def test_a_run_that_is_written_anew_is_read_anew(tmp_path, reads):
    Run({}).save(tmp_path / "1")
    viewed_run(tmp_path / "1")
    Run({}, config_yaml="{}").save(tmp_path / "1", force=True)
    assert viewed_run(tmp_path / "1").config_yaml == "{}"
    assert len(reads) == 2
