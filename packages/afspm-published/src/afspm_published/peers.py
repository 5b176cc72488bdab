"""Bridge for components of the published implementation in an afspm experiment, or for a published scheduler."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, Final

import zmq

from afspm import wire
from afspm.basics import ConfigError, ExitCode, Launch, WireError
from afspm.model import PERSON, ControlRequest, ControlResponse, Packet, Response, ScopeState
from afspm.transport import Network, ParentGone, PublishedHistory, RateLimitedLog
from afspm.transport.control_client import ControlClient
from afspm.transport.frames import receive_frames, send_frames, send_packet
from afspm.transport.network import ACCEPTED, DISCONNECTED, Monitor
from afspm.transport.port import ControlConnected, Incoming, Killed, PacketReceived, ReplyReceived
from afspm.transport.subscriber import Subscriber
from afspm.transport.zmq_port import BasePort
from afspm.wire.messages import CONTROL_STATE, SCOPE_STATE
from afspm_published import version_1
from afspm_published.version_1 import Pacing

if TYPE_CHECKING:
    from afspm.basics import Clock
    from afspm.transport import ProcessContext

SETTLED_S: Final = 0.05
"""Real time from a subscription to its replay. A peer subscribes several times in a row, and drops packets older than
the newest that it received under any envelope, so the replay waits for all its subscriptions."""
LINGER_S: Final = 1.0
"""Real time after the end of the experiment for last answers."""
MOST_EXTRA: Final = 50
"""Largest number of subscriptions to messages unknown to version 1."""
_PROBLEM_REQUESTS = (ControlRequest.ADD_EXP_PRBLM, ControlRequest.RMV_EXP_PRBLM)
_NO_PROBLEM = b"\0"
_NAMELESS = b"a client without a name: set the socket's identity to the component's name"


class PublishedPeers:
    """The scheduler that components of the published implementation ("peers") expect in an afspm experiment.

    In the afspm scheduler each peer is a client with its own name.

    Args:
        serve: address for the control clients of the peers.
        publish: address for the subscribers of the peers.
        as_translator: act as the translator instead, for the published scheduler or test suite. Packets then have a
            translator's envelopes, and this process takes control before each command.
    """

    opens_plain: ClassVar[bool] = True
    """Programs without keys can command the microscope through this class: the experiment file must allow its use."""

    def __init__(self, serve: str, publish: str, *, as_translator: bool = False) -> None:
        self._serve, self._publish = serve, publish
        self._as_translator = as_translator

    @staticmethod
    def lends_microscope(settings: Mapping[str, object]) -> bool:
        """Return whether these settings make this experiment the microscope of a published scheduler."""
        return settings.get("as_translator") is True

    def run_process(self, context: ProcessContext) -> int:
        """Run until the experiment ends or the parent is gone."""
        port = _PeersPort(context, self._serve, self._publish, as_translator=self._as_translator)
        context.when_stopping(lambda: port.wake_up(ParentGone()))
        try:
            while True:
                arrived = port.poll(port.due_in_s())
                with context.activity.step():
                    if any(isinstance(one, ParentGone) for one in arrived):
                        return ExitCode.ORPHAN
                    port.publish_due()
                    if port.is_over():
                        return ExitCode.ENDED
        finally:
            port.close()


class _PeerClient:
    """One client of the afspm scheduler, for one peer; with `as_translator`, for all peers.

    Attributes:
        asked: unanswered requests, by id: the peer's identity, the request number, and the frames sent.
        admitted: whether the scheduler has accepted this name; until then, a failure concerns the name itself.
        leaves: whether the peer has disconnected before its last request was answered.
    """

    def __init__(self, bridge: _PeersPort, name: str) -> None:
        self._bridge = bridge
        # closed when the peer goes: the scheduler notices a client's end by its connection
        self.network = Network.from_launch(bridge.launch.name, bridge.launch.keys)
        address = bridge.launch.sockets.control
        if address is None:
            raise ConfigError("there is no scheduler to ask", where=bridge.launch.name, hint="control = address")
        self.link = ControlClient(self.network, name, address, bridge.warnings)
        self.name = name
        self.asked: dict[str, tuple[bytes, int, list[list[bytes]]]] = {}
        self.admitted = self.leaves = False

    def ask(self, identity: bytes, frames: list[bytes], *, takes_control: bool) -> None:
        sent: list[list[bytes]] = []
        if takes_control:
            # refused while another client is in control; then the command is refused, too, with the reason
            control_id = self._bridge.next_id(self.name)
            sent.append([bytes([ControlRequest.REQUEST_CTRL]), _NO_PROBLEM, control_id.encode()])
        request_id = self._bridge.next_id(self.name)
        sent.append([frames[0], *(frames[1:2] or [b""]), request_id.encode()])
        self.asked[request_id] = identity, frames[0][0], sent
        for request in sent:
            self.link.send(request)

    def receive(self) -> list[Incoming]:
        for incoming in self.link.receive():
            if isinstance(incoming, ReplyReceived) and (asked := self.asked.pop(incoming.response.id, None)):
                self._bridge.answer(self, asked[0], asked[1], incoming.response)
        return []

    def follow(self) -> list[Incoming]:
        for incoming in self.link.follow():
            if isinstance(incoming, ControlConnected):
                for _, _, sent in self.asked.values():
                    for request in sent:
                        self.link.send(request)
        return []


class _PeersPort(BasePort[Incoming]):
    """All sockets of the process, in one poller."""

    def __init__(self, context: ProcessContext, serve: str, publish: str, *, as_translator: bool) -> None:
        launch = context.launch
        super().__init__(Network.from_launch(launch.name, launch.keys), context.clock, None)
        self.launch: Launch = launch
        self.warnings = RateLimitedLog(logging.getLogger("afspm.transport"), context.clock)
        self._session = context.session
        self._as_translator = as_translator
        self._numbers = itertools.count(1)
        self._clients: dict[bytes, _PeerClient] = {}
        self._identities: dict[int, bytes] = {}  # by the descriptor of a connection
        self._ends_s = math.inf
        self._outside = version_1.outside(launch)
        self._router = self._outside.socket(zmq.ROUTER)
        self._router.setsockopt(zmq.ROUTER_HANDOVER, 1)  # a name belongs to its newest connection
        self._monitor = Monitor(self._outside, self._router, ACCEPTED | DISCONNECTED)
        self._outside.bind(self._router, serve)
        self._outlet = _Outlet(self._outside, publish, self._published, context.clock, self.warnings)
        self._poller.register(self._router, self._requests)
        self._poller.register(self._monitor.socket, self._follow)
        self._poller.register(self._outlet.socket, self._subscriptions)
        self._listened: list[str] = []
        self._listen(version_1.TOPICS)

    def next_id(self, name: str) -> str:
        """Return an unused id for a request under a name."""
        return f"{name}/{self._session}/{next(self._numbers)}"

    def due_in_s(self) -> float | None:
        """Return the longest time to wait for messages, in s; None: no limit."""
        due_s = min(self._outlet.due_s, self._ends_s)
        return None if due_s == math.inf else due_s - self._clock.monotonic_s()

    def is_over(self) -> bool:
        """Return whether the experiment has ended, and the time for last answers has passed."""
        return self._clock.monotonic_s() >= self._ends_s

    def publish_due(self) -> None:
        """Send the replay to late joiners if due, then publish due packets."""
        self._outlet.publish_due()

    def answer(self, client: _PeerClient, identity: bytes, asked: int, response: Response) -> None:
        """Answer a peer; discard the client if the peer has left and all its requests are answered."""
        is_refused = response.code == ControlResponse.FAILURE and not client.admitted
        client.admitted = client.admitted or not is_refused
        self._reply(identity, version_1.answer_frames(asked, response, reason=is_refused))
        if client.leaves and not client.asked:
            self._leave(client)

    def close(self) -> None:
        for client in {id(one): one for one in self._clients.values()}.values():
            client.network.close()
        super().close()
        self._outside.close()

    # --- from outside ---

    def _requests(self) -> list[Incoming]:
        while frames := receive_frames(self._router):
            # drained after the message was received, so that an earlier connection of this descriptor is forgotten
            gone = self._changes()
            identity, content = frames[0].bytes, [frame.bytes for frame in frames[1:]]
            if content[:1] != [b""]:
                self.warnings.warning("dropped a request of a peer: no empty frame before it")
                continue
            descriptor = int(frames[0].get(zmq.SRCFD))
            self._identities[descriptor] = identity
            self._request(identity, content[1:])
            if descriptor in gone:
                self._disconnected(descriptor)
        return []

    def _request(self, identity: bytes, frames: list[bytes]) -> None:
        if not 1 <= len(frames) <= 2 or len(frames[0]) != 1 or not version_1.has_request(frames[0][0]):
            self._reply(identity, [bytes([ControlResponse.CMD_NOT_SUPPORTED])])
            return
        number = frames[0][0]
        if not self._as_translator and identity.startswith(b"\0"):
            self._reply(identity, [bytes([ControlResponse.FAILURE]), b"", _NAMELESS])
            return
        if number in _PROBLEM_REQUESTS and frames[1:] == [_NO_PROBLEM]:  # a success in version 1
            self._reply(identity, [bytes([ControlResponse.SUCCESS])])
            return
        if self._as_translator and ControlRequest.REQUEST_CTRL <= number <= ControlRequest.END_EXPERIMENT:
            self._reply(identity, [bytes([ControlResponse.CMD_NOT_SUPPORTED])])
            return
        client = self._client(identity)
        is_command = number != ControlRequest.ACTION_SUPPORT
        client.ask(identity, frames, takes_control=self._as_translator and is_command)

    def _client(self, identity: bytes) -> _PeerClient:
        key = b"" if self._as_translator else identity
        client = self._clients.get(key)
        if client is not None:
            client.leaves = False  # the peer is back
        else:
            # a client for each peer, so that the scheduler arbitrates control between them
            client = self._clients[key] = _PeerClient(self, self._name_inside(identity))
            self._poller.register(client.link.socket, client.receive)
            self._poller.register(client.link.monitor.socket, client.follow)
        return client

    def _name_inside(self, identity: bytes) -> str:
        # with keys, this process acts for the peer as for a person
        if self._as_translator:
            return self.launch.name
        name = identity.decode("utf-8", "replace")
        return name if self._network.keys is None else f"{self.launch.name}{PERSON}{name}"

    def _reply(self, identity: bytes, frames: Sequence[bytes]) -> None:
        send_frames(self._router, [identity, b"", *frames])

    def _follow(self) -> list[Incoming]:
        self._changes()
        return []

    def _changes(self) -> set[int]:
        # returns the descriptors of connections that were lost
        gone: set[int] = set()
        for kind, descriptor in self._monitor.drain():
            self._disconnected(descriptor)
            (gone.discard if kind == ACCEPTED else gone.add)(descriptor)
        return gone

    def _disconnected(self, descriptor: int) -> None:
        identity = self._identities.pop(descriptor, None)
        client = None if identity is None or self._as_translator else self._clients.get(identity)
        if client is None or identity in self._identities.values():
            return  # the peer has a newer connection
        if client.asked:
            client.leaves = True  # the last request is still carried out
        else:
            self._leave(client)

    def _leave(self, client: _PeerClient) -> None:
        for identity in [identity for identity, one in self._clients.items() if one is client]:
            del self._clients[identity]
        self._poller.forget(client.link.socket)
        self._poller.forget(client.link.monitor.socket)
        client.network.close()

    def _subscriptions(self) -> list[Incoming]:
        for prefix in self._outlet.subscriptions():
            # a peer that subscribes by name also gets messages unknown to version 1
            if prefix == wire.KILL.decode() or prefix.startswith(tuple(self._listened)):
                continue
            if len(self._listened) < MOST_EXTRA:
                self._listen([prefix])
            else:
                self.warnings.warning(f"a subscription to {prefix!r} is one too many")
        return []

    # --- from inside ---

    def _listen(self, prefixes: Sequence[str]) -> None:
        self._listened += prefixes
        for address in self.launch.sockets.subscribe[:1]:
            subscriber = Subscriber(self._network, self.launch.name, address, prefixes, self.warnings)
            self._poller.register(subscriber.socket, _Receiver(self, subscriber).receive)
            self._poller.register(subscriber.monitor.socket, subscriber.follow)

    def take(self, incoming: Incoming) -> None:
        """Process a packet from the afspm scheduler, or the end of the experiment."""
        match incoming:
            case PacketReceived(packet, _):
                self._take_packet(packet)
            case Killed():
                self._outlet.end()
                self._ends_s = min(self._ends_s, self._clock.monotonic_s() + LINGER_S)

    def _take_packet(self, packet: Packet) -> None:
        try:
            message = wire.message_of(packet.envelope)
            state: ScopeState | None = None
            if message == SCOPE_STATE.name:
                state = wire.decode(message, packet.payload).state
            elif message == CONTROL_STATE.name:
                if self._as_translator:
                    return  # the published scheduler publishes a control state of its own
                packet = self._with_names_outside(packet)
        except WireError as error:
            self.warnings.warning(f"dropped a packet of the scheduler: {error}")
            return
        envelope = message if self._as_translator else packet.envelope
        self._outlet.pacing.put(Packet(envelope, packet.payload, packet.time_ns), message, state)

    def _with_names_outside(self, packet: Packet) -> Packet:
        # a peer compares the holder of control with its own name
        prefix = f"{self.launch.name}{PERSON}"
        control = wire.decode(CONTROL_STATE.name, packet.payload)
        if control.holder is None or not control.holder.startswith(prefix):
            return packet
        payload = wire.encode(replace(control, holder=control.holder.removeprefix(prefix)))[1]
        return Packet(packet.envelope, payload, packet.time_ns)


class _Outlet:
    """Publisher of packets to the peers: first a replay to late joiners, then new packets at a limited pace.

    Attributes:
        pacing: the queue of packets to publish.
    """

    def __init__(
        self, outside: Network, address: str, history: PublishedHistory, clock: Clock, warnings: RateLimitedLog
    ) -> None:
        self.pacing = Pacing()
        self._history, self._clock, self._warnings = history, clock, warnings
        self._joined: set[str] = set()  # prefixes of late joiners that wait for a replay
        self._replay_s = math.inf
        self.socket = outside.socket(zmq.XPUB)
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        outside.bind(self.socket, address)

    @property
    def due_s(self) -> float:
        """The time of the next publication; infinity without waiting packets or replay."""
        return min(self.pacing.due_s, self._replay_s)

    def subscriptions(self) -> list[str]:
        """Process new subscriptions; return their prefixes."""
        meant: list[str] = []
        while frames := receive_frames(self.socket):
            kind, subscription = frames[0].bytes[:1], frames[0].bytes[1:]
            if kind != b"\1":
                continue  # an ended subscription: the SUB socket itself drops the packets
            try:
                prefixes = version_1.topics_meant(subscription.decode())
            except UnicodeDecodeError:
                self._warnings.warning("dropped a subscription that is no text")
                continue
            for prefix in prefixes:
                # XPUB_MANUAL: the subscription applies to the peer whose message was received last
                self.socket.setsockopt(zmq.SUBSCRIBE, prefix.encode())
            meant += prefixes
        if meant:
            self._joined.update(meant)
            self._replay_s = self._clock.monotonic_s() + SETTLED_S
            self.pacing.hold(self._replay_s)
        return meant

    def publish_due(self) -> None:
        """Send the replay to late joiners if due, then publish due packets."""
        now_s = self._clock.monotonic_s()
        if now_s >= self._replay_s:
            prefixes, self._joined, self._replay_s = tuple(self._joined), set(), math.inf
            # like the published cache, the last packet of each envelope: a peer that asserts one packet fails at two
            for packet in self._history.last(prefixes):
                self._send(packet)
        for packet in self.pacing.take(now_s):
            self._publish(packet)

    def end(self) -> None:
        """Publish all waiting packets, then the end of the experiment."""
        for packet in self.pacing.take_all():
            self._publish(packet)
        self.socket.send(wire.KILL)

    def _publish(self, packet: Packet) -> None:
        self._send(self._history.stamp(packet.envelope, packet.payload, packet.time_ns))

    def _send(self, packet: Packet) -> None:
        send_packet(self.socket, packet, None if packet.time_ns is None else wire.encode_time(packet.time_ns))


class _Receiver:
    """Adapter that passes messages of one subscriber to the bridge."""

    def __init__(self, bridge: _PeersPort, subscriber: Subscriber) -> None:
        self._bridge, self._subscriber = bridge, subscriber

    def receive(self) -> list[Incoming]:
        for incoming in self._subscriber.receive():
            self._bridge.take(incoming)
        return []
