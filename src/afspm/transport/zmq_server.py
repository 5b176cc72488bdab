"""A translator's port over ZeroMQ: it answers requests, one at a time, and publishes."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from afspm.basics.clock import Clock
from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.transport.frames import receive_frames, send_frames, user_of
from afspm.transport.network import Network
from afspm.transport.port import RequestReceived, Served, SubscriberJoined
from afspm.transport.zmq_port import BasePort

_WITHOUT_EPOCH = 3  # frames without an epoch: connection, number, empty frame; an epoch stands behind the number


class ZmqServerPort(BasePort[Served]):
    """A translator's port, see `transport.port.ServerPort`.

    The port answers as a REP socket does: with all frames before the empty frame, so that a scheduler can number its
    requests. The socket is a ROUTER, since an answer may also be withheld.

    Args:
        serve: address for requests.
        publish: address to publish on.
        allowed: with keys, the only client whose requests are answered (the scheduler); None: all accepted keys.

    Raises:
        TransportError: an address can't be used.
    """

    def __init__(
        self, network: Network, clock: Clock, *, serve: str, publish: str | None, allowed: str | None = None
    ) -> None:
        super().__init__(network, clock, publish)
        self._allowed = allowed
        self._has_keys = network.keys is not None and network.keys.binds_encrypted(serve, requests=True)
        self._asker: list[bytes] | None = None
        self._waiting: RequestReceived | None = None
        self._waiting_asker: list[bytes] | None = None
        self._socket = network.socket(zmq.ROUTER)
        # The newest connection gets an identity. Without it, a scheduler that reconnects before its old connection
        # times out is ignored, and libzmq never frees the queue of its requests.
        self._socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self._socket.setsockopt(zmq.ROUTER_MANDATORY, 1)  # a send to a peer that is gone fails
        self.serve_address = network.bind(self._socket, serve, requests=True)
        self._poller.register(self._socket, self._request)

    def poll(self, timeout_s: float | None) -> list[Served]:
        # until `reply`, further requests wait in the socket: a readable socket would end every wait at once
        waiting = None
        if self._asker is None and self._waiting is not None:
            waiting, self._waiting, self._asker = self._waiting, None, self._waiting_asker
        if is_busy := self._asker is not None:
            self._poller.pause(self._socket)
        try:
            found = super().poll(timeout_s if waiting is None else 0.0)
            return found if waiting is None else [*found, waiting]
        finally:
            if is_busy:
                self._poller.register(self._socket, self._request)

    def waiting_request(self) -> RequestReceived | None:
        if self._waiting is None:
            # also while another request is being answered: its return path is kept apart
            asker, self._asker = self._asker, None
            self._waiting = next((one for one in self._request() if isinstance(one, RequestReceived)), None)
            self._waiting_asker, self._asker = self._asker, asker
        return self._waiting

    def _serve(self) -> list[Served]:
        return [SubscriberJoined()] if self._publisher is not None and self._publisher.serve() else []

    def _request(self) -> list[Served]:
        while self._asker is None and (frames := receive_frames(self._socket)):
            request = self._accepted(frames)
            if request is not None:
                return [request]
        return []

    def _accepted(self, frames: Sequence[zmq.Frame]) -> RequestReceived | None:
        # None if the message is no request, or was refused here
        parts = [frame.bytes for frame in frames]
        start = parts.index(b"", 1) + 1 if b"" in parts[1:] else len(parts)
        if start == len(parts):
            return None  # without a return path, or a peer that gives its name, as to a scheduler
        self._asker = parts[:start]
        epoch = parts[start - 2] if start > _WITHOUT_EPOCH else b""
        user = user_of(frames[0]) if self._has_keys else None
        if self._allowed is not None and self._has_keys and user != self._allowed:
            self.reply([b"\1", b"", f"only {self._allowed} may send requests to this address, not {user}".encode()])
            return None
        return RequestReceived(parts[start:], user, epoch, parts[0])

    def reply(self, frames: Sequence[bytes] | None) -> None:
        asker, self._asker = self._asker, None
        if asker is not None and frames is not None:
            self._send([*asker, *frames])

    def is_connected(self, connection: bytes) -> bool:
        return self._send([connection, b""])

    def _send(self, frames: list[bytes]) -> bool:
        try:
            return send_frames(self._socket, frames)
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            return False

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None:
        if self._publisher is None:
            raise ConfigError("the process has no address to publish on", hint="publish = address")
        self._publisher.publish(self._published.stamp(envelope, payload, time_ns, keep=keep))

    def kill(self) -> None:
        """Send the signal KILL to all subscribers: the experiment has ended."""
        if self._publisher is not None:
            self._publisher.kill()


def open_server_port(launch: Launch, clock: Clock) -> ZmqServerPort:
    """Open a translator's port.

    Raises:
        TransportError: an address can't be used.
        ConfigError: there is no address for requests.
    """
    if launch.sockets.serve is None:
        raise ConfigError("the translator has no address for requests", where=launch.name, hint="serve = address")
    return ZmqServerPort(
        Network.from_launch(launch.name, launch.keys),
        clock,
        serve=launch.sockets.serve,
        publish=launch.sockets.publish,
        allowed=(launch.keys or {}).get("scheduler") or None,
    )
