"""Files of parameters, and how ROS 2 configures the middleware."""

from pathlib import Path

import pytest

from fcslam.errors import InputError
from fcslam.ros.parameters import NodeParameters, load_parameters
from fcslam.ros.ros2 import configuration

SHIPPED = Path(__file__).parents[2] / "ros" / "fcslam_ros" / "config" / "fcslam.yaml"


def test_the_shipped_file_holds_every_parameter_with_its_default():
    assert load_parameters(SHIPPED) == NodeParameters()
    assert set(NodeParameters.model_fields) <= set(SHIPPED.read_text(encoding="utf-8").replace(":", " ").split())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fcslam: {ros__parameters: {map_frme: m}}", "unknown key 'map_frme'; did you mean 'map_frame'"),
        ("map_update_interval: 0", "map_update_interval: Input should be greater than 0"),
        ("a: {ros__parameters: {}}\nb: {ros__parameters: {}}", "has parameters of 2 nodes"),
        ("- 1", "has no parameters"),
        ("{", "cannot be read"),
    ],
)
def test_files_that_cannot_be_used(tmp_path, text, said):
    path = tmp_path / "parameters.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=said):
        load_parameters(path)


def test_a_plain_mapping_is_enough(tmp_path):
    path = tmp_path / "parameters.yaml"
    path.write_text("map_frame: robot1/map", encoding="utf-8")
    assert load_parameters(path).map_frame == "robot1/map"


def test_the_middleware_is_configured_as_ros_2_is():
    assert "<AllowMulticast>default<" in configuration({})
    local = configuration({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
    assert "<AllowMulticast>false<" in local
    assert 'Address="127.0.0.1"' in local
    assert '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>' in local
    assert "Interfaces" not in configuration({})
    assert 'autodetermine="true"' in configuration({"ROS_LOCALHOST_ONLY": "1", "ROS_STATIC_PEERS": "10.0.0.2"})
    assert "<AllowMulticast>false<" in configuration({"ROS_LOCALHOST_ONLY": "1"})
    peers = configuration({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "10.0.0.2;robot.local"})
    assert 'Address="10.0.0.2"/><Peer Address="robot.local"' in peers
    assert "127.0.0.1" not in peers
    assert "<InitialLocatorPruneDelay>inf<" in peers
    assert configuration({"CYCLONEDDS_URI": "file:///etc/dds.xml"}).endswith(",file:///etc/dds.xml")


def test_a_peer_that_is_no_address_is_refused():
    with pytest.raises(InputError, match="ROS_STATIC_PEERS has"):
        configuration({"ROS_STATIC_PEERS": '"/><Domain>'})
