"""A process's access to ZeroMQ: the context, the options of all sockets, and the check of peers."""

from __future__ import annotations

import contextlib
import ipaddress
import itertools
import socket
import struct
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import zmq

from afspm.basics.errors import ConfigError, TransportError
from afspm.transport.port import CUT_OFF_SHOWS_WITHIN_S

if TYPE_CHECKING:
    from afspm.transport.keys import Keys

MAX_PACKET_BYTES = 256 * 1024 * 1024
"""Longest frame of a published packet: twice a scan of 4096² pixels in one channel."""
MAX_REQUEST_BYTES = 1024 * 1024
"""Longest frame of a request or response."""
HAS_PRIVATE_SOCKETS = sys.platform != "win32" and zmq.has("ipc")
"""Whether the system has unix sockets, and modes of folders to protect them."""
QUEUE_LENGTH = 4000
"""Limit of waiting messages for one peer; a publisher drops further messages."""

_LINGER_MS = 200  # for the last messages of a socket that is closed
_ALIVE_CHECK_MS = 2_000
_ALIVE_TIMEOUT_MS = round(CUT_OFF_SHOWS_WITHIN_S * 1e3) - _ALIVE_CHECK_MS
# libzmq 4.3.5 aborts the process (`Assertion failed: !_io_error`) if it sends or answers a heartbeat of ZMTP on a
# connection that was lost while its receive queue was full. So the receive queues of sockets with heartbeats, and of
# their peers, are unlimited.
# When a subscriber stands still, its heartbeats stop, and its publisher drops the packets that wait for it
# (`HEARTBEAT_TTL`); this works on unix sockets too, where no option of TCP helps. A publisher sends no heartbeats:
# behind unsent packets they would never leave.
# For libzmq only a whole frame is a sign of life, not its bytes: behind 33 MB on a slow link, the answer to a heartbeat
# would come too late, and the frame would be sent again from its first byte, without end. So a subscriber awaits no
# answers. On a cut link its heartbeats are not acknowledged, which ends its connection (`LinkTimes.stalled`; on macOS
# keepalive ends it, by the time since the last byte). Requests and answers are short: 1 MB takes 8 s at 131 kB/s.
_WITH_HEARTBEATS = frozenset({zmq.ROUTER, zmq.DEALER, zmq.XSUB})
_UNLIMITED = frozenset({*_WITH_HEARTBEATS, zmq.XPUB, zmq.SUB})
_KEEPALIVE_S, _KEEPALIVE_TRIES = 2, 3
_WINDOWS_MAXRT = 5  # from ws2ipdef.h; Python's socket module lacks it
_RECONNECT_MS, _RECONNECT_MAX_MS = 20, 200  # the first wait before a new attempt, and the longest
_HANDSHAKE_MS = 5_000  # for greeting and keys of a new connection, which is closed then
_OPTIONS = (
    (zmq.LINGER, _LINGER_MS),
    (zmq.SNDHWM, QUEUE_LENGTH),
    (zmq.TCP_KEEPALIVE, 1),
    (zmq.TCP_KEEPALIVE_IDLE, _KEEPALIVE_S),
    (zmq.TCP_KEEPALIVE_INTVL, _KEEPALIVE_S),
    (zmq.TCP_KEEPALIVE_CNT, _KEEPALIVE_TRIES),
    (zmq.RECONNECT_IVL, _RECONNECT_MS),
    (zmq.RECONNECT_IVL_MAX, _RECONNECT_MAX_MS),
    (zmq.HANDSHAKE_IVL, _HANDSHAKE_MS),
)


class LinkTimes(NamedTuple):
    """Times of the links of a `Network`, in ms; a time of 0 turns the heartbeats, or what they wait for, off."""

    # heartbeats of ZMTP: a peer that is frozen or cut off is noticed within seconds, not after hours as by TCP
    check: int = _ALIVE_CHECK_MS
    alive: int = _ALIVE_TIMEOUT_MS
    answered: int = _ALIVE_TIMEOUT_MS
    # A TCP peer that reads nothing is disconnected after this time, and its waiting packets are dropped. After a
    # reconnection it requests them. (Linux and Windows.)
    stalled: int = 5_000
    # Systems repeat an attempt to connect after 1, 3, 7, 15, 31 s …: an attempt begun while the link was down would
    # notice its return only after half a minute. So attempts are ended after this time, and begun again.
    connect: int = 2_000


@cache
def _can_end_stalled() -> bool:
    # where the system does not know TCP_MAXRT (Wine), libzmq with this option never connects
    if sys.platform != "win32":
        return True
    with socket.socket() as probe:
        try:
            probe.setsockopt(socket.IPPROTO_TCP, _WINDOWS_MAXRT, 1)
        except OSError:
            return False
    return True


