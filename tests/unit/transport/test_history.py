"""Packets that a publisher keeps for late joiners."""

from __future__ import annotations

import logging
from typing import Any

import pytest
import zmq

from afspm.basics.clock import ExperimentClock
from afspm.model import Packet
from afspm.transport import late_joiners
from afspm.transport.late_joiners import Marker, PublishedHistory
from afspm.transport.network import Network
from afspm.transport.publisher import Publisher
from afspm.transport.rate_limited_log import RateLimitedLog

CLOCK = ExperimentClock.real()
LOG = RateLimitedLog(logging.getLogger("test"), CLOCK)


def test_packet_about_the_moment_is_not_sent_to_late_joiners() -> None:
    published = PublishedHistory(CLOCK, most_packets=3)
    scan = published.stamp("Scan2d", b"scan")
    lines = [published.stamp("ScanLines", b"line", keep=False) for _ in range(10)]
    state = published.stamp("ScopeStateMsg", b"free")
    assert published("somebody", ("",), -1) == [scan, state]
    times = [packet.time_ns or 0 for packet in (scan, *lines, state)]
    assert times == sorted(set(times))


@pytest.fixture
def three() -> tuple[PublishedHistory, list[Packet]]:
    """A history, and its three packets."""
    published = PublishedHistory(CLOCK)
    return published, [published.stamp("Scan2d", b"%d" % number) for number in range(3)]


def test_a_history_gives_only_packets_newer_than_the_time_asked_for(
    three: tuple[PublishedHistory, list[Packet]],
) -> None:
    published, packets = three
    for seen, packet in enumerate(packets, 1):
        assert published("late", ("Scan2d",), packet.time_ns or 0) == packets[seen:]


def test_a_replay_has_only_packets_newer_than_the_time_in_its_marker(
    three: tuple[PublishedHistory, list[Packet]], plain: Any, open_: Any, until: Any
) -> None:
    """Subscribers drop repeated packets, so only the wire shows a needless replay."""
    published, packets = three
    network = open_(Network())
    publisher = Publisher(network, "tcp://127.0.0.1:0", published, published.newest, LOG)
    subscriber = plain(zmq.XSUB)  # a SUB socket would drop a topic that it has not subscribed to itself
    subscriber.connect(publisher.address)
    topic = late_joiners.topic("Late", 1)
    subscriber.send(b"\1" + Marker(topic, packets[1].time_ns or 0, ("Scan2d",)).encode())
    received: list[list[bytes]] = []

    def replayed() -> bool:
        publisher.socket.poll(20)
        publisher.serve()
        while subscriber.poll(0):
            received.append(subscriber.recv_multipart())
        return received[-1:] == [[topic]]

    until(replayed)
    assert [frames[2] for frames in received[:-1]] == [b"2"]
