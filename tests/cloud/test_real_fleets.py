"""Real runs through one building share a map, also with a short-range, noisy scanner."""

import os
from pathlib import Path

import pytest
from convert_logs import readable

from fcslam.mission.mission import MissionConfig, run_mission
from fcslam.sources import open_source

DATA = Path(os.environ.get("FCSLAM_DATA", "")) / "lidar"
pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif("FCSLAM_DATA" not in os.environ, reason="needs the real logs: set FCSLAM_DATA"),
]


@pytest.mark.parametrize(
    "logs",
    [
        [f"mines-coreslam/exp{number}.dat.gz" for number in range(1, 5)],
        [f"wean-hall/robotdata{number}.log.gz" for number in (1, 3, 4)],
    ],
    ids=["mines", "wean hall"],
)
def test_runs_through_one_building_share_a_map(logs):
    run = run_mission([open_source(readable(DATA / log)) for log in logs], MissionConfig())
    assert {name: trajectory.map_index for name, trajectory in run.trajectories.items()} == dict.fromkeys(
        run.trajectories, 0
    )
    assert len(run.trajectories) == len(logs)
