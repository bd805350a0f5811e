"""Evidence for a transform between two maps: one measure and one rule, pure functions of counts.

Each separate place whose closures agree is one independent test of the transform: it counts one. Where the maps
overlap in few places, an exhaustive alignment of them tells whether the transform is the only one that fits. It adds
the ratio of its score to the best score elsewhere, less one. A corridor with equal doors scores nearly as well one door
farther, so its alignment adds next to nothing. An unmistakable room replaces two further places. So does a tag that
both robots saw: its number is unmistakable, but it may be there twice, and then the maps contradict each other.
"""

import math
from dataclasses import dataclass

from pydantic import Field

from fcslam.config import Settings
from fcslam.records import Reason, ReasonCode

LEAST_KNOWN_M = 10.0
"""Walls of each map in known area of the other that a comparison needs, metres, summed over both maps."""
LARGEST_CONTRADICTION = 0.02
"""Largest share of walls in the other map's free space. One floor in three years had up to 0.010, robots of one day up
to 0.006, and refurnished or partly equal floors from 0.037 on."""
LEAST_LIKENESS = 0.85
"""Least ``MapFit.likeness``: see `docs/results/real-buildings.md`."""
LARGEST_RIVAL = 0.85
"""Largest support of a transform elsewhere, as a share of that of the transform."""
TAG_PLACES = 2.0
"""Further places that a tag replaces, which both robots saw, if their maps do not contradict each other."""


class EvidenceSettings(Settings):
    """How much evidence joins two maps."""

    minimum_closures: int = Field(
        default=3, ge=1, description="consistent closures that a cluster needs to join two maps"
    )
    minimum_evidence: float = Field(
        default=3.0,
        ge=0.0,
        description="evidence that a cluster needs to join two maps: its separate places, plus the ratio by which the "
        "alignment of the maps scores better than the best one elsewhere, less one",
    )
    violation: float = Field(
        default=0.03,
        ge=0.0,
        le=1.0,
        description="largest share of one map's surfaces in the other's free space at which an alignment is evidence",
    )
    lead: float = Field(
        default=2.0,
        ge=1.0,
        description="least ratio of sizes, of the largest cluster to the largest one that contradicts it",
    )


@dataclass(frozen=True, slots=True)
class MapFit:
    """How well two maps fit at one transform, compared with the best transform elsewhere.

    Likelihoods are those of ``fcslam.lidar.map_agreement``, summed over all places that both robots saw.
    """

    ratio: float
    """Score at the transform, divided by the best score elsewhere."""
    violation: float
    """Share of one map's surfaces in the other's free space: the worse of both directions."""
    support: float = 0.0
    """Log-likelihood ratio of the same places to others that look alike, nats."""
    expected: float = 0.0
    """Its expectation if the places are the same."""
    rival_support: float = -math.inf
    """The largest ``support`` of a transform elsewhere."""
    known_m: float = 0.0
    """Walls of each map in known area of the other, metres, summed over both maps."""
    contradicting_m: float = 0.0
    """Those in the other's free space, metres."""

    @property
    def likeness(self) -> float:
        """The support as a share of its expectation: about 1 in the same place, negative in another."""
        return self.support / self.expected if self.expected > 0.0 else 0.0

    @property
    def contradiction(self) -> float:
        """Share of the walls in the other's free space."""
        return self.contradicting_m / self.known_m if self.known_m > 0.0 else 0.0


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


def shortfall(evidence: ClusterEvidence, settings: EvidenceSettings) -> Reason | None:
    """Why the evidence is not enough to join two maps; None if it is. The reason names one of the settings.

    Where the maps were compared, they decide between clusters that contradict each other, and not the number of
    closures: in a building that repeats itself, most closures may be false.
    """
    if evidence.closures < settings.minimum_closures:
        return Reason(ReasonCode.FEW_CLOSURES, evidence.closures, settings.minimum_closures, "minimum_closures")
    if not evidence.informative:
        return Reason(ReasonCode.NOT_INFORMATIVE, evidence.closures)
    if evidence.fit is not None and evidence.fit.known_m >= LEAST_KNOWN_M:
        refuted = refutation(evidence.fit)
        if refuted is not None:
            return refuted
    elif evidence.closures < settings.lead * evidence.rival_closures:
        return Reason(ReasonCode.NO_LEAD, evidence.closures / evidence.rival_closures, settings.lead, "lead")
    elif evidence.separate_places < evidence.rival_places:
        return Reason(ReasonCode.RIVAL_PLACES, evidence.separate_places, evidence.rival_places)
    return _amount_shortfall(evidence, settings)


def refutation(fit: MapFit) -> Reason | None:
    """Why the maps speak against the transform."""
    if fit.contradiction > LARGEST_CONTRADICTION:
        return Reason(ReasonCode.MAPS_CONTRADICT, fit.contradiction, LARGEST_CONTRADICTION)
    if fit.likeness < LEAST_LIKENESS:
        return Reason(ReasonCode.WALLS_DIFFER, fit.likeness, LEAST_LIKENESS)
    if fit.rival_support > LARGEST_RIVAL * fit.support:
        return Reason(ReasonCode.LOOK_ALIKE, fit.rival_support / fit.support, LARGEST_RIVAL)
    return None


def _amount_shortfall(evidence: ClusterEvidence, settings: EvidenceSettings) -> Reason | None:
    places, fit, least = evidence.separate_places, evidence.fit, settings.minimum_evidence
    if places >= least:
        return None
    if fit is None:
        return Reason(ReasonCode.FEW_PLACES, places, least, "minimum_evidence")
    if fit.violation > settings.violation:
        return Reason(ReasonCode.MAPS_CONTRADICT, fit.violation, settings.violation, "violation")
    if places + max(0.0, fit.ratio - 1.0) + (TAG_PLACES if evidence.tags else 0.0) >= least:
        return None
    return Reason(ReasonCode.NOT_UNIQUE, fit.ratio, 1.0 + least - places, "minimum_evidence")
