"""Does an image pyramid find more keypoints again from farther away? Recall by the distance between two views.

    python benchmarks/pyramid.py [--fleets FOLDER] [--weights NETWORK]

The bundled network at the scales of a robot (1) and at those of `fcslam tools extract` (1, 0.71, 0.5), with as many
keypoints. Fleets of three robots in simulated buildings that no training saw, in equal light; FOLDER keeps the
recordings. Pairs of views of two robots, whose images are a metre or half a radian apart on each path, with an overlap
of more than a fifth, at most 60 of each distance and building.

Recall: mutual nearest neighbours that are right to 3 px by the true poses, divided by the keypoints that have a
partner. Intervals are 95 %, by bootstrap over buildings, of the difference of the same buildings.
"""

import itertools
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import common
import numpy as np
import simulated_fleet
from closure_learning import PAIR_OVERLAP, ROBOTS, keypoint_counts, views_of

from fcslam.features.detector import MATCHING_SCALES, OnnxConfig, OnnxDetector
from fcslam.geometry import se2
from fcslam.learning.revisits import Keyframe
from fcslam.metrics.bootstrap import mean_interval
from fcslam.records import FloatArray

DISTANCES_M = (0.0, 0.5, 1.5, 2.5)
"""Limits of the distances between two views."""
MOST_PAIRS = 60
SCALES = {"one scale": OnnxConfig(), "three scales": OnnxConfig(scales=MATCHING_SCALES)}
ROWS = {"building": "d", "distance, m": "s", "pairs": "d", "": "s", "recall": ".4f", "right matches a pair": ".1f",
        "precision": ".3f"}  # fmt: skip
DIFFERENCES = {"recall, difference": "s", "right matches a pair, difference": "s"}


def main() -> None:
    parser = common.options(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=simulated_fleet.SEEDS, help="of the buildings")
    parser.add_argument("--fleets", type=Path, help="folder that keeps the recordings [they are deleted]")
    parser.add_argument("--weights", type=Path, help="a network at one scale beside the bundled one, not three scales")
    chosen = parser.parse_args()
    other = {"bundled": OnnxConfig(), "other": OnnxConfig(weights=chosen.weights)}
    arms = SCALES if chosen.weights is None else other
    report = common.Report(__file__, __doc__, chosen)
    with tempfile.TemporaryDirectory() as place:
        rows = [row for seed in chosen.seeds for row in building_rows(seed, chosen.fleets or Path(place), arms)]
    first, second = arms
    columns = {"distance, m": "s", "pairs": "d", **dict.fromkeys(arms, ".3f"), **DIFFERENCES}
    report.table(f"{second.capitalize()} less {first}", columns, gains(rows, list(arms)))
    report.table("Buildings", ROWS, rows)
    report.write()


def building_rows(seed: int, fleets: Path, arms: dict[str, OnnxConfig]) -> Iterator[tuple]:
    """Each distance and network in one building."""
    fleet = common.simulated(fleets / f"default-{seed}", "--robots", simulated_fleet.ROBOTS, "--seed", seed)
    views, overlap = views_of(fleet, ROBOTS)
    poses = np.array([view.T_building_base for view in views])
    robots = np.array([view.robot for view in views])
    shared = (robots[:, None] < robots) & (overlap > PAIR_OVERLAP)
    apart_m = np.linalg.norm(poses[:, None, :2] - poses[None, :, :2], axis=2)
    for name, config in arms.items():
        detector = OnnxDetector(config)
        frames = [Keyframe.of(v.picture, detector.detect(v.picture), v.camera, v.surroundings) for v in views]
        for near, far in itertools.pairwise(DISTANCES_M):
            pairs = np.argwhere(shared & (near <= apart_m) & (apart_m < far))
            pairs = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_PAIRS)).round().astype(int)]
            counts = [keypoint_counts(frames[a], frames[b], se2.between(poses[a], poses[b])) for a, b in pairs]
            right, partners, matches = np.sum(counts, axis=0)
            yield seed, f"{near:g} to {far:g}", len(pairs), name, right / partners, right / len(pairs), right / matches
        print(seed, name, file=sys.stderr, flush=True)


def gains(rows: list[tuple], arms: list[str]) -> Iterator[tuple]:
    for distance in dict.fromkeys(row[1] for row in rows):
        first, second = (of(rows, distance, name) for name in arms)
        intervals = (mean_interval(gain, np.random.default_rng(1)) for gain in (second - first).T)
        shown = (f"{each.mean:+.3f} [{each.low:+.3f}, {each.high:+.3f}]" for each in intervals)
        pairs = sum(row[2] for row in rows if row[1] == distance) // len(arms)
        yield distance, pairs, float(first[:, 0].mean()), float(second[:, 0].mean()), *shown


def of(rows: list[tuple], distance: str, name: str) -> FloatArray:
    """Recall and right matches a pair of each building, shape (B, 2)."""
    return np.array([row[4:6] for row in rows if (row[1], row[3]) == (distance, name)])


if __name__ == "__main__":
    main()
