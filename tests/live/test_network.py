"""Names, domains and the configuration of DDS; types of messages."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the library cyclonedds is not installed (extra `ros2`)")
pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros2`)")

from torchcrf_scan.live.network import Connection, Network, dds_name
from torchcrf_scan.live.types import LASER, MARKERS, OBSTACLES, ODOMETRY, new, struct, type_hash, typestore


@pytest.mark.parametrize(
    ("topic", "name"), [("/scan", "rt/scan"), ("scan", "rt/scan"), ("/robot_1/front/scan", "rt/robot_1/front/scan")]
)
def test_names_of_topics(topic: str, name: str) -> None:
    assert dds_name(topic) == name


@pytest.mark.parametrize("topic", ["", "/", "/a b", "/1a", "/a//b", "/ä"])
def test_wrong_names_are_refused(topic: str) -> None:
    with pytest.raises(ValueError, match="topic: expected a name like /scan, got"):
        dds_name(topic)


def test_domains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert Network().number == 0
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert (Network().number, Network(7).number) == (42, 7)
    for wrong in (-1, 233):
        with pytest.raises(ValueError, match=f"domain: expected a number from 0 to 232, got {wrong}"):
            Connection(Network(wrong))
    monkeypatch.setenv("ROS_DOMAIN_ID", "x")
    with pytest.raises(ValueError, match="got x"):
        Connection(Network())


def test_configuration() -> None:
    assert Network().to_xml() == ""
    told = ET.fromstring(Network(0, ("10.0.0.1", 'a"b')).to_xml())
    assert [peer.get("address") for peer in told.iter("Peer")] == ["10.0.0.1", 'a"b']
    assert [one.text for one in told.iter("AllowMulticast")] == ["false"]
    told = ET.fromstring(Network(0, (), "10.0.0.2").to_xml())
    assert [one.get("address") for one in told.iter("NetworkInterface")] == ["10.0.0.2"]
    assert not list(told.iter("Discovery"))


def test_a_network_that_is_not_there_is_one_error() -> None:
    with pytest.raises(ValueError, match="domain 231: expected a network that cyclonedds can use"):
        Connection(Network(231, (), "203.0.113.7"))


@pytest.mark.parametrize("kind", [LASER, ODOMETRY, MARKERS, OBSTACLES])
def test_types_are_those_of_ros(kind: str) -> None:
    package, _, name = kind.split("/")
    assert struct(kind).__idl__.idl_transformed_typename == f"{package}::msg::dds_::{name}_"
    assert type_hash(kind).startswith("RIHS01_")
    store = typestore()
    data = bytes(new(kind).serialize())
    assert bytes(store.serialize_cdr(store.deserialize_cdr(data, kind), kind)) == data


def test_messages_are_those_of_rosbags_to_the_byte() -> None:
    fields = {"header": {"frame_id": "laser", "stamp": {"sec": 3, "nanosec": 5}}, "angle_min": -1.5, "ranges": [1.0, np.inf, 2.5]}
    data = bytes(new(LASER, **fields).serialize())
    told = typestore().deserialize_cdr(data, LASER)
    assert (told.header.frame_id, told.header.stamp.nanosec, told.angle_min) == ("laser", 5, -1.5)
    assert told.ranges.tolist() == [1.0, np.inf, 2.5]
    assert bytes(typestore().serialize_cdr(told, LASER)) == data
    assert struct(LASER).deserialize(data).ranges == [1.0, np.inf, 2.5]
