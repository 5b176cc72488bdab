"""Faults on demand, seen by a peer; and peers that are the fault."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from typing import Any

import pytest
import zmq
from deadlines import DEADLINE_S

from afspm import wire
from afspm.wire.generated import control_pb2

FREE, SCANNING, INTERRUPTED = 3, 2, 4
OK, FAILURE, START_SCAN = 0, 1, "start-scan"


@pytest.fixture
def faulty(run: Any) -> Any:
    return run({"fault_action": True})


def demand(peer: Any, kind: str, count: int = 1, duration_s: float = 0.3) -> None:
    assert peer.set("x-fault-kind", kind)[0] == bytes([OK])
    assert peer.set("x-fault-count", str(count))[0] == bytes([OK])
    assert peer.set("x-fault-duration", str(duration_s), "s")[0] == bytes([OK])
    assert peer.act("x-fault") == OK


def get_speed() -> list[bytes]:
    return [b"\2", control_pb2.ParameterMsg(parameter="scan-speed").SerializeToString()]


def test_faults_on_demand_are_not_there_unless_wanted(run: Any) -> None:
    peer = run().peer().ready()
    assert peer.act("x-fault") == 11
    assert peer.set("x-fault-kind", "crash")[0] == b"\x08"


def test_slow_answers_come_late(faulty: Any) -> None:
    peer = faulty.peer().ready()
    demand(peer, "late-reply", count=2, duration_s=1.0)
    for _ in range(2):
        began_s = time.monotonic()
        assert peer.ask_frames(get_speed(), DEADLINE_S)[0] == b"\0"
        assert time.monotonic() - began_s >= 1.0
    deadline_s = time.monotonic() + DEADLINE_S
    while time.monotonic() - began_s >= 1.0:  # on a busy computer an answer may be late by itself
        assert time.monotonic() < deadline_s, "all answers are late"
        began_s = time.monotonic()
        peer.get("scan-speed")


def test_a_lost_answer_was_carried_out_and_is_given_when_asked_again(faulty: Any) -> None:
    peer = faulty.peer().ready()
    demand(peer, "no-reply")
    scan = [b"\1", control_pb2.ActionMsg(action=START_SCAN).SerializeToString(), b"me/1/scan"]
    assert peer.ask_frames(scan, 0.5) is None
    assert peer.ask_frames(scan, DEADLINE_S)[0] == b"\0"
    heard = peer.until(FREE)
    assert sum(name == "Scan2d" for name, _ in heard) == 5
    assert len(list((faulty.folder / "scans").glob("scan-*.nc"))) == 1


def test_refusals_end_after_their_number(faulty: Any) -> None:
    peer = faulty.peer().ready()
    demand(peer, "error", count=2)
    assert [peer.act(START_SCAN), peer.act(START_SCAN), peer.act(START_SCAN)] == [FAILURE, FAILURE, OK]


def test_a_hanging_translator_answers_afterwards(faulty: Any) -> None:
    peer = faulty.peer().ready()
    began_s = time.monotonic()  # before it begins to hang, which on a busy computer is a while before the question
    demand(peer, "hang", duration_s=0.5)
    peer.get("scan-speed")
    assert time.monotonic() - began_s >= 0.5


def test_a_half_written_file_is_waited_for(faulty: Any) -> None:
    peer = faulty.peer().ready()
    demand(peer, "half-file", duration_s=5.0)
    assert peer.act(START_SCAN) == OK
    heard = peer.until(FREE)
    assert sum(name == "Scan2d" for name, _ in heard) == 5
    assert all(message.scope_state != INTERRUPTED for name, message in heard if name == "ScopeStateMsg")


def test_a_scheduled_crash_comes_once(run: Any) -> None:
    running = run({"faults": [{"kind": "crash", "at_s": 1000.0}]})
    assert running.wait(DEADLINE_S) == 1
    running.start()
    running.peer().ready()
    assert running.process.poll() is None


def garbage(seed: int) -> Iterator[list[bytes]]:
    """Messages that begin with the empty frame of a request, and others that do not."""
    chance = random.Random(seed)
    for _ in range(1500):
        frames = [chance.randbytes(chance.choice([0, 1, 1, 2, 40])) for _ in range(chance.randrange(1, 5))]
        if chance.random() < 0.5:
            frames[0] = bytes([chance.randrange(14)])
        if frames == [wire.CLOSE]:  # not garbage: the scheduler says that the experiment is over
            continue
        yield [b"", *frames] if chance.random() < 0.9 else chance.choice([[b"x"], [b""]])


@pytest.mark.parametrize("seed", [1, 2])
def test_garbage_from_strangers_is_answered_or_ignored(run: Any, seed: int) -> None:
    running = run()
    peer = running.peer().ready()
    asked = answered = 0
    with zmq.Context() as context, context.socket(zmq.DEALER) as stranger:
        stranger.setsockopt(zmq.LINGER, 0)
        stranger.connect(running.serve)
        for frames in garbage(seed):
            is_request = len(frames) > 1
            stranger.send_multipart(frames)
            if is_request:
                asked += 1
                assert stranger.poll(int(1000 * DEADLINE_S)), frames
                assert stranger.recv_multipart()[1][0] in range(13)
                answered += 1
    assert answered == asked > 1000
    assert peer.get("scan-speed")
    assert running.process.poll() is None
