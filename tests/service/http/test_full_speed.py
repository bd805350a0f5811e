"""A robot that plays a recording as fast as it can is slowed by the limits of the service, and loses nothing."""

import numpy as np

from fcslam.robot import sender as sending
from fcslam.robot.outbox import Outbox
from fcslam.robot.sender import Sender
from fcslam.service.intake import TokenBuckets
from fcslam.wire.http_transport import HttpTransport
from fcslam.wire.keys import Credentials
from fcslam.wire.packets import decode
from tests.service.http.desk import A

BATCH, PACKETS_PER_S = 4, 2.0


def test_a_recording_at_full_speed_is_slowed_and_not_refused(desk, tmp_path, monkeypatch):
    monkeypatch.setattr(sending, "MAXIMUM_BATCH_PACKETS", BATCH)
    intake = desk.state.mission.intake
    monkeypatch.setattr(intake, "_packet_rate", TokenBuckets(lambda: desk.now, PACKETS_PER_S, BATCH))
    outbox = Outbox(tmp_path / "outbox.sqlite", "a", 10**9)
    outbox.begin("r", resume=False)
    outbox.put([decode(data) for data in A])
    refused, slowed = [], []
    transport = HttpTransport(str(desk.client.base_url), "a", outbox.agent, Credentials("token of a"))
    sender = Sender(
        outbox, transport, np.random.default_rng(0), lambda: desk.now,
        lambda *_: None, lambda *_: None, lambda *packet: refused.append(packet),
    )  # fmt: skip
    while outbox.waiting.packets:
        desk.now += sender.step()
        slowed += [sender.trouble] if sender.trouble else []
    transport.close()
    outbox.close()
    assert not refused
    assert any("packets per second" in trouble for trouble in slowed)
    assert len(desk.state.mission.store.envelopes()) == len(A)
    least_s = (len(A) - BATCH) / PACKETS_PER_S
    assert least_s <= desk.now < 3.0 * least_s, "on the clock of the service, which only moves while the robot waits"
