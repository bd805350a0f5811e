"""The bridge on Zenoh against a peer that speaks as rmw_zenoh does."""

import threading

import numpy as np
import pytest

from fcslam.errors import InputError
from fcslam.ros.network import Endpoint, Quality
from fcslam.ros.ros2_zenoh import ZenohNetwork, endpoint_of, quality_text, session_config
from fcslam.sources.bags.codec import SCAN, TRANSFORMS
from tests.postgres import free_port
from tests.ros.ros_messages import CODEC, encoded, scan, transform
from tests.waiting import wait_for

pytest.importorskip("zenoh", reason="no eclipse-zenoh: make ros-test")

from tests.ros import zenoh_peer

pytestmark = pytest.mark.slow

STRING = "std_msgs/String"
HELLO, WORLD = (encoded(STRING, CODEC.make(STRING, data=word)) for word in ("hello", "world"))


@pytest.fixture(scope="module")
def port():
    port = free_port()
    router = zenoh_peer.router(port)
    yield port
    router.close()


@pytest.fixture
def network(port):
    network = ZenohNetwork(3, {"ZENOH_CONFIG_OVERRIDE": f'connect/endpoints=["tcp/127.0.0.1:{port}"]'})
    yield network
    network.close()


@pytest.fixture
def peer(port):
    peer = zenoh_peer.ZenohPeer(port, domain=3)
    yield peer
    peer.close()


def foreign(network):
    return {point for point in network.endpoints() if not point.own}


def test_endpoints_are_seen_until_they_go(network, peer):
    peer.publisher("/robot1/scan", SCAN, zenoh_peer.BEST_EFFORT)
    peer.subscribe("/robot1/map", "nav_msgs/OccupancyGrid", zenoh_peer.LATCHED, print)
    wait_for(lambda: len(foreign(network)) == 2)
    assert {(p.topic, p.kind, p.publishes, p.quality.reliable, p.quality.latched) for p in foreign(network)} == {
        ("/robot1/scan", SCAN, True, False, False),
        ("/robot1/map", "nav_msgs/OccupancyGrid", False, True, True),
    }
    peer.close()
    wait_for(lambda: not foreign(network))


def test_messages_arrive_in_both_directions(network, peer):
    came, went = [], []
    sent = encoded(SCAN, scan(1.0, np.ones(90)))
    network.subscribe("/robot1/scan", SCAN, Quality(reliable=False), lambda payload, _: came.append(payload))
    publish = network.publisher("/robot1/text", STRING, Quality(reliable=True))
    peer.subscribe("/robot1/text", STRING, zenoh_peer.RELIABLE, went.append)
    put = peer.publisher("/robot1/scan", SCAN, zenoh_peer.BEST_EFFORT)
    wait_for(lambda: put(sent) or (came and not publish(HELLO) and went))
    assert came[0] == sent
    assert went[0] == HELLO


def test_each_publisher_of_a_topic_has_an_id(network, peer, port):
    came, other = set(), zenoh_peer.ZenohPeer(port, domain=3)
    network.subscribe("/robot1/scan", SCAN, Quality(reliable=False), lambda _, publisher: came.add(publisher))
    puts = [each.publisher("/robot1/scan", SCAN, zenoh_peer.BEST_EFFORT) for each in (peer, other)]
    sent = encoded(SCAN, scan(1.0, np.ones(90)))
    wait_for(lambda: [put(sent) for put in puts] and len(came) == 2)
    other.close()
    assert "" not in came


def test_what_is_latched_reaches_who_comes_late(network, peer):
    came, went = [], []
    network.publisher("/robot1/text", STRING, Quality(True, latched=True, depth=1))(HELLO)
    static = encoded(TRANSFORMS, transform(0.0, "base_link", "laser"))
    peer.publisher("/tf_static", TRANSFORMS, zenoh_peer.LATCHED)(static)
    peer.subscribe("/robot1/text", STRING, zenoh_peer.LATCHED, went.append)
    network.subscribe("/tf_static", TRANSFORMS, Quality(True, latched=True), lambda payload, _: came.append(payload))
    wait_for(lambda: came and went)
    assert came == [static]
    assert went == [HELLO]


def test_own_messages_do_not_come_back(network, peer):
    heard, came = threading.Event(), []
    peer.subscribe("/text", STRING, zenoh_peer.RELIABLE, lambda _: heard.set())
    network.subscribe("/text", STRING, Quality(True), lambda payload, _: came.append(payload))
    publish = network.publisher("/text", STRING, Quality(True))
    put = peer.publisher("/text", STRING, zenoh_peer.RELIABLE)
    wait_for(lambda: publish(HELLO) or heard.is_set())
    wait_for(lambda: put(WORLD) or came)
    assert set(came) == {WORLD}


def test_the_bridge_shows_itself_as_a_node_of_ros(network, peer):
    network.publisher("/robot1/map", "nav_msgs/OccupancyGrid", Quality(True, latched=True, depth=1))
    wait_for(lambda: len(peer.graph()) == 3)
    assert {words for words in peer.graph() if words[3] == "fcslam"} == {
        ("NN", "%", "%", "fcslam"),
        (
            "MP", "%", "%", "fcslam", "%robot1%map", "nav_msgs::msg::dds_::OccupancyGrid_",
            zenoh_peer.HASHES["nav_msgs/OccupancyGrid"], ":1:,1:,:,:,,",
        ),
    }  # fmt: skip


def test_a_missing_router_is_one_line():
    with pytest.raises(InputError, match=r"no Zenoh router answers at .*tcp/127.0.0.1:9.*rmw_zenohd"):
        ZenohNetwork(0, {"ZENOH_CONFIG_OVERRIDE": 'connect/endpoints=["tcp/127.0.0.1:9"]'})


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ({"ZENOH_CONFIG_OVERRIDE": "mode"}, "ZENOH_CONFIG_OVERRIDE has 'mode'; write KEY=VALUE"),
        ({"ZENOH_CONFIG_OVERRIDE": "mode=server"}, "ZENOH_CONFIG_OVERRIDE: mode=server cannot be used"),
        ({"ZENOH_SESSION_CONFIG_URI": "/nowhere.json5"}, "ZENOH_SESSION_CONFIG_URI: /nowhere.json5 cannot be used"),
    ],
)
def test_a_configuration_that_cannot_be_used(environment, said):
    with pytest.raises(InputError, match=said):
        session_config(environment)


@pytest.mark.parametrize(
    "token",
    [
        "@ros2_lv/0/a/0/0/NN/%/%/driver",
        "@ros2_lv/0/a/0/1/SS/%/%/driver/%go/std_srvs::srv::dds_::Trigger_/RIHS01_0/::,10:,:,:,,",
        "@ros2_lv/0/a/0/1/MP/%/%/driver/%go/String/RIHS01_0/::,10:,:,:,,",
        "@ros2_lv",
    ],
)
def test_tokens_of_something_else_are_ignored(token):
    assert endpoint_of(token, "b") is None


def test_quality_in_tokens():
    qualities = [Quality(reliable, latched, 5) for reliable in (True, False) for latched in (True, False)]
    for quality in qualities:
        token = f"@ros2_lv/0/a/0/1/MS/%/%/x/%go/std_msgs::msg::dds_::String_/RIHS01_0/{quality_text(quality)}"
        found = endpoint_of(token, "a")
        assert found == Endpoint("/go", STRING, False, quality._replace(depth=found.quality.depth), True)
