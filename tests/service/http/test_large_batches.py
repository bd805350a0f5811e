"""A robot whose packets unpack to more than the service takes at once gets all of them through by itself."""

from dataclasses import replace

import numpy as np
import pytest

from fcslam.records import frozen
from fcslam.robot.outbox import Outbox
from fcslam.robot.sender import Sender
from fcslam.wire.http_transport import HttpTransport
from fcslam.wire.limits import MAXIMUM_KEYPOINTS
from tests.robot.fake_cloud import said
from tests.service.http.desk import Desk
from tests.wire.examples import HELLO, LIDAR_PLACE


@pytest.fixture
def place():
    """It travels in some hundred bytes and unpacks to 80 kB."""
    keypoints = frozen(np.zeros((MAXIMUM_KEYPOINTS, 2)), np.float32)
    return replace(LIDAR_PLACE, keypoints=keypoints, descriptors=frozen(np.zeros((MAXIMUM_KEYPOINTS, 32)), np.uint8))


@pytest.mark.slow
def test_a_batch_that_unpacks_to_too_much_is_sent_in_parts(tmp_path, scripted, place):
    scripted()
    outbox = Outbox(tmp_path / "outbox", "alice", 10**9)
    outbox.begin("r", resume=False)
    outbox.put([said(0, HELLO), *(said(k, place) for k in range(1, 35))])
    with Desk(tmp_path / "data", tokens=None) as desk:
        transport = HttpTransport(str(desk.client.base_url), "alice", outbox.agent)
        sender = Sender(
            outbox, transport, np.random.default_rng(0), lambda: desk.now, lambda *_: None, lambda *_: None,
            lambda *_: None,
        )  # fmt: skip
        for _ in range(30):
            desk.now += sender.step()
        transport.close()
        statuses = desk.state.measures.text(desk.state.mission).decode()
        assert desk.state.mission.intake.sessions("alice") == [("alice", 0, 35)]
    assert 'fcslam_refusals_total{status="413"}' in statuses, "it was too much at once"
    assert outbox.waiting == (0, 0)
    outbox.close()
