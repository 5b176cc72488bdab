"""The shell's records around the end of an experiment, with the real decisions and the real log."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

from fake_clock import FakeClock

from afspm import wire
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    Packet,
    Problem,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    RelayedMessage,
    Request,
    ResponseDetail,
    ScopeState,
    ScopeStatus,
)
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.settings import SchedulerSettings
from afspm.scheduler.shell import SchedulerShell
from afspm.scheduler.wire_codec import WireCodec
from afspm.scheduler.write_ahead import StateFile, WriteAhead
from afspm.storage.packet_log import PacketLog, cached_packets, logged_packets
from afspm.transport.port import PacketReceived
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.router import PeerAsked, PeerConnected

LOG = logging.getLogger("scheduler")


class Lab:
    """A shell without sockets: requests are handed to it."""

    def __init__(self, folder: Path) -> None:
        self.log = folder / "packets"
        self.clock = FakeClock()
        self.sockets: Any = MagicMock()
        self.sockets.due_s = math.inf
        core = SchedulerCore(SchedulerSettings(), WireCodec())
        state = StateFile(folder / "scheduler.json", LOG)
        self.writes = WriteAhead(state, PacketLog(self.log), core.cached, LOG)
        warnings = RateLimitedLog(LOG, self.clock)
        self.shell = SchedulerShell(core, self.sockets, wire, self.clock, self.writes, warnings, LOG)
        self.shell.start()
        self._asked = 0

    def ask(self, name: str, kind: int, subject: object = None) -> None:
        self._asked += 1
        frames = wire.encode_request(Request(kind, subject, id=f"{name}/session/{self._asked}"))
        self.sockets.receive.return_value = [[PeerConnected(self._asked), PeerAsked(self._asked, name, None, frames)]]
        self.shell.handle([])


def states_of(name: str) -> bytes:
    alive = ProcessState(name, "component", ProcessCondition.ALIVE, 1)
    return wire.encode(ProcessStates(1, "supervisor", (alive,)))[1]


def test_packets_after_the_end_are_recorded_and_not_cached(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    before, after = states_of("before"), states_of("after")
    lab.ask("supervisor", RELAY_REQUEST, RelayedMessage("ProcessStates", before))
    lab.ask("experiment", ControlRequest.END_EXPERIMENT)
    assert lab.shell.ended
    lab.ask("supervisor", RELAY_REQUEST, RelayedMessage("ProcessStates", after))
    lab.writes.close()
    logged = [bytes(entry.packet.payload) for entry in logged_packets(lab.log)]
    cached = [bytes(entry.packet.payload) for entry in cached_packets(lab.log)]
    assert (before in logged, after in logged) == (True, True)
    assert (before in cached, after in cached) == (True, False)


def test_problem_flagged_after_the_end_is_recorded(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    lab.ask("experiment", ControlRequest.END_EXPERIMENT)
    lab.ask("classifier", ControlRequest.ADD_EXP_PRBLM, int(Problem.TIP_SHAPE_CHANGED))
    lab.writes.close()
    journal = [entry.packet for entry in logged_packets(lab.log) if entry.packet.envelope == "JournalEntries"]
    entries = [entry for packet in journal for entry in wire.decode("JournalEntries", packet.payload).entries]
    assert [entry.problem for entry in entries if entry.who == "classifier"] == [int(Problem.TIP_SHAPE_CHANGED)]


def test_other_requests_after_the_end_are_answered_that_it_has_ended(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    lab.ask("experiment", ControlRequest.END_EXPERIMENT)
    lab.ask("late", ControlRequest.REQUEST_CTRL, 0)
    response = wire.decode_response(lab.sockets.reply.call_args.args[1])
    lab.writes.close()
    assert response.detail == ResponseDetail.EXPERIMENT_ENDED


def test_unreadable_packet_costs_no_other_packet_of_its_batch(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    state = wire.encode(ScopeStatus(ScopeState.FREE))[1]
    packets = [Packet("Scan2d", b"\xff\xff", 1), Packet("ScopeStateMsg", state, 2)]
    lab.sockets.receive.return_value = [[PacketReceived(packet, "translator") for packet in packets]]
    lab.shell.handle([])
    lab.writes.close()
    published = [call.args[0] for call in lab.sockets.publish.call_args_list]
    assert [bytes(one.payload) for one in published if one.envelope in ("Scan2d", "ScopeStateMsg")] == [state]
