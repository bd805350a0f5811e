"""Packets of a robot that sends words only, as in the paper: bags of words, and its own map at the end of a session.

Ranges and descriptors stay on the robot. Keyscans are sent without ranges, because the pose graph needs their
constraints.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from fcslam.config import Settings
from fcslam.errors import FeatureError
from fcslam.geometry import se2
from fcslam.graph.pose_graph import Edge, PoseGraph
from fcslam.graph.single_robot import solve_single_robot
from fcslam.lidar.occupancy import OccupancyConfig
from fcslam.maps.fusion import fuse
from fcslam.maps.occupancy_map import OccupancyMap
from fcslam.places.words import WordVocabulary, read_vocabularies
from fcslam.records import (
    Channel,
    Constraint,
    ConstraintKind,
    FloatArray,
    Keyscan,
    MapTile,
    Place,
    Ranges,
    WordPlace,
    frozen,
)
from fcslam.wire.limits import TILE_CELLS
from fcslam.wire.messages import Body, Hello

_NO_RANGES: Ranges = frozen([], np.float32)


class Sends(StrEnum):
    """The form in which a robot sends its places."""

    DESCRIPTORS = "descriptors"
    WORDS = "words"


class WordsConfig(Settings):
    """The words that robots and cloud share."""

    vocabulary: Path | None = Field(
        default=None, description="file of the vocabularies of all channels, as `fcslam tools vocabulary` writes it"
    )


class SendingConfig(Settings):
    """The form of the packets of a robot."""

    sends: Sends = Field(
        default=Sends.DESCRIPTORS,
        description="what describes places to the cloud. descriptors: and the ranges of all keyscans; words: only "
        "words of an agreed vocabulary and, at the end of a session, the robot's own map; the cloud then needs "
        "fleet.matcher.decision similarity",
    )
    words: WordsConfig = Field(default=WordsConfig(), description="sends words: vocabulary and map")

    @model_validator(mode="after")
    def _words_need_a_vocabulary(self) -> Self:
        if self.sends is Sends.WORDS and self.words.vocabulary is None:
            raise ValueError("sends words needs words.vocabulary, a file that `fcslam tools vocabulary` writes")
        return self


class WordSender:
    """Turns what one robot would send into words, session after session; the vocabulary never changes."""

    def __init__(self, config: WordsConfig) -> None:
        """Read the vocabularies."""
        assert config.vocabulary is not None, "checked with the settings"
        self._path = config.vocabulary
        self._vocabularies = {found.channel: found for found in read_vocabularies(config.vocabulary)}
        self._grid = OccupancyConfig()
        self._begin()

    def check(self, detector_versions: Mapping[Channel, str]) -> None:
        """Check that there are words for the descriptors of these detectors.

        Raises:
            FeatureError: a channel has no vocabulary, or that of another detector.
        """
        for channel, version in detector_versions.items():
            known = self._vocabularies.get(channel)
            if known is None or known.detector_version != version:
                there = "none" if known is None else f"words of detector {known.detector_version}"
                raise FeatureError(
                    f"{self._path}: has {there} for {channel} places of detector {version}; write a vocabulary of this "
                    "detector with `fcslam tools vocabulary`"
                )

    def convert(self, bodies: Sequence[Body]) -> list[Body]:
        """Return the packets for the next records of the session."""
        return [self._converted(body) for body in bodies]

    def end_session(self) -> list[Body]:
        """The robot's own map, from all keyscans of the session."""
        tiles: list[Body] = []
        if self._keyscans:
            robot = self._keyscans[0].id.robot
            own = fuse(self._keyscans, self._poses(), {robot: self._hello.lasers}, self._grid)
            tiles += tiles_of(own, robot)
        self._begin()
        return tiles

    def _begin(self) -> None:
        self._hello = Hello("", 0, (), {})
        self._keyscans: list[Keyscan] = []
        self._edges: list[Edge] = []

    def _converted(self, body: Body) -> Body:
        match body:
            case Hello():
                self._hello = body
                digests = {channel: self._words_of(channel).digest for channel in body.detector_versions}
                return replace(body, vocabularies=digests)
            case Keyscan():
                self._keyscans.append(body)
                return without_ranges(body)
            case Constraint(i=i, j=j, kind=kind):
                self._edges.append(Edge(i, j, body.T_i_j, body.information, robust=kind is ConstraintKind.CLOSURE))
                return body
            case Place():
                words = self._words_of(body.channel).words(body.descriptors)
                return WordPlace(
                    body.id, body.channel, body.detector_version, body.first, body.last, body.keypoints, words
                )
            case _:
                return body

    def _words_of(self, channel: Channel) -> WordVocabulary:
        return self._vocabularies[channel]

    def _poses(self) -> FloatArray:
        """Poses (N, 3) of the session's keyscans, as the cloud solves the robot's own graph."""
        chain = [np.zeros(3)]
        for edge in self._edges:
            if not edge.robust:  # odometry comes in the order of the keyscans
                chain.append(se2.compose(chain[-1], edge.T_i_j))
        return solve_single_robot(PoseGraph(chain, self._edges)).poses


def without_ranges(keyscan: Keyscan) -> Keyscan:
    """The keyscan as a robot sends it whose ranges stay on it."""
    return replace(keyscan, ranges_m=_NO_RANGES, beams=None, sweep=None)


def tiles_of(own: OccupancyMap, robot: str) -> Iterator[MapTile]:
    """The tiles of a map that hold a known cell, row by row. Its cell edges lie on multiples of the resolution."""
    x, y = (round(value / own.resolution_m) for value in own.origin_xy)
    first_column, first_row = x // TILE_CELLS, y // TILE_CELLS
    left, below = x - first_column * TILE_CELLS, y - first_row * TILE_CELLS
    height, width = own.cells.shape
    padding = ((below, -(below + height) % TILE_CELLS), (left, -(left + width) % TILE_CELLS))
    cells = np.pad(own.cells, padding)
    rows, columns = (side // TILE_CELLS for side in cells.shape)
    for row in range(rows):
        for column in range(columns):
            tile = cells[row * TILE_CELLS : (row + 1) * TILE_CELLS, column * TILE_CELLS : (column + 1) * TILE_CELLS]
            if tile.any():
                number = first_column + column, first_row + row
                yield MapTile(robot, own.resolution_m, *number, frozen(tile, np.uint8))