def _heartbeats(kind: int, times: LinkTimes) -> tuple[tuple[int, int], ...]:
    if kind not in _WITH_HEARTBEATS:
        return ()
    # without TCP_MAXRT (Wine) nothing else ends the connection of a subscriber that is cut off
    awaits_answers = kind != zmq.XSUB or not _can_end_stalled()
    return (
        (zmq.HEARTBEAT_IVL, times.check),
        (zmq.HEARTBEAT_TIMEOUT, times.answered if awaits_answers else 0),
        (zmq.HEARTBEAT_TTL, times.alive),
    )


class Network:
    """A maker of sockets, limited to this computer unless `keys.everywhere` or `insecure` is set.

    Args:
        keys: keys of this process. Connections with keys are encrypted, and the owners of their keys are known.
            `Keys.everywhere` and `Keys.guards` choose these connections.
        insecure: whether to bind and connect to other computers without keys. Anyone there can then move the tip.
        times: times after which links are checked, ended and made again.
    """

    def __init__(self, keys: Keys | None = None, *, insecure: bool = False, times: LinkTimes | None = None) -> None:
        self.keys = keys
        self._insecure, self._times = insecure, times or LinkTimes()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._sockets: list[zmq.Socket[bytes]] = []
        self._authenticator = None
        if keys is not None and (keys.everywhere or keys.guards):
            from afspm.transport.keys import Authenticator

            self._authenticator = Authenticator(self._context, keys)

    @classmethod
    def from_launch(cls, name: str, entries: Mapping[str, object] | None) -> Network:
        """Return the network for the launch line of the process `name`.

        Args:
            entries: see `keys.from_launch`, or `{"insecure": "true"}`; None: this computer only, without keys.

        Raises:
            ConfigError: a key is missing or can't be used.
        """
        if not entries:
            return cls()
        from afspm.transport.keys import from_launch

        return cls(from_launch(name, entries), insecure=str(entries.get("insecure", "")).lower() == "true")

    @classmethod
    def connecting(cls, name: str, entries: Mapping[str, object] | None) -> Network:
        """Return a network for this computer only, with plain connections to servers without keys."""
        from afspm.transport.keys import from_launch

        own = from_launch(name, entries)
        return cls(None if own is None else replace(own, everywhere=False, guards=False))

    def socket(self, kind: int, *, max_bytes: int = MAX_REQUEST_BYTES) -> zmq.Socket[bytes]:
        """Return a socket with afspm's limits; a frame over `max_bytes` ends its connection."""
        socket = self._context.socket(kind)
        self._sockets.append(socket)  # a reference, else the garbage collector may close the socket at any time
        options = (*_OPTIONS, (zmq.CONNECT_TIMEOUT, self._times.connect), *_heartbeats(kind, self._times))
        if _can_end_stalled():
            options += ((zmq.TCP_MAXRT, self._times.stalled),)
        for option, value in (
            *options,
            (zmq.RCVHWM, 0 if kind in _UNLIMITED else QUEUE_LENGTH),
            (zmq.MAXMSGSIZE, max_bytes),
        ):
            socket.setsockopt(option, value)
        return socket

    def bind(self, socket: zmq.Socket[bytes], address: str, *, requests: bool = False) -> str:
        """Bind a socket, and return its address, with the chosen port if `address` has port 0.

        Args:
            requests: whether peers send requests to this socket, and so must prove their names.

        Raises:
            TransportError: the address is taken, malformed, or not of this computer.
            ConfigError: other computers could connect, and there are no keys.
        """
        self._guard(address)
        if self.keys is not None and self.keys.binds_encrypted(address, requests=requests):
            socket.setsockopt(zmq.CURVE_SERVER, 1)
            socket.setsockopt(zmq.CURVE_SECRETKEY, self.keys.secret)
            socket.setsockopt(zmq.ZAP_DOMAIN, b"afspm")
        _allow_ipv6(socket, address)
        try:
            socket.bind(_bindable(address))
        except zmq.ZMQError as error:
            raise TransportError(
                f"can't bind: {zmq.strerror(error.errno or 0)}", where=address, hint=_bind_hint(error)
            ) from error
        return socket.getsockopt_string(zmq.LAST_ENDPOINT).rstrip("\0")

    def connect(self, socket: zmq.Socket[bytes], address: str) -> None:
        """Connect a socket, and connect again after each loss of the connection.

        Raises:
            TransportError: the address is malformed.
            ConfigError: the address belongs to another computer, and there are no keys; or the public key of the
                process at this address is unknown.
        """
        self._guard(address)
        if self.keys is not None and (server_key := self.keys.server_key(address)) is not None:
            socket.setsockopt(zmq.CURVE_SERVERKEY, server_key)
            socket.setsockopt(zmq.CURVE_PUBLICKEY, self.keys.public)
            socket.setsockopt(zmq.CURVE_SECRETKEY, self.keys.secret)
        _allow_ipv6(socket, address)
        try:
            socket.connect(address)
        except zmq.ZMQError as error:
            raise TransportError(f"can't connect: {error}", where=address) from error

    def close(self) -> None:
        """Close all sockets once all sent messages have left, within a fraction of a second."""
        if self._context.closed:
            return
        if self._authenticator is not None:
            self._authenticator.close()
        self._context.destroy(linger=_LINGER_MS)

    def _guard(self, address: str) -> None:
        everywhere = self.keys is not None and self.keys.everywhere
        if not everywhere and not self._insecure and not is_local(address):
            raise ConfigError(
                "other computers can reach this address, and the experiment has no keys",
                where=address,
                hint="make keys with `afspm keys`, or use 127.0.0.1; "
                "insecure = true lets anyone on the network move the tip",
            )


