"""The rule for joining two maps, as a function of counts."""

from dataclasses import replace

import pytest

from fcslam.graph.evidence import (
    LARGEST_CONTRADICTION,
    LARGEST_SEEN_THROUGH,
    LEAST_LIKENESS,
    LEAST_RATIO,
    ClusterEvidence,
    ConsistencySettings,
    MapFit,
    shortfall,
)
from fcslam.records import Reason, ReasonCode

SETTINGS = ConsistencySettings()
SPOT = ClusterEvidence(closures=146, informative=40, separate_places=1, rival_closures=0, rival_places=0)


def fit(ratio: float = 8.0, likeness: float = 1.8, contradiction: float = 0.0) -> MapFit:
    """The maps of one place, 100 m of wall, which fit elsewhere by the inverse of the ratio."""
    support = 200.0 * likeness
    return MapFit(support, 200.0, support / ratio, 100.0, 100.0 * contradiction, 40.0)


@pytest.mark.parametrize(
    ("places", "ratio", "enough"),
    [(1, 1.9, False), (1, 2.1, True), (2, 1.4, False), (2, 1.6, True), (3, 1.25, True), (3, 1.15, False)],
)
def test_a_unique_alignment_replaces_places(places, ratio, enough):
    evidence = replace(SPOT, separate_places=places, fit=fit(ratio))
    assert (shortfall(evidence, SETTINGS) is None) is enough


def test_each_lack_has_its_reason_numbers_and_setting():
    unique = replace(SPOT, fit=fit())
    assert shortfall(unique, SETTINGS) is None
    lacks = {
        replace(unique, closures=2): Reason(ReasonCode.FEW_CLOSURES, 2, 3, "minimum_closures"),
        replace(SPOT, informative=0): Reason(ReasonCode.NOT_INFORMATIVE, 146),
        replace(SPOT, informative=0, fit=fit(1.5)): Reason(ReasonCode.NOT_INFORMATIVE, 146),
        replace(SPOT, rival_closures=100): Reason(ReasonCode.NO_LEAD, 1.46, 2.0),
        replace(SPOT, rival_places=2): Reason(ReasonCode.RIVAL_PLACES, 1, 2),
        SPOT: Reason(ReasonCode.FEW_PLACES, 1, 3.0, "minimum_evidence"),
        replace(SPOT, fit=fit(1.25)): Reason(ReasonCode.NOT_UNIQUE, 1.25, 2.0, "minimum_evidence"),
        replace(SPOT, fit=fit(1.0)): Reason(ReasonCode.LOOK_ALIKE, 1.0, LEAST_RATIO),
        replace(SPOT, fit=fit(contradiction=0.06)): Reason(ReasonCode.MAPS_CONTRADICT, 0.06, LARGEST_CONTRADICTION),
        replace(SPOT, fit=replace(fit(), seen_through=0.01)): Reason(
            ReasonCode.MAPS_CONTRADICT, 0.01, LARGEST_SEEN_THROUGH
        ),
        replace(SPOT, fit=fit(likeness=0.4)): Reason(ReasonCode.WALLS_DIFFER, 0.4, LEAST_LIKENESS),
    }
    for evidence, reason in lacks.items():
        assert shortfall(evidence, SETTINGS) == reason
        assert not reason.setting or reason.setting in ConsistencySettings.model_fields


@pytest.mark.parametrize("places", [1, 3, 30])
def test_no_number_of_closures_joins_maps_that_contradict_each_other(places):
    many = replace(SPOT, closures=500, informative=400, separate_places=places)
    for against in (fit(contradiction=0.03), fit(likeness=0.3), fit(ratio=1.05)):
        assert shortfall(replace(many, fit=against), SETTINGS) is not None
    assert shortfall(replace(many, fit=fit()), SETTINGS) is None


def test_the_maps_decide_between_clusters_and_not_the_number_of_closures():
    outnumbered = replace(SPOT, closures=10, rival_closures=100, separate_places=3, rival_places=9)
    assert shortfall(outnumbered, SETTINGS).code is ReasonCode.NO_LEAD
    assert shortfall(replace(outnumbered, fit=fit()), SETTINGS) is None
    assert shortfall(replace(outnumbered, fit=fit(likeness=0.7)), SETTINGS).code is ReasonCode.NO_LEAD
    assert shortfall(replace(outnumbered, separate_places=2, fit=fit()), SETTINGS).code is ReasonCode.NO_LEAD


def test_three_places_need_no_comparison_where_none_is_possible():
    assert shortfall(replace(SPOT, separate_places=3, closures=3), SETTINGS) is None


def test_maps_that_fit_in_one_way_only_fix_the_pose_of_a_lane_in_which_no_closure_does():
    lane = replace(SPOT, informative=0, separate_places=4)
    assert shortfall(replace(lane, fit=fit(2.1)), SETTINGS) is None
    assert shortfall(replace(lane, fit=fit(1.9)), SETTINGS).code is ReasonCode.NOT_INFORMATIVE
