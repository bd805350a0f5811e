"""The rule for joining two maps, as a function of counts."""

from dataclasses import replace

import pytest

from fcslam.graph.evidence import ClusterEvidence, EvidenceSettings, MapFit, shortfall
from fcslam.records import Reason, ReasonCode

SETTINGS = EvidenceSettings()
SPOT = ClusterEvidence(closures=146, informative=40, separate_places=1, rival_closures=0, rival_places=0)


@pytest.mark.parametrize(
    ("places", "ratio", "enough"),
    [(1, 2.9, False), (1, 3.1, True), (2, 1.9, False), (2, 2.1, True), (3, 0.5, True), (1, 0.0, False)],
)
def test_a_unique_alignment_replaces_places(places, ratio, enough):
    evidence = replace(SPOT, separate_places=places, fit=MapFit(ratio, 0.0))
    assert (shortfall(evidence, SETTINGS) is None) is enough


def test_each_lack_has_its_reason_numbers_and_setting():
    unique = replace(SPOT, fit=MapFit(8.0, 0.0))
    assert shortfall(unique, SETTINGS) is None
    lacks = {
        replace(unique, closures=2): Reason(ReasonCode.FEW_CLOSURES, 2, 3, "minimum_closures"),
        replace(unique, informative=0): Reason(ReasonCode.NOT_INFORMATIVE, 146),
        replace(unique, rival_closures=100): Reason(ReasonCode.NO_LEAD, 1.46, 2.0, "lead"),
        replace(unique, rival_places=2): Reason(ReasonCode.RIVAL_PLACES, 1, 2),
        SPOT: Reason(ReasonCode.FEW_PLACES, 1, 3.0, "minimum_evidence"),
        replace(SPOT, fit=MapFit(1.3, 0.01)): Reason(ReasonCode.NOT_UNIQUE, 1.3, 3.0, "minimum_evidence"),
        replace(SPOT, fit=MapFit(8.0, 0.06)): Reason(ReasonCode.MAPS_CONTRADICT, 0.06, 0.03, "violation"),
    }
    for evidence, reason in lacks.items():
        assert shortfall(evidence, SETTINGS) == reason
        assert not reason.setting or reason.setting in EvidenceSettings.model_fields


def test_three_places_need_no_alignment():
    assert shortfall(replace(SPOT, separate_places=3, closures=3), SETTINGS) is None
