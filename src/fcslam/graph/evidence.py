"""Evidence for a transform between two maps: one measure and one rule, pure functions of counts.

Each separate place whose closures agree is one independent test of the transform: it counts one. Where the maps
overlap in few places, an exhaustive alignment of them tells whether the transform is the only one that fits. It adds
the ratio of its score to the best score elsewhere, less one. A corridor with equal doors scores nearly as well one door
farther, so its alignment adds next to nothing. An unmistakable room replaces two further places. So does a tag that
both robots saw: its number is unmistakable, but it may be there twice, and then the maps contradict each other.
"""

from dataclasses import dataclass

from pydantic import Field

from fcslam.config import Settings
from fcslam.records import Reason, ReasonCode

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
class Uniqueness:
    """How well two maps fit at one transform, compared with the best transform elsewhere."""

    ratio: float
    """Score at the transform, divided by the best score elsewhere."""
    violation: float
    """Share of one map's surfaces in the other's free space: the worse of both directions."""


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
    uniqueness: Uniqueness | None = None
    """None if the maps were not aligned exhaustively."""


def shortfall(evidence: ClusterEvidence, settings: EvidenceSettings) -> Reason | None:
    """Why the evidence is not enough to join two maps; None if it is. The reason names one of the settings.

    ``FEW_PLACES``: only the amount is too small, and an exhaustive alignment of the maps may add to it.
    """
    if evidence.closures < settings.minimum_closures:
        return Reason(ReasonCode.FEW_CLOSURES, evidence.closures, settings.minimum_closures, "minimum_closures")
    if not evidence.informative:
        return Reason(ReasonCode.NOT_INFORMATIVE, evidence.closures)
    if evidence.closures < settings.lead * evidence.rival_closures:
        return Reason(ReasonCode.NO_LEAD, evidence.closures / evidence.rival_closures, settings.lead, "lead")
    if evidence.separate_places < evidence.rival_places:
        return Reason(ReasonCode.RIVAL_PLACES, evidence.separate_places, evidence.rival_places)
    return _amount_shortfall(evidence, settings)


def _amount_shortfall(evidence: ClusterEvidence, settings: EvidenceSettings) -> Reason | None:
    places, unique, least = evidence.separate_places, evidence.uniqueness, settings.minimum_evidence
    if places >= least:
        return None
    if unique is None:
        return Reason(ReasonCode.FEW_PLACES, places, least, "minimum_evidence")
    if unique.violation > settings.violation:
        return Reason(ReasonCode.MAPS_CONTRADICT, unique.violation, settings.violation, "violation")
    if places + max(0.0, unique.ratio - 1.0) + (TAG_PLACES if evidence.tags else 0.0) >= least:
        return None
    return Reason(ReasonCode.NOT_UNIQUE, unique.ratio, 1.0 + least - places, "minimum_evidence")
