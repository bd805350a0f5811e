"""Runs of viewed missions: each is read once, and a run that was replaced is not kept."""

import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

from fcslam.runs import Run
from fcslam.service.viewed_mission import viewed_run


def test_of_many_who_ask_at_once_one_reads(tmp_path):
    Run({}).save(tmp_path / "1")
    with ThreadPoolExecutor(8) as pool:
        runs = list(pool.map(viewed_run, [tmp_path / "1"] * 50))
    assert len(set(map(id, runs))) == 1


def test_a_mission_whose_run_takes_long_to_read_delays_no_other(tmp_path):
    begun, may_end = threading.Event(), threading.Event()

    def read_slowly(_, maps):
        begun.set()
        assert may_end.wait(60.0)
        assert not maps
        return Run({})

    with ThreadPoolExecutor(1) as pool:
        slow = pool.submit(viewed_run, tmp_path / "slow" / "1", read_slowly)
        assert begun.wait(60.0)
        (tmp_path / "other").mkdir()
        Run({}).save(tmp_path / "other" / "1")
        assert viewed_run(tmp_path / "other" / "1") is not None
        assert not slow.done()
        may_end.set()
    assert slow.result().trajectories == {}


def test_only_the_newest_run_of_a_mission_is_kept(tmp_path):
    for name in ("a/1", "a/2", "b/1"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Run({}).save(tmp_path / name)
    replaced, other = (weakref.ref(viewed_run(tmp_path / name)) for name in ("a/1", "b/1"))
    viewed_run(tmp_path / "a/2")
    gc.collect()
    assert replaced() is None
    assert viewed_run(tmp_path / "b/1") is other()


def test_a_run_that_is_written_anew_is_read_anew(tmp_path):
    Run({}).save(tmp_path / "1")
    viewed_run(tmp_path / "1")
    Run({}, config_yaml="{}").save(tmp_path / "1", force=True)
    assert viewed_run(tmp_path / "1").config_yaml == "{}"
