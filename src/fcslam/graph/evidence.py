"""Evidence for a transform between two maps: one measure and one rule, pure functions of counts.

Each separate place whose closures agree counts one. Places 3 m apart are no independent tests of the transform: their
submaps have three quarters of the walls in common (median), those 9 m apart two fifths. Whatever the number of places,
the maps have the last word. At the transform, the walls of one place lie on each other, no long wall of one map stands
in free space of the other, and the maps fit nowhere else as well.

Where closures come from few places, twice the ratio of the support of the maps there to that elsewhere, less one,
counts as further places, up to twice the likeness of the maps. A corridor with equal doors fits nearly as well one door
farther, so it adds next to nothing. A tag that both robots saw counts as further places, too: its number is
unmistakable, but it may be there twice, and then the maps contradict each other.

In a lane that winds, no closure fixes the pose in every direction, but the maps may.
"""

import math
from dataclasses import dataclass

from pydantic import Field

from fcslam.config import Settings
from fcslam.records import Reason, ReasonCode

AGREES_M, AGREES_RAD = 0.5, 0.1
"""Two transforms of one place or map that differ by no more, metres and radians, say the same; drift is in between."""
DISTINCT_M, DISTINCT_RAD = 1.0, 0.26
"""Two transforms of one place or map that differ by more, metres or radians, are two."""
LEAST_COMPARED_M = 5.0
"""Least ``MapFit.compared_m`` that refutes a transform."""
LARGEST_CONTRADICTION = 0.01
"""Largest share of walls in the other map's free space. Pairs on one published floor had less than 0.0005, also after
years; most refurnished copies had 0.015 to 0.06."""
LARGEST_SEEN_THROUGH = 0.002
"""Largest share of surfaces in space that the other robot saw through, less its standard error. In one place it was
below 0.0001, on floors with the same walls and other furniture 0.004 to 0.015."""
LEAST_LIKENESS = 0.5
"""Least ``MapFit.likeness``. In one place it was 0.55 to 2, in places that look alike mostly less."""
CLEAR_LIKENESS = 0.8
"""Least ``MapFit.likeness`` of a cluster that others outnumber; it must come from enough places, too."""
LEAST_RIVAL = 20.0
"""The support elsewhere is taken to be at least this, nats: maps with little wall in common are never unique."""
LEAST_RATIO = 1.2
"""Least ratio of the support to that of a transform elsewhere, however many places agree."""
LEAD = 2.0
"""Least ratio of the closures of a cluster to those of the largest one that contradicts it, and least ``MapFit.ratio``
of maps that fix the pose where no closure does."""
FURTHER_PLACES = LEAD
"""Further places that maps stand for if they fit twice as well as elsewhere and have a likeness of 1, and that a tag
stands for if both robots saw it and their maps do not contradict each other."""


class ConsistencySettings(Settings):
    """How much evidence joins two maps."""

    minimum_closures: int = Field(
        default=3, ge=1, description="consistent closures that a cluster needs to join two maps"
    )
    minimum_evidence: float = Field(
        default=3.0,
        ge=0.0,
        description="evidence that a cluster needs to join two maps: its separate places, plus twice the ratio by "
        "which the maps fit better than elsewhere, less one",
    )
    separation_m: float = Field(
        default=3.0, ge=0.0, description="least distance between two separate places, in the maps of both robots [m]"
    )


