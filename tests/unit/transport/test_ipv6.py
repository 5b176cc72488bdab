"""Addresses of IPv6."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
import zmq

from afspm.transport.network import Network
from afspm.transport.probe import is_of_this_computer


def _has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_STREAM) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


pytestmark = pytest.mark.skipif(not _has_ipv6(), reason="this computer has no IPv6")


@pytest.fixture
def network() -> Iterator[Network]:
    made = Network()
    yield made
    made.close()


def test_sockets_bind_and_connect_to_an_address_of_ipv6(network: Network) -> None:
    server, client = network.socket(zmq.ROUTER), network.socket(zmq.DEALER)
    network.connect(client, network.bind(server, "tcp://[::1]:0"))
    client.send(b"hello")
    assert server.poll(5000)
    assert server.recv_multipart()[1] == b"hello"


def test_address_of_ipv6_is_of_this_computer() -> None:
    assert is_of_this_computer("tcp://[::1]:9000")
    assert not is_of_this_computer("tcp://[2001:db8::1]:9000")
