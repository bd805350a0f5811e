"""LiDAR places of one robot's recording, with ground truth from its own optimized poses.

The places come from the robot's front end, online. Optimized poses are accurate to centimetres according to reference
relations, which is small compared to the 1 m of a match.
"""

from pathlib import Path
from typing import Final

import numpy as np

from fcslam.cloud.cloud import Cloud
from fcslam.cloud.settings import FleetConfig
from fcslam.errors import EvaluationError
from fcslam.features.codes import mutual_matches
from fcslam.lab.evaluation.places.scoring import DescribedSet, PlaceFeatures
from fcslam.lab.evaluation.places.sets import PlaceSet
from fcslam.lidar.lost import LostConfig
from fcslam.metrics.retrieval import PairTruth, excluding_recent
from fcslam.places.motions import LARGEST_HAMMING, rigid_hypotheses
from fcslam.records import Channel, FloatArray, Keyscan, Place
from fcslam.robot.frontend import RobotConfig, RobotFrontend
from fcslam.sources import open_source
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode

SAME_M: Final = 1.0
"""Largest distance of a match."""
OTHER_M: Final = 10.0
"""Smallest distance of different places; closer submaps overlap."""
REVISIT_S: Final = 60.0
"""Places newer than this are not retrieved."""


def describe_recording(recording: Path) -> DescribedSet:
    """Describe all LiDAR places of a recording.

    A match is within 1 m, a different place more than 10 m away; both are at least 60 s older than the query.

    Raises:
        SourceError: the recording cannot be read.
        EvaluationError: the recording has fewer than two places.
    """
    source = open_source(recording)
    config = RobotConfig(channels=(Channel.LIDAR,), lost=LostConfig(doubted=0.0))  # one session, whatever happens
    robot = RobotFrontend(source.name, config)
    packets: list[Packet] = []
    for record in source.records():
        packets += robot.process(record)
    packets += robot.finish()
    places = [packet.body for packet in packets if isinstance(packet.body, Place)]
    if len(places) < 2:
        raise EvaluationError(f"{recording}: nothing to compare, {len(places)} place in it; give a longer recording")
    stamps = {packet.body.id: packet.body.stamp for packet in packets if isinstance(packet.body, Keyscan)}
    poses = _corrected(packets)[[place.id.number for place in places]]

    apart_m = np.linalg.norm(poses[:, None, :2] - poses[:, :2], axis=2)
    seen = np.array([stamps[place.id] for place in places])
    admitted = excluding_recent(seen, REVISIT_S)
    truth = PairTruth(admitted & (apart_m <= SAME_M), admitted & (apart_m > OTHER_M))
    names = tuple(Path(source.name, str(place.id.number)) for place in places)
    features = [PlaceFeatures(place.keypoints, place.descriptors) for place in places]
    return DescribedSet(
        PlaceSet(source.name, names, names, admitted, {"revisits": truth}), features, features, planar_inliers
    )


def planar_inliers(a: PlaceFeatures, b: PlaceFeatures) -> int:
    """Number of inliers of the best rigid motion between two LiDAR places."""
    matches = mutual_matches(a.descriptors, b.descriptors, LARGEST_HAMMING)
    found = rigid_hypotheses(a.positions, b.positions, matches)
    return found[0].inlier_count if found else 0


def _corrected(packets: list[Packet]) -> FloatArray:
    """Optimized poses of all keyscans, shape (N, 3)."""
    cloud = Cloud(FleetConfig(join_maps=False), 0)
    for packet in packets:
        cloud.receive(encode(packet))
    return cloud.finalize().robots[0].T_map_base
