"""A follower of a running experiment, which reduces published packets to an `Overview` and sends no requests."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from afspm import wire
from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import ExperimentEnded, NoResponse, WireError
from afspm.basics.launch import Launch
from afspm.client.connect import guest_of
from afspm.client.experiment_link import ExperimentLink
from afspm.model import Packet, ProblemNames
from afspm.night import Overview
from afspm.record import cut_off_message
from afspm.supervisor import register_own_messages
from afspm.transport.process.context import new_session
from afspm.transport.zmq_port import open_port
from afspm.wire.messages import SCAN_LINES

HEARD_WITHIN_S = 5.0  # real time; with some of the cached packets missing, what came is shown


class Follower:
    """A follower of the run in a folder, for one thread. It sends no requests, so it can't disturb the run.

    Args:
        folder: folder of the run.
        name: name (and owner of the key) of the follower.
        envelopes: prefixes of the envelopes to subscribe to; None: all messages of translator and scheduler except
            scans, spectra and lines of running scans.
        lines: whether to subscribe to the lines of running scans, too.

    Attributes:
        ended: whether the experiment has ended.
        heard_s: real monotonic time of the last packet; None before the first.

    Raises:
        FileError: there is no run in the folder.
        ConfigError: the run has no scheduler to connect to.
    """

    def __init__(
        self, folder: Path, name: str = "terminal", envelopes: tuple[str, ...] | None = None, *, lines: bool = False
    ) -> None:
        guest = guest_of(folder, name)
        register_own_messages(folder, guest.messages)
        # no socket for requests: a follower sends none, and the scheduler need not know it
        sockets = dataclasses.replace(guest.sockets, control=None)
        # chosen after the registration, so that relayed messages of the experiment are followed, too
        envelopes = (*(envelopes or wire.messages_without_values()), *([SCAN_LINES.name] if lines else ()))
        self.launch: Launch = dataclasses.replace(guest, sockets=sockets, envelopes=envelopes)
        self.folder = folder
        self.clock: Clock = ExperimentClock.from_dict(guest.clock)
        self.overview = Overview(ProblemNames(guest.problems))
        self.ended = False
        self.heard_s: float | None = None
        self._port = open_port(self.launch, self.clock)
        self._link = ExperimentLink.of_launch(guest, self._port, new_session(""))
        self._link.listen(self._take)

    def pump(self, timeout_s: float | None) -> None:
        """Wait for events once, and process them."""
        try:
            self._link.pump(timeout_s)
        except ExperimentEnded:
            self.ended = True

    def catch_up(self, within_s: float = HEARD_WITHIN_S) -> None:
        """Wait for the packets of the scheduler's cache for up to `within_s` real seconds, and process them.

        After that time, with some packets missing, the method returns all the same.

        Raises:
            NoResponse: not one packet arrived.
        """
        until_s = self.clock.monotonic_s() + within_s
        while not (self.ended or self._link.is_caught_up()):
            left_s = until_s - self.clock.monotonic_s()
            if left_s <= 0.0:
                break
            self.pump(left_s)
        if self.heard_s is None and not self._link.is_caught_up():
            hint = self.cut_off() or "is the experiment still running?"
            raise NoResponse("the scheduler does not answer", where=str(self.folder), hint=hint)

    def silent_s(self) -> float:
        """Return the real seconds since the last packet; 0 before the first."""
        return 0.0 if self.heard_s is None else self.clock.monotonic_s() - self.heard_s

    def cut_off(self) -> str:
        """Return a message if the run stopped without an end, after a power cut for instance; else empty."""
        return cut_off_message(self.folder)

    def close(self) -> None:
        self._port.close()

    def __enter__(self) -> Follower:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take(self, packet: Packet, ours: bool) -> None:
        self.heard_s = self.clock.monotonic_s()
        if not ours or packet.time_ns is None:
            return
        try:
            message = wire.message_of(packet.envelope)
            thing = wire.decode(message, packet.payload)
        except WireError:
            return  # an unreadable packet is logged by the components that need it
        self.overview.take(message, thing, packet.time_ns, packet.envelope)
