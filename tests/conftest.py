"""One small fleet for all tests that need one: drawn once, its packets made once."""

import numpy as np
import pytest
import small_fleet
from hypothesis import settings

from fcslam.simulation.drawn_fleet import DrawnFleet, write_fleet
from fcslam.wire.messages import Packet

# How long an example takes says something of the machine, and of code that is compiled at its first call.
settings.register_profile("fcslam", deadline=None)
settings.load_profile("fcslam")


@pytest.fixture(scope="session")
def drawn() -> DrawnFleet:
    """Three robots, 30 m each, that meet."""
    return small_fleet.draw(3)


@pytest.fixture(scope="session")
def packets(drawn) -> list[Packet]:
    """What the three robots send, in canonical order."""
    return small_fleet.in_order(packet for robot in drawn.robots for packet in small_fleet.sent_by(robot))


@pytest.fixture(scope="session")
def logs(drawn, tmp_path_factory):
    """The three recordings as files, with the truth beside them."""
    return write_fleet(drawn, tmp_path_factory.mktemp("recordings"), np.random.default_rng(0))
