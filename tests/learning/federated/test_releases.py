"""Versions of a learning fleet on disk: which one is in use, after a release, a rollback and a restart."""

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs fcslam[federated]")

from fcslam.errors import TrainingError
from fcslam.learning.federated.fleet_learning import RELEASE, MissionJudge
from fcslam.learning.federated.live_settings import FleetLearningSettings
from fcslam.learning.federated.releases import Releases

INITIAL = {"a": np.zeros(2, np.float32)}


def weights(value):
    return {"a": np.full(2, value, np.float32)}


@pytest.fixture
def releases(tmp_path):
    return Releases.opened(tmp_path / "releases", b"start", "light-0")


def test_a_release_is_in_use_and_survives_a_restart(releases):
    assert not releases.is_judged
    assert releases.add("light-1", b"one", weights(1.0)) == 1
    again = Releases.opened(releases.folder, b"another", "light-9")
    assert again.in_use == 1
    assert again.pair == (1, 0)
    assert again.detector(0).read_bytes() == b"start"
    assert again.detector(1).read_bytes() == b"one"


def test_what_was_taken_back_is_never_gone_back_to(releases):
    for number in (1, 2, 3):
        releases.add(f"light-{number}", b"", weights(number))
    assert releases.take_back(3) == 2
    assert releases.pair == (2, 1)
    assert releases.take_back(2) == 1
    assert releases.add("light-4", b"", weights(4)) == 4
    assert releases.pair == (4, 1)
    assert releases.take_back(4) == 1
    assert releases.take_back(1) == 0


def test_a_version_that_came_meanwhile_stays_in_use(releases):
    """The version before it was being judged, and is certainly worse than the first."""
    releases.add("light-1", b"", weights(1.0))
    judged, _ = releases.pair
    releases.add("light-2", b"", weights(2.0))
    assert releases.take_back(judged) == 2
    assert releases.taken_back == {1}
    assert releases.pair == (2, 0)


def test_training_goes_on_from_the_version_in_use(releases):
    releases.add("light-1", b"", weights(1.0))
    releases.add("light-2", b"", weights(2.0))
    assert releases.fallback("light-2", INITIAL) is None
    releases.take_back(2)
    assert releases.fallback("light-2", INITIAL)["a"].tolist() == [1.0, 1.0]
    assert releases.fallback("light-1", INITIAL) is None
    releases.take_back(1)
    assert releases.fallback("light-1", INITIAL) is INITIAL


def test_a_folder_with_something_else_is_one_line(releases):
    (releases.folder / "releases.json").write_text("[]")
    with pytest.raises(TrainingError, match="is not a list of releases"):
        Releases.opened(releases.folder, b"", "light-0")


class Mission:
    """Places of which a version finds some more or fewer than the one before."""

    def __init__(self, differences):
        self.differences = differences
        self.asked = []

    def found_again(self, version, before):
        self.asked.append((version, before))
        return np.array(self.differences, np.float64)


@pytest.mark.parametrize(("differences", "in_use"), [([-1.0, 0.0] * 50, 0), ([0.0] * 100, 1), ([-1.0] * 9, 1)])
def test_a_version_that_finds_fewer_places_of_the_mission_is_taken_back(releases, tmp_path, differences, in_use):
    releases.add("light-1", b"", weights(1.0))
    told = []
    judge = MissionJudge(tmp_path, FleetLearningSettings(), releases, lambda *event: told.append(event))
    mission = Mission(differences)
    judge.judge(mission)
    assert mission.asked == [("light-1", "light-0")]
    assert releases.in_use == in_use
    assert told == ([(RELEASE, 0)] if in_use == 0 else [])


def test_one_setting_of_training_leaves_the_others_of_the_recipe():
    settings = FleetLearningSettings.model_validate({"federated": {"training": {"seed": 2}}})
    assert settings.federated.training.seed == 2
    assert settings.federated.training.learning_rate == FleetLearningSettings().federated.training.learning_rate == 1e-3
