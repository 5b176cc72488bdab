from __future__ import annotations

import contextlib
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from afspm.supervisor import ports
from afspm.supervisor.ports import CAN_HOLD, HIGHEST, LONGEST_FOLDER, LOWEST, FreePorts, SocketFolder, new_addresses
from afspm.transport.network import HAS_PRIVATE_SOCKETS


def test_each_port_is_handed_out_once() -> None:
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
def test_port_is_held_before_during_and_between_binds() -> None:
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


@pytest.fixture
def short_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        yield Path(folder)


@pytest.mark.skipif(not HAS_PRIVATE_SOCKETS, reason="there are no unix sockets")
@pytest.mark.parametrize("excess", [0, 1])
def test_socket_folder_is_private_and_short_in_any_environment(
    monkeypatch: pytest.MonkeyPatch, short_folder: Path, excess: int
) -> None:
    deep = short_folder / ("a" * (LONGEST_FOLDER + excess - len(str(short_folder)) - 1))
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    folder = SocketFolder()
    try:
        assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700
        assert (deep in folder.path.parents) is (excess == 0)
        addresses = [folder.address() for _ in range(1000)]
        assert len(set(addresses)) == 1000
        assert max(map(len, addresses)) <= len("ipc://") + 103
    finally:
        folder.close()
    assert not folder.path.exists()


@pytest.mark.parametrize(
    ("private", "tcp", "schemes"),
    [(True, False, ("ipc", "ipc")), (False, False, ("tcp", "ipc")), (False, True, ("tcp", "tcp"))],
)
@pytest.mark.parametrize("has", [True, False])
def test_new_addresses_are_unix_sockets_if_private_and_available(
    monkeypatch: pytest.MonkeyPatch, private: bool, tcp: bool, schemes: tuple[str, str], has: bool
) -> None:
    if has and not HAS_PRIVATE_SOCKETS:
        pytest.skip("there are no unix sockets")
    monkeypatch.setattr(ports, "HAS_PRIVATE_SOCKETS", has)
    with new_addresses(private=private, tcp=tcp) as new:
        found = tuple(address.partition("://")[0] for address in (new.of_socket(), new.of_heartbeat()))
    assert found == (schemes if has else ("tcp", "tcp"))
