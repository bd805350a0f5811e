"""Pairs of a robot's keyframes that it never trains on, and how a version of the detector does on them.

A keyframe is held out by where it is, so that a pair that is held out shares no image with one that is trained on. The
choice is made once for each keyframe and stays, also when the map moves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from fcslam.features.codes import LARGEST_HAMMING, mutual_matches
from fcslam.features.detector import ImageFeatures, OnnxConfig
from fcslam.geometry import se2
from fcslam.learning.network import KeypointNetwork
from fcslam.learning.revisits import FARTHEST_M, Keyframe, correspond, revisits_in_map
from fcslam.learning.validation import detect
from fcslam.places.motions import level_matches, rigid_hypotheses
from fcslam.records import FloatArray, frozen

COLUMNS: Final = ("revisit_recall", "places_found")
"""Columns that a robot reports about each pair: right matches as a share of the shared points, and whether the pair is
more similar than any two keyframes of different places."""
APART_M: Final = 2.0 * FARTHEST_M
"""Keyframes farther apart than this show different places."""
MOST_APART: Final = 300
"""Pairs of keyframes of different places that are compared."""
MOST_PAIRS: Final = 1000
"""Pairs that a robot reports on."""

Judgement = NDArray[np.float32]
"""Shape (P, 2): a row for each pair, by ``COLUMNS``; a place is found (1), not found (0), or NaN without others."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutPairs:
    """The pairs on which versions are compared."""

    frames: Sequence[Keyframe] = field(default=())
    revisits: Sequence[tuple[int, int, int]] = field(default=())
    """Numbers of two frames that show the same place, and how many of their keypoints are the same points."""
    T_own_base: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    """Estimated poses of the frames in the robot's map, shape (K, 3)."""
    apart: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    """Numbers of two frames that show different places, shape (N, 2)."""

    @classmethod
    def of(cls, frames: Sequence[Keyframe], T_own_base: FloatArray) -> "HeldOutPairs":
        """Pairs of keyframes that are held out, at their estimated poses in the robot's map, shape (N, 3)."""
        revisits = [(i, j, len(rows)) for i, j, rows in revisits_in_map(frames, T_own_base)]
        chosen = np.linspace(0, len(revisits) - 1, min(len(revisits), MOST_PAIRS)).astype(int)
        first, second = np.triu_indices(len(frames), 1)
        distances = np.hypot(*(T_own_base[first, :2] - T_own_base[second, :2]).T)
        far = np.flatnonzero(distances > APART_M)
        far = far[np.linspace(0, len(far) - 1, min(len(far), MOST_APART)).astype(int)]
        return cls(frames, [revisits[k] for k in chosen], T_own_base, np.column_stack((first[far], second[far])))


@torch.inference_mode()
def judge(network: KeypointNetwork, pairs: HeldOutPairs, device: torch.device) -> Judgement:
    """Judge the keypoints and codes that a network finds in the frames."""
    frames = [_described(network, frame, device) for frame in pairs.frames]
    between = [se2.between(pairs.T_own_base[i], pairs.T_own_base[j]) for i, j, _ in pairs.revisits]
    found = [
        _recall(frames[i], frames[j], T_i_j, shared)
        for (i, j, shared), T_i_j in zip(pairs.revisits, between, strict=True)
    ]
    # Keyframes that are far apart may see the same points, as along a corridor: a motion that says so is no error.
    same = [inliers(frames[i], frames[j], APART_M) for i, j, _ in pairs.revisits]
    other = [inliers(frames[i], frames[j], APART_M) for i, j in pairs.apart.tolist()]
    judged = np.full((len(found), len(COLUMNS)), np.nan, np.float32)
    judged[:, 0] = found
    if other:
        judged[:, 1] = np.array(same) > max(other)
    return judged


def check_judgement(array: object) -> Judgement:
    """A robot's report, which comes from outside.

    Raises:
        ValueError: it cannot be read as a report; the text says why.
    """
    if not isinstance(array, np.ndarray) or array.dtype != np.float32:
        raise ValueError("a report on pairs that is not an array of float32")
    if array.ndim != 2 or array.shape[1] != len(COLUMNS) or len(array) > MOST_PAIRS:
        raise ValueError(f"a report on pairs of shape {array.shape}, not (P, {len(COLUMNS)}) with P up to {MOST_PAIRS}")
    recall, found = array.T
    if not (np.all((recall >= 0.0) & (recall <= 1.0)) and np.all(np.isnan(found) | (found == 0.0) | (found == 1.0))):
        raise ValueError("a report on pairs with numbers that no pair can have")
    return array


def same_pairs(first: Mapping[str, Judgement], second: Mapping[str, Judgement]) -> dict[str, NDArray[np.float64]]:
    """By robot, the first version's report less the second one's, of robots that reported on both in the same pairs."""
    return {
        robot: rows.astype(np.float64) - second[robot]
        for robot, rows in sorted(first.items())
        if robot in second and len(rows) == len(second[robot])
    }


def _described(network: KeypointNetwork, frame: Keyframe, device: torch.device) -> Keyframe:
    """The frame with the keypoints and codes of the network, found as robots do."""
    image = torch.from_numpy(frame.image.astype(np.float32) / 255.0)[None, None].to(device)
    points, strengths, codes = detect(network, image, OnnxConfig())
    features = ImageFeatures(frozen(points, np.float32), frozen(strengths, np.float32), frozen(codes, np.uint8))
    return Keyframe.of(frame.image, features, frame.camera, frame.surroundings)


def _recall(a: Keyframe, b: Keyframe, T_a_b: FloatArray, shared: int) -> float:
    """Keypoints that are the same by poses and codes, as a share of the points that both frames show; at most 1."""
    matched = {(i, j) for i, j in mutual_matches(a.features.descriptors, b.features.descriptors).pairs.tolist()}
    right = sum((i, j) in matched for i, j in correspond(a, b, T_a_b).tolist())
    return min(right / shared, 1.0)


def inliers(a: Keyframe, b: Keyframe, farthest_m: float = np.inf) -> int:
    """Keypoints that the best motion between two keyframes explains, as the cloud compares camera places.

    Motions of more than ``farthest_m`` do not count: they do not take the keyframes for one place.
    """
    positions_a, positions_b = (each.positions[each.placed] for each in (a, b))
    codes_a, codes_b = (each.features.descriptors[each.placed] for each in (a, b))
    matches = level_matches(positions_a, positions_b, mutual_matches(codes_a, codes_b, LARGEST_HAMMING))
    flat = positions_a[:, :2].astype(np.float32), positions_b[:, :2].astype(np.float32)
    found = rigid_hypotheses(*flat, matches)
    return max((len(rows) for T_a_b, rows in found if np.hypot(*T_a_b[:2]) <= farthest_m), default=0)