def is_local(address: str) -> bool:
    """Return whether only processes of this computer can use `address`."""
    scheme, _, rest = address.partition("://")
    if scheme in ("ipc", "inproc"):
        return True
    if scheme != "tcp":
        return False
    # "source;destination" connects from a given address; both must be local
    for end in rest.split(";"):
        host = end.rpartition(":")[0].strip("[]")
        if host == "localhost":
            continue
        try:
            if not ipaddress.ip_address(host).is_loopback:
                return False
        except ValueError:
            return False
    return True


def _allow_ipv6(socket: zmq.Socket[bytes], address: str) -> None:
    # only where an address asks for it: with this option libzmq resolves names to addresses of IPv6 first
    if "[" in address:
        socket.setsockopt(zmq.IPV6, 1)


def _bindable(address: str) -> str:
    # a host name is bound at all addresses of this computer: it may lead to another address tomorrow, and on the
    # computer itself often leads to a loopback one
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    if not address.startswith("tcp://") or not _is_name(host):
        return address
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None, socket.AF_INET)}
    except OSError as error:
        raise TransportError(f"can't bind: this computer does not know the name {host!r}", where=address) from error
    if not any(map(_is_ours, found)):
        what = f"can't bind: {host!r} is another computer: {', '.join(sorted(found))}"
        raise TransportError(what, where=address, hint="is this process meant to run there (--only)?")
    return f"tcp://*:{port}"


def _is_name(host: str) -> bool:
    # not an address, a wildcard, or a network interface
    interfaces = {name for _, name in socket.if_nameindex()} | {"*", "localhost"}
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(host.strip("[]"))
        return False
    return host not in interfaces


def _is_ours(ip: str) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind((ip, 0))
        except OSError:
            return False
    return True


def _bind_hint(error: zmq.ZMQError) -> str:
    if error.errno == zmq.EADDRINUSE:
        return "another program uses this port: end an earlier experiment that still runs, or change the port"
    if error.errno == zmq.EADDRNOTAVAIL:
        return "this computer does not have this address: start the process on the computer that has it (--only)"
    return ""


CONNECTED = int(zmq.EVENT_HANDSHAKE_SUCCEEDED)
DISCONNECTED = int(zmq.EVENT_DISCONNECTED)
ACCEPTED = int(zmq.EVENT_ACCEPTED)
KEY_REFUSED = int(zmq.EVENT_HANDSHAKE_FAILED_AUTH)
"""The peer's key is unknown."""
MISMATCHED = int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
"""The peer has no key, or does not know the server's key."""
CUT = int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
"""The connection ended in its handshake. A peer without keys may also hang up before the mismatch is seen."""
REFUSED = KEY_REFUSED | MISMATCHED | CUT
_EVENT = struct.Struct("=hi")
_numbers = itertools.count()


class ConnectionEvent(NamedTuple):
    """A connection event: its `kind` (a constant above), and the descriptor of a DISCONNECTED connection as `value`."""

    kind: int
    value: int


class Monitor:
    """The connection events of one socket, in order.

    The thread that delivers messages also sends these events. So `drain` after a message returns every earlier event.
    """

    def __init__(self, network: Network, socket: zmq.Socket[bytes], events: int) -> None:
        address = f"inproc://monitor-{next(_numbers)}"
        socket.monitor(address, events)
        self.socket = network.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.RCVHWM, 0)
        self.socket.connect(address)

    def drain(self) -> list[ConnectionEvent]:
        """Return all events so far."""
        events: list[ConnectionEvent] = []
        while zmq.zmq_poll([(self.socket, zmq.POLLIN)], 0):
            kind, value = _EVENT.unpack(self.socket.recv_multipart(zmq.NOBLOCK)[0])
            events.append(ConnectionEvent(kind & 0xFFFF, value))
        return events
