"""Two schedulers at one translator, as a real process: the one of its own run is obeyed, the other is told so."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zmq
from deadlines import DEADLINE_S

from afspm import wire
from afspm.model import ControlRequest, Request, Response, names
from afspm.model.fencing import Epoch

OURS, THEIRS = "0123456789abcdef", "fedcba9876543210"
START = Request(ControlRequest.ACTION, names.START_SCAN)
DEADLINE_MS = 30_000

Ask = Callable[..., Response]


@pytest.fixture
def ask() -> Iterator[Callable[[Any, Epoch | None], Ask]]:
    """`ask(running, epoch)`: a scheduler, with a function that asks; None: one of version 1."""
    context: zmq.Context[Any] = zmq.Context()
    sockets = []  # or one that a test holds no name for is closed

    def scheduler(running: Any, epoch: Epoch | None) -> Ask:
        socket = context.socket(zmq.DEALER)
        sockets.append(socket)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(running.serve)
        before = [b"1", *([] if epoch is None else [epoch.encode()]), b""]

        def asks(request: Request | bytes) -> Response:
            socket.send_multipart(
                [*before, *([request] if isinstance(request, bytes) else wire.encode_request(request))]
            )
            while True:
                assert socket.poll(DEADLINE_MS), "no answer"
                frames = socket.recv_multipart()
                if frames != [b""]:  # it looks whether we are there
                    assert frames[: len(before)] == before
                    return wire.decode_response(frames[len(before) :])

        asks.close = socket.close  # type: ignore[attr-defined]
        return asks

    yield scheduler
    context.destroy(linger=0)


def started(run: Any, identity: str) -> Any:
    """A translator of a run."""
    running = run(speed=1.0)
    running.kill()
    running.launch = replace(running.launch, run=identity)
    running.start()
    return running


def until_free(asks: Ask) -> Response:
    deadline_s = time.monotonic() + DEADLINE_S
    while (response := asks(START)).code != 0 and time.monotonic() < deadline_s:
        pass
    return response


def test_every_request_of_another_runs_scheduler_is_refused(run: Any, ask: Any) -> None:
    running = started(run, OURS)
    theirs, ours = ask(running, Epoch(THEIRS, 1)), ask(running, Epoch(OURS, 1))
    for request in (START, wire.CLOSE):
        refused = theirs(request)
        assert (refused.code, "another scheduler" in refused.reason) == (1, True)
    assert until_free(ours).ok
    assert theirs(Request(ControlRequest.ACTION, names.STOP_SCAN)).code == 1
    assert running.process.poll() is None


def test_a_scheduler_that_was_replaced_is_obeyed_no_more(run: Any, ask: Any) -> None:
    running = started(run, OURS)
    first, second = ask(running, Epoch(OURS, 1)), ask(running, Epoch(OURS, 2))
    assert until_free(first).ok
    assert second(Request(ControlRequest.ACTION, names.STOP_SCAN)).ok
    assert first(START).code == 1


def test_a_translator_by_itself_obeys_the_first_until_that_has_gone(run: Any, ask: Any) -> None:
    running = started(run, "")
    first, second = ask(running, Epoch(OURS, 1)), ask(running, Epoch(THEIRS, 1))
    assert until_free(first).ok
    assert second(START).code == 1
    first.close()
    deadline_s = time.monotonic() + DEADLINE_S
    while (response := second(Request(ControlRequest.ACTION, names.STOP_SCAN))).code != 0:
        assert time.monotonic() < deadline_s, response.reason
    said = json.dumps(Path(running.log).read_text())
    assert said.count("another scheduler") == 1, "and that is said once"
