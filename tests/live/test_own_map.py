"""The own map of a robot keeps nothing of what it has applied."""

from concurrent.futures import Future

import numpy as np

from fcslam.live.own_map import OwnMap
from fcslam.records import Correction
from tests.robot.fake_cloud import said
from tests.wire.examples import HELLO


class Instant:
    """Runs nothing, and is done at once."""

    def __init__(self):
        self.blocks = []

    def submit(self, _call, _name, _function, arguments):
        self.blocks.append(arguments[0])
        done = Future()
        done.set_result([(0, Correction("anna", 1, 0, np.zeros(3)))])
        return done


def test_packets_that_were_applied_are_forgotten():
    corrected, worker = [], Instant()
    own = OwnMap("anna", None, worker, lambda part, _: corrected.append(part))
    packets = [said(ordinal, HELLO, float(ordinal)) for ordinal in range(50)]
    for packet in packets:
        own.put([packet])
        own.hand_over(packet.time - 3.5)
    _, *blocks = worker.blocks
    assert len(blocks) == len(corrected) == 10, "five packets at once"
    own.put(packets[:1])
    own.poses("anna")  # an answer is of all packets so far
    _, *blocks = worker.blocks[:-1]
    assert [packet for block in blocks for packet in block] == [*packets, packets[0]]
    assert own.backlog == 0
