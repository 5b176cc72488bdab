"""Programs of the published implementation beside ours, with the bridge in a process of its own between them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from bridged_rig import Bridge, BridgedRig
from version_1 import Router

from afspm.basics.launch import Sockets
from afspm.supervisor.ports import FreePorts


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[BridgedRig]:
    made = BridgedRig(tmp_path)
    yield made
    made.close()


class BridgedRouter(Router):
    """Their scheduler, with the address that ours know it by."""

    def __init__(self, socket: Any, folder: Path, publisher: Any) -> None:
        super().__init__(socket)
        ports = FreePorts()
        publish, serve = ports.address(), ports.address()
        port = publisher.bind_to_random_port("tcp://127.0.0.1")
        self.bridge = Bridge(
            "scheduler.PublishedScheduler",
            Sockets(publish=publish, serve=serve),
            {"serve": self.address, "publish": f"tcp://127.0.0.1:{port}"},
            folder,
        )
        self.address = serve


@pytest.fixture
def router(plain: Any, tmp_path: Path) -> Iterator[Router]:
    made = BridgedRouter(plain(zmq.ROUTER), tmp_path, plain(zmq.PUB))
    yield made
    made.bridge.close()
