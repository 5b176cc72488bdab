from __future__ import annotations

import socket

from afspm.supervisor.ports import HIGHEST, LOWEST, FreePorts


def test_no_port_is_given_twice() -> None:
    ports = FreePorts()
    given = [ports.take() for _ in range(50)]
    assert len(set(given)) == 50


def test_a_port_can_be_bound_and_lies_outside_the_range_of_outgoing_connections() -> None:
    port = FreePorts().take()
    assert LOWEST <= port < HIGHEST <= 32_768
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", port))


def test_an_address_names_the_host() -> None:
    assert FreePorts("127.0.0.1").address().startswith("tcp://127.0.0.1:")
