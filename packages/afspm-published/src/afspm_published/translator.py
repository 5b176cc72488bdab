"""Bridge for a translator of the published implementation under an afspm scheduler."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

import zmq

from afspm import Memory, wire
from afspm.basics import ConfigError, ExitCode, Launch, Sockets, WireError, python_command
from afspm.model import (
    ChannelRoles,
    ControlRequest,
    ControlResponse,
    Packet,
    Request,
    Response,
    ResponseDetail,
    Role,
    ScopeState,
    names,
)
from afspm.model.fencing import Epoch, SchedulerFence
from afspm.model.sessions import run_of
from afspm.supervisor import FreePorts
from afspm.supervisor.process import GUARD
from afspm.translator.requests import RequestOutcomes
from afspm.transport import Network, ParentGone, Poller, WakeUp
from afspm.transport.frames import receive_frames, send_frames
from afspm.transport.network import CONNECTED, DISCONNECTED, MAX_PACKET_BYTES, Monitor
from afspm.transport.port import RequestReceived, Served, SubscriberJoined
from afspm.transport.zmq_server import ZmqServerPort
from afspm.wire.messages import SCOPE_STATE, SPECTRUM
from afspm_published import version_1

if TYPE_CHECKING:
    from afspm.transport import ProcessContext

STOPPED_WITHIN_S: Final = 2.0
"""Real time that the published translator has to stop its measurement when the experiment ends."""
_STOPS: Final = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}
_OWN = b"own"  # the id of this process's own requests, which clients' requests don't have


class PublishedTranslator:
    """An afspm translator that passes requests on to a translator of the published implementation.

    Args:
        serve: address of the published translator's control server.
        publish: address of the published translator's publisher.
        program: command that starts the translator; its standard input gets afspm's launch line with both addresses.
        spectra_by_variable: whether the translator sends the values of a spectrum variable by variable, as the
            published translators for Nanonis and Asylum do.
        channels: names of channels by role, `{ height = "HeightTrace" }`: version 1 does not know what a channel
            measures, and components that ask for a role need it.

    Raises:
        ConfigError: neither a program nor both addresses are given, or a program and both addresses; there is no role
            of such a name.
    """

    role: ClassVar[Role] = Role.TRANSLATOR

    def __init__(
        self,
        serve: str = "",
        publish: str = "",
        program: Sequence[str] = (),
        *,
        spectra_by_variable: bool = False,
        channels: Mapping[str, str | list[str]] | None = None,
    ) -> None:
        if bool(program) == bool(serve and publish):
            raise ConfigError(
                "their translator is either at two addresses or a program that is started",
                where="serve",
                hint='serve = "tcp://…" and publish = "tcp://…", or program = ["…"]',
            )
        self._serve, self._publish, self._program = serve, publish, tuple(program)
        self._by_variable = spectra_by_variable
        self._channels = ChannelRoles().changed(channels or {}).with_topography(feedback_on=None)

    def run_process(self, context: ProcessContext) -> int:
        """Run until the experiment ends, the parent is gone, or the started program has ended."""
        stop = _Stop()
        context.when_stopping(stop.set)
        if not self._program:
            return self._run(context, stop, self._serve, self._publish)
        ports = FreePorts()
        serve, publish = ports.address(), ports.address()
        with _started(self._program, context, Sockets(serve=serve, publish=publish), stop) as child:
            code = self._run(context, stop, serve, publish)
        return child.returncode or ExitCode.CRASHED if stop.child_ended else code

    def _run(self, context: ProcessContext, stop: _Stop, serve: str, publish: str) -> int:
        # inside, a translator exists only while the published translator is connected, so that the scheduler sees a
        # loss
        launch = context.launch
        memory = Memory(Path(launch.state_dir) / f"{launch.name}.json" if launch.state_dir else None, synced=False)
        while not stop.is_set and _is_connected(context.launch, serve, stop):
            bridge = _TranslatorPort(context, memory, serve, publish, by_variable=self._by_variable)
            bridge.channels = self._channels
            try:
                if bridge.run(stop):
                    return ExitCode.ENDED
            finally:
                bridge.close()
            if not stop.is_set:
                context.log.warning("the connection to their translator at %s is lost", serve)
        return ExitCode.ORPHAN


class SimulatedPublishedTranslator(PublishedTranslator):
    """A published translator whose microscope is declared as simulated."""

    simulated: ClassVar[bool] = True


class _Stop:
    """Request to end, set by the parent or by the end of the started program."""

    def __init__(self) -> None:
        self.is_set = self.child_ended = False
        self.wake_up: WakeUp[None] = WakeUp()
        self.bridge: _TranslatorPort | None = None

    def set(self) -> None:
        self.is_set = True
        self.wake_up.post()
        if self.bridge is not None:
            self.bridge.wake_up(ParentGone())

    def watch(self, child: subprocess.Popen[bytes]) -> None:
        child.wait()
        self.child_ended = not self.is_set
        self.set()


@contextmanager
def _started(
    program: Sequence[str], context: ProcessContext, sockets: Sockets, stop: _Stop
) -> Iterator[subprocess.Popen[bytes]]:
    # under the guard that also runs commands in other languages; without keys, which version 1 does not have
    own = (sys.executable,) if program[0] == "python" else program[:1]
    line = replace(context.launch, class_="", settings={}, sockets=sockets, keys=None).to_json()
    child = subprocess.Popen([*python_command(GUARD), "--", *own, *program[1:]], stdin=subprocess.PIPE)
    assert child.stdin is not None
    try:
        child.stdin.write(line.encode() + b"\n")
        child.stdin.flush()
        threading.Thread(target=stop.watch, args=(child,), name="program", daemon=True).start()
        yield child
    finally:
        child.stdin.close()
        child.wait()


def by_point(payload: bytes) -> bytes:
    """Return an encoded Spec1d with its values reordered from variable by variable to point by point.

    Raises:
        WireError: the payload is no Spec1d.
    """
    spectrum = wire.decode(SPECTRUM.name, payload)
    points, variables = spectrum.values.shape
    return wire.encode(replace(spectrum, values=spectrum.values.reshape(variables, points).T))[1]


def _is_connected(launch: Launch, address: str, stop: _Stop) -> bool:
    # waits for a listener at the address; False: a request to end came first
    network = version_1.outside(launch)
    try:
        socket = network.socket(zmq.DEALER)
        monitor = Monitor(network, socket, CONNECTED)
        network.connect(socket, address)
        poller: Poller[Monitor] = Poller(stop.wake_up)
        poller.register(monitor.socket, monitor)
        while not stop.is_set:
            if poller.wait(None)[0]:
                return True
        return False
    finally:
        network.close()


class _TranslatorPort(ZmqServerPort):
    """Port with a translator's sockets towards afspm, and a scheduler's sockets towards the published translator."""

    def __init__(self, context: ProcessContext, memory: Memory, serve: str, publish: str, *, by_variable: bool) -> None:
        launch = context.launch
        if launch.sockets.serve is None:
            raise ConfigError("a translator needs an address to serve", where=launch.name)
        super().__init__(
            Network.from_launch(launch.name, launch.keys),
            context.clock,
            serve=launch.sockets.serve,
            publish=launch.sockets.publish,
            allowed=str((launch.keys or {}).get("scheduler") or "") or None,
        )
        self._by_variable = by_variable
        self._fence = SchedulerFence(launch.run, simulated=launch.simulated)
        self._commander = b""
        self._in_hand: Request | None = None
        self._number = 0
        # saved: after a restart, a request that the published translator may have carried out is not sent again
        self._memory = memory
        self._outcomes = RequestOutcomes(memory.setdefault("requests", {}), all_or_nothing=False)
        self._state = ScopeState.UNDEFINED
        self._ends_s = math.inf
        self._is_lost = False
        self.channels = ChannelRoles()
        self._outside = version_1.outside(launch)
        self._dealer = self._outside.socket(zmq.DEALER)
        self._dealer.setsockopt(zmq.IMMEDIATE, 1)  # no request is queued for a translator that is gone
        self._dealer_monitor = Monitor(self._outside, self._dealer, DISCONNECTED)
        self._sub = self._outside.socket(zmq.SUB, max_bytes=MAX_PACKET_BYTES)
        self._sub.setsockopt(zmq.SUBSCRIBE, b"")
        self._outside.connect(self._dealer, serve)
        self._outside.connect(self._sub, publish)
        self._poller.register(self._dealer, self._answers)
        self._poller.register(self._dealer_monitor.socket, self._lost)
        self._poller.register(self._sub, self._packets)

    def run(self, stop: _Stop) -> bool:
        """Run until the experiment ends, and return True; return False at a request to end, or at a lost connection."""
        stop.bridge = self
        try:
            while not (stop.is_set or self._is_lost):
                now_s = self._clock.monotonic_s()
                if now_s >= self._ends_s:
                    return True
                for arrived in self.poll(None if self._ends_s == math.inf else self._ends_s - now_s):
                    if isinstance(arrived, RequestReceived):
                        self._take(arrived)
                    elif isinstance(arrived, SubscriberJoined) and self.channels.names:
                        self.publish(*wire.encode(self.channels))
            return False
        finally:
            stop.bridge = None

    def close(self) -> None:
        super().close()
        self._outside.close()

    # --- inside: the scheduler ---

    def _take(self, arrived: RequestReceived) -> None:
        before, epoch = self._commander, Epoch.decode(arrived.epoch)
        frames = [bytes(frame) for frame in arrived.frames]
        request_id = frames[2].decode("utf-8", "replace") if len(frames) > 2 else ""
        run = run_of(request_id.partition("/")[0], request_id)
        if why := self._fence.refusal(epoch, run, lambda: self.is_connected(before)):
            self._log.warning(f"refused a request: {why}")
            self._answer(Response(int(ControlResponse.FAILURE), b"", why, request_id))
            return
        self._commander = arrived.connection if epoch is not None else before
        if frames == [wire.CLOSE]:
            self._end()
            return
        try:
            request = wire.decode_request(frames)
        except WireError as error:
            self._answer(Response(error.response, b"", str(error), request_id))
            return
        if known := self._outcomes.outcome(request):
            self._answer(known)
        elif not version_1.has_request(request.kind):
            self._answer(version_1.unknown_request(request.kind, "translator", request.id))
        else:
            self._number += 1
            self._in_hand = request
            self._outcomes.begin(request)
            self._memory.save()
            if not send_frames(self._dealer, [b"%d" % self._number, b"", *version_1.request_frames(request)]):
                self._in_hand = None
                self._outcomes.forget(request)
                why, detail = "their translator is not connected", ResponseDetail.NOT_SENT
                self._answer(Response(int(ControlResponse.NO_RESPONSE), b"", why, request.id, detail))

    def _answer(self, response: Response) -> None:
        self.reply(wire.encode_response(response))

    def _end(self) -> None:
        # the published translator goes on until a person stops it; its running scan must not
        self._answer(Response(int(ControlResponse.SUCCESS)))
        self._ends_s = self._clock.monotonic_s()
        if stop := _STOPS.get(self._state):
            self._ends_s += STOPPED_WITHIN_S
            frames = version_1.request_frames(Request(int(ControlRequest.ACTION), stop))
            send_frames(self._dealer, [_OWN, b"", *frames])

    # --- outside: the published translator ---

    def _answers(self) -> list[Served]:
        while frames := receive_frames(self._dealer):
            number, *content = [frame.bytes for frame in frames]
            if number == _OWN:
                self._ends_s = self._clock.monotonic_s()
            if self._in_hand is None or number != b"%d" % self._number or content[:1] != [b""]:
                continue
            request, self._in_hand = self._in_hand, None
            try:
                response = wire.decode_response(content[1:])
            except WireError as error:
                response = Response(
                    int(ControlResponse.FAILURE), reason=f"the translator's answer is malformed: {error}"
                )
            response.id = request.id
            self._outcomes.finish(request, response)
            self._memory.save()
            self._answer(response)
        return []

    def _lost(self) -> list[Served]:
        self._is_lost = self._is_lost or bool(self._dealer_monitor.drain())
        return []

    def _packets(self) -> list[Served]:
        while frames := receive_frames(self._sub):
            try:
                self._publish_theirs(wire.decode_packet([frame.bytes for frame in frames]))
            except WireError as error:
                self._log.warning(f"dropped a packet of their translator: {error}")
        return []

    def _publish_theirs(self, packet: Packet) -> None:
        message, payload = wire.message_of(packet.envelope), bytes(packet.payload)
        if message == SCOPE_STATE.name:
            self._state = wire.decode(message, payload).state
        elif message == SPECTRUM.name and self._by_variable:
            payload = by_point(payload)
        self.publish(packet.envelope, payload, packet.time_ns)
