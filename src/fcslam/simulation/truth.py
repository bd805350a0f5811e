"""Where the robots of a fleet, drawn or simulated, really were: poses, and relations between them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from fcslam.geometry import se2
from fcslam.metrics.relations import ACROSS_ROBOTS_GAP_S, Relations, write_relations
from fcslam.records import FloatArray, frozen
from fcslam.runs import write_tum


class HasTruth(Protocol):
    """A robot whose true poses are known."""

    @property
    def name(self) -> str:
        """The robot's name."""

    @property
    def stamps(self) -> FloatArray:
        """Of its scans, shape (N,)."""

    @property
    def T_building_base(self) -> FloatArray:
        """The truth at these stamps, shape (N, 3)."""


class HasRobots(Protocol):
    """A fleet of such robots."""

    @property
    def robots(self) -> Sequence[HasTruth]:
        """In the order of their numbers."""


def write_truth(fleet: HasRobots, folder: Path, rng: np.random.Generator) -> None:
    """Write ``ground_truth/<robot>.tum`` and ``ground_truth/relations`` into ``folder``.

    The relations let a map be measured without a common coordinate frame.
    """
    place = folder / "ground_truth"
    place.mkdir(parents=True, exist_ok=True)
    for robot in fleet.robots:
        write_tum(place / f"{robot.name}.tum", robot.stamps, robot.T_building_base)
    write_relations(place / "relations", true_relations(fleet, rng))


def true_relations(fleet: HasRobots, rng: np.random.Generator, count: int = 2000, reach_m: float = 5.0) -> Relations:
    """Up to ``count`` true relations between scans of any robots less than ``reach_m`` and more than 20 s apart."""
    stamps = np.concatenate([robot.stamps for robot in fleet.robots])
    poses = np.concatenate([robot.T_building_base for robot in fleet.robots])
    first, second = rng.integers(0, len(stamps), (2, 50 * count))
    near = np.hypot(*(poses[first, :2] - poses[second, :2]).T) < reach_m
    apart = np.abs(stamps[first] - stamps[second]) > ACROSS_ROBOTS_GAP_S
    chosen = np.flatnonzero(near & apart)[:count]
    first, second = first[chosen], second[chosen]
    return Relations(
        frozen(np.column_stack((stamps[first], stamps[second]))), frozen(se2.between(poses[first], poses[second]))
    )