@dataclass(frozen=True, slots=True)
class MapFit:
    """How well two maps fit at one transform, compared with the best transform elsewhere.

    Likelihoods are those of ``fcslam.lidar.map_agreement``, summed over all places that both robots saw.
    """

    support: float = 0.0
    """Log-likelihood ratio of the same places to others that look alike, nats."""
    expected: float = 0.0
    """Its expectation if the places are the same."""
    rival_support: float = -math.inf
    """The largest ``support`` of a transform elsewhere."""
    compared_m: float = 0.0
    """Walls of each map that were compared with the other, metres, summed over both maps and all places."""
    contradicting_m: float = 0.0
    """Those in the other's free space, metres."""
    seen_m: float = 0.0
    """Wall of one map in known area of the other, metres: of both maps, the one with less. 0: it was not measured."""
    seen_through: float = 0.0
    """Share of the surfaces in space that the other robot saw through, less its standard error; 0: none is known."""

    @property
    def is_compared(self) -> bool:
        """Whether there was enough wall to compare."""
        return self.compared_m >= LEAST_COMPARED_M

    @property
    def ratio(self) -> float:
        """Support at the transform, divided by the largest elsewhere."""
        return max(0.0, self.support) / max(LEAST_RIVAL, self.rival_support)

    @property
    def likeness(self) -> float:
        """The support as a share of its expectation: about 1 in the same place, less in another."""
        return self.support / self.expected if self.expected > 0.0 else 0.0

    @property
    def contradiction(self) -> float:
        """Share of the walls in the other's free space."""
        return max(0.0, self.contradicting_m) / self.compared_m if self.compared_m > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class ClusterEvidence:
    """Evidence for and against the transform of one cluster of closures."""

    closures: int
    informative: int
    """Closures that fix the pose in every direction."""
    separate_places: int
    rival_closures: int = 0
    """Closures of the largest cluster that contradicts this one."""
    rival_places: int = 0
    tags: int = 0
    """Tags that both robots saw from several keyscans."""
    fit: MapFit | None = None
    """None if the maps were not compared."""


def shortfall(evidence: ClusterEvidence, settings: ConsistencySettings) -> Reason | None:
    """Why the evidence is not enough to join two maps; None if it is.

    Where the maps agree clearly, they decide between clusters that contradict each other, and not the number of
    closures: in a building that repeats itself, most closures may be false.
    """
    if evidence.closures < settings.minimum_closures:
        return Reason(ReasonCode.FEW_CLOSURES, evidence.closures, settings.minimum_closures, "minimum_closures")
    fit = evidence.fit
    if fit is not None and fit.is_compared:
        is_clear = fit.likeness >= CLEAR_LIKENESS and evidence.separate_places >= settings.minimum_evidence
        outnumbered = None if is_clear else _lead_shortfall(evidence)
        return refutation(fit) or _pose_shortfall(evidence) or outnumbered or _amount_shortfall(evidence, settings)
    return _pose_shortfall(evidence) or _lead_shortfall(evidence) or _amount_shortfall(evidence, settings)


def _pose_shortfall(evidence: ClusterEvidence) -> Reason | None:
    if evidence.informative or (evidence.fit is not None and evidence.fit.ratio >= LEAD):
        return None
    return Reason(ReasonCode.NOT_INFORMATIVE, evidence.closures)


def _lead_shortfall(evidence: ClusterEvidence) -> Reason | None:
    if evidence.closures < LEAD * evidence.rival_closures:
        return Reason(ReasonCode.NO_LEAD, evidence.closures / evidence.rival_closures, LEAD)
    if evidence.separate_places < evidence.rival_places:
        return Reason(ReasonCode.RIVAL_PLACES, evidence.separate_places, evidence.rival_places)
    return None


def refutation(fit: MapFit) -> Reason | None:
    """Why the maps speak against the transform."""
    if fit.contradiction > LARGEST_CONTRADICTION:
        return Reason(ReasonCode.MAPS_CONTRADICT, fit.contradiction, LARGEST_CONTRADICTION)
    if fit.seen_through > LARGEST_SEEN_THROUGH:
        return Reason(ReasonCode.MAPS_CONTRADICT, fit.seen_through, LARGEST_SEEN_THROUGH)
    if fit.likeness < LEAST_LIKENESS:
        return Reason(ReasonCode.WALLS_DIFFER, fit.likeness, LEAST_LIKENESS)
    if fit.support < LEAST_RATIO * fit.rival_support:
        return Reason(ReasonCode.LOOK_ALIKE, fit.support / fit.rival_support, LEAST_RATIO)
    return None


def _amount_shortfall(evidence: ClusterEvidence, settings: ConsistencySettings) -> Reason | None:
    places, fit, least = evidence.separate_places, evidence.fit, settings.minimum_evidence
    if places >= least:
        return None
    if fit is None:
        return Reason(ReasonCode.FEW_PLACES, places, least, "minimum_evidence")
    by_walls = FURTHER_PLACES * min(max(0.0, fit.ratio - 1.0), fit.likeness)
    if places + by_walls + (FURTHER_PLACES if evidence.tags else 0.0) >= least:
        return None
    return Reason(ReasonCode.NOT_UNIQUE, fit.ratio, 1.0 + (least - places) / FURTHER_PLACES, "minimum_evidence")
