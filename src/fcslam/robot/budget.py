"""Fewer bytes than a robot would like to send: the chain first, then as many of each place's descriptors as fit."""

from collections.abc import Iterable
from dataclasses import replace

from fcslam.records import CODE_BYTES, Place
from fcslam.wire.limits import BYTES_PER_AXIS, KEYPOINT_AXES
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode

BURST_S = 10.0
"""Seconds of the budget that may be spent ahead: places come in one piece."""
ENVELOPE_BYTES = 100
"""At most so much of a place is neither keypoint nor descriptor."""
FEWEST_DESCRIPTORS = 50
"""A place with less is rarely known again; its bytes serve the next one."""


class Budget:
    """Bytes per second of the recording's own time, so the same recording always sends the same.

    Hello, keyscans and constraints always travel: without them there is no map. They count, and places get what they
    leave: all of their descriptors, the strongest of them, or nothing.
    """

    def __init__(self, bytes_per_s: float) -> None:
        self._bytes_per_s = bytes_per_s
        self._began: float | None = None
        self._spent = 0
        self.left_out = 0
        """Places that were not sent at all."""

    def fit(self, packets: Iterable[Packet]) -> list[Packet]:
        """What may be sent of the front end's next packets; descriptors are the strongest first."""
        kept = []
        for packet in packets:
            if self._began is None:
                self._began = packet.time
            place = packet.body
            chosen = self._thinned(packet, place) if isinstance(place, Place) else packet
            if chosen is None:
                self.left_out += 1
                continue
            self._spent += len(encode(chosen))
            kept.append(chosen)
        return kept

    def _thinned(self, packet: Packet, place: Place) -> Packet | None:
        seconds = packet.time - (packet.time if self._began is None else self._began)
        room = self._bytes_per_s * (seconds + BURST_S) - self._spent - ENVELOPE_BYTES
        fitting = room / (CODE_BYTES + BYTES_PER_AXIS * KEYPOINT_AXES[place.channel])
        if fitting >= len(place.descriptors):
            return packet
        if fitting < FEWEST_DESCRIPTORS:
            return None
        count = int(fitting)
        few = replace(place, keypoints=place.keypoints[:count], descriptors=place.descriptors[:count])
        return replace(packet, body=few)
