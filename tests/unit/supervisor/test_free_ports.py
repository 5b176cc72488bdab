from __future__ import annotations

import contextlib
import socket

import pytest

from afspm.supervisor.ports import CAN_HOLD, HIGHEST, LOWEST, FreePorts


def test_no_port_is_given_twice() -> None:
    ports = FreePorts()
    given = [ports.take() for _ in range(50)]
    assert len(set(given)) == 50


def test_a_port_can_be_bound_and_lies_outside_the_range_of_outgoing_connections() -> None:
    port = FreePorts().take()
    assert LOWEST <= port < HIGHEST <= 32_768
    socket.create_server(("127.0.0.1", port)).close()


def test_an_address_names_the_host() -> None:
    assert FreePorts("127.0.0.1").address().startswith("tcp://127.0.0.1:")


@pytest.mark.skipif(not CAN_HOLD, reason="ports can't be held here")
def test_a_port_is_nobody_else_s_before_it_is_bound_while_it_is_bound_and_between_two_who_bind_it() -> None:
    address = ("127.0.0.1", FreePorts().take())

    def is_free() -> bool:
        with socket.socket() as other, contextlib.suppress(OSError):
            other.bind(address)
            return True
        return False

    assert not is_free()
    for _ in range(2):
        with socket.create_server(address):  # as ZeroMQ does
            assert not is_free()
        assert not is_free()
    with socket.socket() as peer, pytest.raises(ConnectionRefusedError):
        peer.connect(address)
