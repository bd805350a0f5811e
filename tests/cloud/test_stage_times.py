"""Runs and seconds of stages."""

import pytest

from fcslam.cloud.stage_times import StageTimes, StageTotal


def test_runs_and_seconds_are_counted_by_stage_also_of_those_that_fail():
    now = iter([1.0, 3.5, 10.0, 10.5, 20.0, 21.0])
    stages = StageTimes(lambda: next(now))
    with stages.measure("solve"):
        pass
    with pytest.raises(ZeroDivisionError), stages.measure("solve"):
        raise ZeroDivisionError
    with stages.measure("apply"):
        pass
    assert stages.totals == {"solve": StageTotal(2, 3.0), "apply": StageTotal(1, 1.0)}
