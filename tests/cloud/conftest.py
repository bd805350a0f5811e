import pytest
from cloud.scripted import ScriptedMatcher

from fcslam.cloud import fleet
from fcslam.cloud.fleet import Fleet
from fcslam.cloud.settings import FleetConfig


@pytest.fixture
def scripted(monkeypatch):
    """Makes a fleet whose place matcher finds what the given scripts say."""
    monkeypatch.setattr(fleet, "PlaceMatcher", ScriptedMatcher)

    def make(*scripts, **settings) -> Fleet:
        monkeypatch.setattr(ScriptedMatcher, "script", [line for script in scripts for line in script])
        monkeypatch.setattr(ScriptedMatcher, "predictions", {})
        return Fleet(FleetConfig(**settings), seed=0)

    return make
