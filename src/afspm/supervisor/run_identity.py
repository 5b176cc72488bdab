"""Clock and identity that all parts of a run share; a part without the scheduler asks the scheduler for them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass

from afspm import wire
from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.errors import ConfigError, WireError
from afspm.basics.launch import Launch
from afspm.model import CLOCK_REQUEST, ControlResponse, Request, Response
from afspm.transport.port import ControlConnected, ReplyReceived
from afspm.transport.zmq_port import open_port

_ASK_EVERY_S = 1.0  # real time: an answer may be lost, and a refusal may end
_GIVE_UP_AFTER_S = 10.0
"""Real time for which a refusal may be temporary: the scheduler may still hold the connection of a dead computer."""
_SAME_S = 1e-3  # clocks of two processes of one computer differ by less


@dataclass(frozen=True)
class RunIdentity:
    """Identity and clock of a run, the same on all of its computers.

    Attributes:
        run: random identity of the run; empty if unknown here.
        simulated: True only if the microscope is certain to be simulated.
    """

    clock: ExperimentClock
    run: str
    simulated: bool


def new_identity() -> str:
    return os.urandom(8).hex()


def ask_scheduler(launch: Launch, report: Callable[[str], None]) -> RunIdentity:
    """Wait for the scheduler, and return the identity of its run. A scheduler without a clock uses real time.

    Raises:
        ConfigError: the scheduler still refuses the request after ten seconds.
        WireError: the answer can't be read.
    """
    wall = ExperimentClock.real()
    port = open_port(launch, wall)
    session, sent, asked, asked_s, again_s = os.urandom(4).hex(), 0, "", wall.now_s(), -math.inf
    connected = waiting = False
    refused_s, began_s = math.inf, wall.monotonic_s()
    try:
        while True:
            if connected and wall.monotonic_s() >= again_s:
                sent, asked_s, again_s = sent + 1, wall.now_s(), wall.monotonic_s() + _ASK_EVERY_S
                asked = f"{launch.name}/{session}/{sent}"
                port.send(wire.encode_request(Request(CLOCK_REQUEST, id=asked)))
            for incoming in port.poll(_ASK_EVERY_S):
                connected = connected or isinstance(incoming, ControlConnected)
                if not isinstance(incoming, ReplyReceived) or incoming.response.id != asked:
                    continue
                response, now_s = incoming.response, wall.monotonic_s()
                if response.code == ControlResponse.CMD_NOT_SUPPORTED:
                    report(f"{response.reason}: the experiment goes by real time")
                    return RunIdentity(wall, "", simulated=False)
                if response.ok or now_s >= refused_s + _GIVE_UP_AFTER_S:
                    return _identity_in(response, asked_s, wall.now_s(), str(launch.sockets.control))
                if refused_s == math.inf:
                    refused_s = now_s
                    report(f"the scheduler refuses: {response.reason}; asking again for {_GIVE_UP_AFTER_S:.0f} s")
            # a time, not an empty poll: a refused key causes events without end
            if not connected and not waiting and wall.monotonic_s() >= began_s + _ASK_EVERY_S:
                waiting = True
                where = f"the scheduler at {launch.sockets.control}, whose run and clock this part joins"
                report(
                    f"waiting for {where}; if it runs already, `afspm doctor` with the experiment file finds the cause"
                )
    finally:
        port.close()


def _identity_in(response: Response, asked_s: float, answered_s: float, where: str) -> RunIdentity:
    if not response.ok:
        raise ConfigError(f"the scheduler does not answer with its time: {response.reason}", where=where)
    try:
        answer = json.loads(response.payload)
        run, simulated = str(answer.pop("run", "")), answer.pop("simulated", False) is True
        now_s = int(answer.pop("now_ns")) / NS_PER_S
        clock = ExperimentClock.from_dict(answer)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise WireError(f"the scheduler's time can't be read: {error!r}", where=where) from error
    if answer.get("waits"):
        return RunIdentity(clock, run, simulated)
    real_s = (asked_s + answered_s) / 2
    shown_s = clock.start_s + (real_s - clock.origin_s) * clock.speed
    if abs(now_s - shown_s) <= ((answered_s - asked_s) / 2 + _SAME_S) * clock.speed:
        return RunIdentity(clock, run, simulated)  # same wall clock: take the scheduler's clock unchanged
    return RunIdentity(ExperimentClock(real_s, now_s, clock.speed), run, simulated)
