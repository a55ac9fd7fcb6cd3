"""DDS as ROS 2 uses it: the domain, and readers and writers of topics."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import quoteattr

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.live.types import struct, type_hash

LOOPBACK = "127.0.0.1"
PARTICIPANTS = 60  # on a machine whose peers are found without multicast
WAITING = 1  # messages that a writer keeps for those who are slow


@dataclass(frozen=True, slots=True)
class Network:
    """Which network to use.

    Attributes:
        domain: number of the domain; None: the environment's ROS_DOMAIN_ID, or 0.
        peers: addresses to look for others at, without multicast; empty: as cyclonedds is configured (CYCLONEDDS_URI).
        interface: address of the network interface; empty: as cyclonedds is configured.
    """

    domain: int | None = None
    peers: tuple[str, ...] = ()
    interface: str = ""

    @property
    def number(self) -> int:
        """The number of the domain; raises TorchCRFScanError if it is none from 0 to 232."""
        told = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0" if self.domain is None else str(self.domain)
        if not (told.isdecimal() and int(told) <= 232):
            raise TorchCRFScanError(f"domain: expected a number from 0 to 232, got {told}")
        return int(told)

    def to_xml(self) -> str:
        """The configuration for cyclonedds; empty: none of its own."""
        if not self.peers and not self.interface:
            return ""
        network = f"<NetworkInterface address={quoteattr(self.interface)}/>" if self.interface else ""
        general = f"<General>{f'<Interfaces>{network}</Interfaces>' if network else ''}"
        discovery = ""
        if self.peers:
            general += "<AllowMulticast>false</AllowMulticast>"
            peers = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in self.peers)
            found = f"<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>{PARTICIPANTS}</MaxAutoParticipantIndex>"
            discovery = f"<Discovery>{found}<Peers>{peers}</Peers></Discovery>"
        return f'<CycloneDDS><Domain id="any">{general}</General>{discovery}</Domain></CycloneDDS>'


class Connection:
    """A participant in a domain.

    Raises:
        TorchCRFScanError: cyclonedds is missing, or refuses the network.
    """

    def __init__(self, network: Network) -> None:
        try:
            from cyclonedds.domain import Domain, DomainParticipant
        except ImportError as error:
            raise TorchCRFScanError(f"listening: expected the library cyclonedds (extra `ros2`), got {error}") from error
        number, settings = network.number, network.to_xml()
        try:
            self._domain = Domain(number, settings) if settings else None
            self.participant = DomainParticipant(number)
        except Exception as error:  # of the library
            raise TorchCRFScanError(f"domain {number}: expected a network that cyclonedds can use, got {error}") from error

    def reader(self, topic: str, kind: str, depth: int) -> Any:
        """A reader that keeps the newest `depth` messages of a topic, best effort: it fits any writer."""
        from cyclonedds.qos import Policy
        from cyclonedds.sub import DataReader

        return DataReader(self.participant, self._topic(topic, kind), qos=_quality(kind, depth, Policy.Reliability.BestEffort))

    def writer(self, topic: str, kind: str) -> Any:
        """A writer that fits any reader, also one that asks for reliability, and never waits for it."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy

        quality = _quality(kind, WAITING, Policy.Reliability.Reliable(max_blocking_time=0))
        return DataWriter(self.participant, self._topic(topic, kind), qos=quality)

    def _topic(self, name: str, kind: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self.participant, dds_name(name), struct(kind))


def dds_name(topic: str) -> str:
    """The name by which DDS knows a topic of ROS 2: /scan is rt/scan. Raises TorchCRFScanError if it is no name of a topic."""
    parts = topic.strip("/").split("/")
    if not all(part.isidentifier() and part.isascii() for part in parts):
        raise TorchCRFScanError(f"topic: expected a name like /scan, got {topic!r}")
    return "/".join(["rt", *parts])


def _quality(kind: str, depth: int, reliability: Any) -> Any:
    """Quality of service like that of ROS 2; the type's hash goes with it."""
    from cyclonedds.qos import Policy, Qos

    return Qos(
        reliability,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={type_hash(kind)};".encode()),
    )


class Bell:
    """Rings when a reader has messages."""

    def __init__(self, reader: Any) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet

        self._condition = ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)
        self._waiting = WaitSet(reader.participant)
        self._waiting.attach(self._condition)

    def wait(self, seconds: float) -> bool:
        """Waits so long for messages; whether there are any."""
        from cyclonedds.util import duration

        return bool(self._waiting.wait(duration(seconds=seconds)))
