"""The own map of a robot keeps nothing of what it has applied."""

from concurrent.futures import Future

import numpy as np

from fcslam.live.own_map import OwnMap
from fcslam.records import Correction
from tests.robot.fake_cloud import said
from tests.wire.examples import HELLO


class Instant:
    """Runs nothing, and is done at once."""

    def submit(self, *_):
        done = Future()
        done.set_result([(0, Correction("anna", 1, 0, np.zeros(3)))])
        return done


def test_packets_that_were_applied_are_forgotten():
    corrected = []
    own = OwnMap("anna", None, Instant(), lambda epoch, _: corrected.append(epoch))
    for ordinal in range(50):
        own.put([said(ordinal, HELLO, float(ordinal))])
    assert len(corrected) == 50
    assert len(own._applying) <= 1
    assert own.backlog == 0
