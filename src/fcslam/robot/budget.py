"""A limit of bytes per second: keyscans and constraints first, then as many descriptors of each place as fit."""

from collections.abc import Iterable
from dataclasses import replace

from fcslam.records import CODE_BYTES, Place
from fcslam.wire.limits import BYTES_PER_AXIS, KEYPOINT_AXES
from fcslam.wire.messages import Packet
from fcslam.wire.packets import encode

BURST_S = 10.0
"""Seconds of the budget that may be spent in advance: a place is sent in one packet."""
ENVELOPE_BYTES = 100
"""Largest part of a place's packet besides its keypoints and descriptors."""
FEWEST_DESCRIPTORS = 50
"""A place with fewer descriptors is rarely recognised, so it is dropped."""


class Budget:
    """A limit of bytes per second of the recording's own clock, so the same recording always sends the same packets.

    Hello, keyscans and constraints are always sent, as without them there is no map; so are tags and fixes. Places get
    the rest of the budget: they are sent with all their descriptors, with the strongest ones, or not at all.
    """

    def __init__(self, bytes_per_s: float) -> None:
        self._bytes_per_s = bytes_per_s
        self._began: float | None = None
        self._spent = 0
        self.left_out = 0
        """Number of places that were not sent."""

    def fit(self, packets: Iterable[Packet]) -> list[Packet]:
        """Select what to send of the next packets of the front end; descriptors are sorted, strongest first."""
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
        if fitting >= len(place.keypoints):
            return packet
        if fitting < FEWEST_DESCRIPTORS:
            return None
        count = int(fitting)
        few = replace(place, keypoints=place.keypoints[:count], descriptors=place.descriptors[:count])
        return replace(packet, body=few)
