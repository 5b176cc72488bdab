"""A part without the scheduler says that it waits, also if its keys do not fit."""

from __future__ import annotations

import pytest
import zmq

from afspm.basics.launch import Launch, Sockets
from afspm.supervisor.run_identity import ask_scheduler
from afspm.transport.keys import Keys, pair


class Waiting(Exception):
    """The first text that the waiting part tells."""


def test_part_whose_key_of_the_scheduler_is_out_of_date_says_that_it_waits() -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    scheduler = context.socket(zmq.ROUTER)
    _, scheduler.curve_secretkey = pair()
    scheduler.curve_server = True
    address = f"tcp://127.0.0.1:{scheduler.bind_to_random_port('tcp://127.0.0.1')}"
    former, _ = pair()
    keys = Keys("series", *pair(), {former: "scheduler"}, {address: "scheduler"}, everywhere=True)
    launch = Launch("series", sockets=Sockets(control=address), keys=keys.as_launch())

    def raise_text(text: str) -> None:
        raise Waiting(text)

    try:
        with pytest.raises(Waiting, match=r"waiting for the scheduler .* `afspm doctor`"):
            ask_scheduler(launch, raise_text)
    finally:
        context.destroy(linger=0)
