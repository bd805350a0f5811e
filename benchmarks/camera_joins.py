"""How far robots drive until they share a map by camera places alone, with one detector after another.

    python benchmarks/camera_joins.py --fleets FOLDER --weights detector.onnx [--test 411 ...] [--keep ROWS.jsonl]
    python benchmarks/camera_joins.py --fleets FOLDER --building corridor --test 411 412 413

The unseen buildings of `benchmarks/closure_learning.py`, which records them into FOLDER and trains the networks: three
robots, 45 m each, drive at the same time, each in other light, and half of the furniture moves. Mapped with the
bundled network, with each one that --weights names, and with ORB. In another --building they have LiDAR places as
well, and LiDAR places alone stand beside: in the corridor, whose doors are alike, these tell places apart worst.

Driven: path of a robot in its own map until it shares a map with another robot for good; of a robot that never does,
its whole path. The row of a building has the median over its robots. Differences to the bundled network are building by
building, with 95 % intervals by bootstrap over buildings.
"""

import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import common
import numpy as np
from closure_learning import ROBOTS, TEST, recorded

from fcslam.features.detector import BUNDLED_NETWORK, OnnxConfig, OnnxDetector
from fcslam.features.detector_kinds import DetectorKind
from fcslam.lab.evaluation.report import evaluate_fleet
from fcslam.lab.simulation.options import Building
from fcslam.metrics.bootstrap import mean_interval
from fcslam.mission.mission import MissionCloud, MissionConfig, run_mission
from fcslam.records import Channel, ClosureStatus, FloatArray
from fcslam.robot.frontend import RobotConfig
from fcslam.robot.views import ViewsConfig
from fcslam.sources import open_source

ROWS = {"network": "", "building": ".0f", "maps": ".0f", "false joins": ".0f", "accepted closures": ".0f",
        "driven, m": ".1f", "path, m": ".1f"}  # fmt: skip
SUMMARY = {"network": "", "one map": "", "false joins": ".0f", "accepted closures": ".0f", "driven, m": ".1f",
           "shorter by": "", "shorter by, %": ".0f"}  # fmt: skip
_DRIVEN = list(ROWS).index("driven, m")


class JoinWatch:
    """Notes how far each robot has driven when it begins to share a map."""

    def __init__(self) -> None:
        self.driven_m: dict[str, float] = {}

    def __call__(self, cloud: MissionCloud) -> None:
        maps = {each.robot: each.map_index for each in cloud.host.fleet.corrections()}
        numbers = list(maps.values())
        shared = {robot for robot, number in maps.items() if numbers.count(number) > 1}
        if shared != self.driven_m.keys():
            now = {each.robot: path_m(each.T_local_base) for each in cloud.host.fleet.estimate().robots}
            self.driven_m = {robot: self.driven_m.get(robot, now[robot]) for robot in shared}


def main() -> None:
    parser = common.options(__doc__ or "")
    parser.add_argument("--fleets", type=Path, required=True, help="folder of recordings; those missing are made there")
    parser.add_argument("--test", nargs="+", type=int, default=TEST, help="seeds of the buildings")
    parser.add_argument(
        "--building", type=Building, choices=Building, default=Building.DEFAULT, help="kind of building"
    )
    parser.add_argument("--weights", nargs="+", type=Path, default=[], help="networks beside the bundled one")
    parser.add_argument("--keep", type=Path, help="file that keeps finished buildings; the same one resumes")
    chosen = parser.parse_args()
    kept = common.Kept(chosen.keep)
    report = common.Report(__file__, __doc__ or "", chosen)
    own = () if chosen.building is Building.DEFAULT else (Channel.LIDAR,)
    robots = {
        OnnxDetector(OnnxConfig(weights=path)).version: RobotConfig(
            channels=(*own, Channel.CAMERA), views=ViewsConfig(weights=path)
        )
        for path in (BUNDLED_NETWORK, *chosen.weights)
    }
    robots["orb"] = RobotConfig(channels=(*own, Channel.CAMERA), views=ViewsConfig(detector=DetectorKind.ORB))
    if own:
        robots["LiDAR alone"] = RobotConfig(channels=own)
    rows: list[tuple] = []
    for seed in chosen.test:
        folder = recorded(seed, len(ROBOTS), chosen.fleets, chosen.building)
        for name, robot in robots.items():
            rows += kept.rows((name, folder.name), partial(mapped, name, robot, folder, seed))
    report.table("Summary", SUMMARY, summary(rows, list(robots)))
    report.table("Buildings", ROWS, rows)
    report.write()


def mapped(name: str, robot: RobotConfig, folder: Path, seed: int) -> list[tuple]:
    """One building with one detector."""
    watch, sources = JoinWatch(), [open_source(folder / each, name=each) for each in ROBOTS]
    run = run_mission(sources, MissionConfig(robot=robot), live=watch)
    paths = {robot: path_m(run.local_maps[robot].T_local_base) for robot in ROBOTS}
    with tempfile.TemporaryDirectory() as place:
        run.save(Path(place), force=True)
        found = evaluate_fleet(Path(place), folder)
    accepted = run.metrics[f"inter_robot_closures_{ClosureStatus.ACCEPTED}"].value
    driven = [watch.driven_m.get(robot, paths[robot]) for robot in ROBOTS]
    row = (name, seed, found.maps, len(found.false_joins), accepted, np.median(driven), np.mean(list(paths.values())))
    return [tuple(value if isinstance(value, str) else float(value) for value in row)]


def path_m(poses: FloatArray) -> float:
    """Length of the path through poses (N, 3), metres."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def summary(rows: Sequence[tuple], networks: Sequence[str]) -> Iterator[tuple]:
    """Each network over all buildings; shorter than with the first one."""
    first = np.array([row[_DRIVEN] for row in rows if row[0] == networks[0]])
    for name in networks:
        own = [row for row in rows if row[0] == name]
        driven = np.array([row[_DRIVEN] for row in own])
        gap = mean_interval(first - driven, np.random.default_rng(1))
        yield (
            name, f"{sum(row[2] == 1 for row in own)} of {len(own)}", sum(row[3] for row in own),
            sum(row[4] for row in own), float(driven.mean()), f"{gap.mean:+.1f} [{gap.low:+.1f}, {gap.high:+.1f}]",
            100.0 * float(gap.mean / first.mean()),
        )  # fmt: skip


if __name__ == "__main__":
    main()
