"""The paper's fusion against the joint graph: one recorded fleet a seed, mapped with every strategy.

    python benchmarks/fusion_strategies.py

Three robots with LiDAR and camera in a simulated building, 60 m each. `two_point` lays rigid maps on one another by two
matched points (the paper's eqs. 5 and 6), `n_point` by all of them, `joint` is the robust graph that runs by default.
ATE is that of the worst robot, each map moved onto the truth as a whole. Figures of strategies that leave robots apart
cannot be compared: the number of maps stands beside them. F1 is that of the occupied cells of the first map within
10 cm of the true one.
"""

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import common

from fcslam.cloud.fusion_strategy import FusionStrategy
from fcslam.lab.evaluation.fleet.report import FleetReport, evaluate_fleet
from fcslam.lab.simulation.options import Building

ROW = {"seed": "", "strategy": "", "maps": "", "ATE, m": ".4f", "across robots: mean, m": ".4f", "max, m": ".3f",
       "mean, deg": ".3f", "max, deg": ".2f", "worst join, m": ".4f", "F1": ".4f", "closures used": ".0f",
       "wall, s": ".1f"}  # fmt: skip
SUMMARY = {"strategy": "", "seeds in one map": "", "mean ATE, m": ".4f", "worst ATE, m": ".4f", "mean F1": ".4f",
           "seeds on which joint has the lower ATE": ""}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one strategy made of one fleet."""

    seed: int
    strategy: FusionStrategy
    report: FleetReport
    used: float
    """Closures between robots that the result rests on."""
    wall_s: float

    @property
    def ate_m(self) -> float:
        return max(robot.joint.rmse_m for robot in self.report.robots)

    @property
    def f1(self) -> float:
        return math.nan if self.report.agreement is None else self.report.agreement.f1

    @property
    def row(self) -> tuple:
        metres, degrees = self.report.across.translation, self.report.across.rotation
        across = (metres.mean, metres.maximum, degrees.mean, degrees.maximum)
        worst_join_m = max((join.translation_m for join in self.report.joins), default=math.nan)
        head = (self.seed, str(self.strategy), self.report.maps, self.ate_m)
        return *head, *across, worst_join_m, self.f1, self.used, self.wall_s


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=range(1, 11), help="of the buildings")
    parser.add_argument("--building", type=Building, default=Building.DEFAULT, help="kind of building")
    parser.add_argument("--no-camera", action="store_true", help="LiDAR only; needs no GL library")
    chosen = parser.parse_args()
    report = common.Report(__file__, __doc__, chosen)
    outcomes = [outcome for seed in chosen.seeds for outcome in fleet(seed, chosen.building, chosen.no_camera)]
    report.table("Strategies", SUMMARY, [summary(strategy, outcomes) for strategy in FusionStrategy])
    report.table("Fleets", ROW, [outcome.row for outcome in outcomes])
    report.write()


def fleet(seed: int, building: Building, no_camera: bool) -> list[Outcome]:
    """Record one fleet, and map it with every strategy."""
    with tempfile.TemporaryDirectory() as place:
        recordings = Path(place) / "recordings"
        arguments = ["tools", "simulate", "--building", building, "--seed", seed, "--output", recordings]
        common.run_fcslam(*arguments, *(["--no-camera"] if no_camera else []))
        return [outcome(seed, strategy, recordings) for strategy in FusionStrategy]


def outcome(seed: int, strategy: FusionStrategy, recordings: Path) -> Outcome:
    run = recordings.parent / strategy
    robots = sorted(recordings.glob("robot_*"))
    config = recordings.parent / f"{strategy}.yaml"
    config.write_text(f"fleet: {{fusion: {strategy}}}")
    cost = common.run_fcslam("map", *robots, "--output", run, "--config", config, "--config", f"seed={seed}")
    used = common.metrics(run)["inter_robot_closures_accepted"]
    return Outcome(seed, strategy, evaluate_fleet(run, recordings), used, cost.wall_s)


def summary(strategy: FusionStrategy, outcomes: list[Outcome]) -> tuple:
    mine = [o for o in outcomes if o.strategy is strategy]
    joint = [o for o in outcomes if o.strategy is FusionStrategy.JOINT]
    ates, f1s = [o.ate_m for o in mine], [o.f1 for o in mine]
    won = sum(best.ate_m < o.ate_m for best, o in zip(joint, mine, strict=True))
    compared = "" if strategy is FusionStrategy.JOINT else f"{won} of {len(mine)}"
    united = f"{sum(o.report.maps == 1 for o in mine)} of {len(mine)}"
    return str(strategy), united, sum(ates) / len(ates), max(ates), sum(f1s) / len(f1s), compared


if __name__ == "__main__":
    main()
