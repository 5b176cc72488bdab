"""An agent's program begins once the gateway accepts connections."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from afspm.supervisor import FreePorts
from afspm_bench.trial import TrialFailed, await_listener


def test_program_waits_for_a_gateway_that_starts_later(monkeypatch: pytest.MonkeyPatch) -> None:
    port, connect = FreePorts().take(), socket.create_connection
    listeners: list[socket.socket] = []
    refused: list[OSError] = []

    def attempt(address: tuple[str, int], **options: Any) -> socket.socket:
        try:
            return connect(address, **options)
        except OSError as error:
            refused.append(error)
            listeners.append(socket.create_server(("127.0.0.1", port)))
            raise

    monkeypatch.setattr(socket, "create_connection", attempt)
    await_listener(f"http://127.0.0.1:{port}", 30.0)
    assert len(refused) == 1
    listeners[0].close()


def test_gateway_that_never_listens_is_named() -> None:
    url = f"http://127.0.0.1:{FreePorts().take()}"
    with pytest.raises(TrialFailed, match=f"nothing listens at {url}"):
        await_listener(url, 0.0)
