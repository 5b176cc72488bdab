"""Addresses of sockets."""

from __future__ import annotations

import pytest

from afspm.basics.addresses import connectable


@pytest.mark.parametrize(
    ("bind", "address"),
    [
        ("tcp://*:5555", "tcp://127.0.0.1:5555"),
        ("tcp://0.0.0.0:5555", "tcp://127.0.0.1:5555"),
        ("tcp://[::]:5555", "tcp://[::1]:5555"),
        ("tcp://192.168.0.7:5555", "tcp://192.168.0.7:5555"),
    ],
)
def test_wildcard_host_is_reached_by_loopback(bind: str, address: str) -> None:
    assert connectable(bind) == address
