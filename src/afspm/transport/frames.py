"""Messages to and from sockets, each whole, without copying what is large."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from afspm.model import Packet
from afspm.wire import Buffer

Socket = zmq.Socket[bytes]

# as numbers: to combine the library's flags, or to ask for an option, takes longer than to send or to receive
_NOW, _MORE = int(zmq.NOBLOCK), int(zmq.SNDMORE)
_LARGE_BYTES = 32 * 1024
"""Below this a copy is cheaper than keeping the received buffer."""


def receive_frames(socket: Socket) -> list[zmq.Frame]:
    """Return the frames of the next message; empty if there is none. Never blocks."""
    try:
        frames = [socket.recv(_NOW, copy=False)]
    except zmq.Again:
        return []
    while frames[-1].more:
        frames.append(socket.recv(_NOW, copy=False))
    return frames


def contents(frames: Sequence[zmq.Frame]) -> list[Buffer]:
    """Return what frames hold: what is large as a view of the received buffer, which the view keeps alive."""
    return [frame.bytes if len(frame) < _LARGE_BYTES else memoryview(frame.buffer).toreadonly() for frame in frames]


def send_frames(socket: Socket, frames: Sequence[bytes]) -> bool:
    """Send a whole message; False if nobody is there to take it. Never blocks.

    Raises:
        zmq.ZMQError: it is addressed to a peer that is gone, where the socket tells.
    """
    try:
        for frame in frames[:-1]:
            socket.send(frame, _NOW | _MORE)
        socket.send(frames[-1], _NOW)
    except zmq.Again:
        return False
    return True


def send_packet(socket: Socket, packet: Packet, stamp: bytes | None, *, topic: bytes | None = None) -> None:
    """Publish a packet; a payload that was received goes out from the buffer that it came in.

    Args:
        stamp: the third frame; None: the packet has two.
        topic: put before the envelope.
    """
    payload: Buffer | zmq.Frame = packet.payload
    if isinstance(payload, memoryview):
        origin = payload.obj
        # any other buffer may change after we return
        payload = origin if isinstance(origin, zmq.Frame) and len(origin) == payload.nbytes else payload.tobytes()
    if topic is not None:
        socket.send(topic, _MORE)
    socket.send(packet.envelope.encode(), _MORE)
    socket.send(payload, 0 if stamp is None else _MORE, copy=False)  # what is small is copied all the same
    if stamp is not None:
        socket.send(stamp)


def descriptor_of(frame: zmq.Frame) -> int:
    """Return the number of the connection that a message came by; -1 for peers older than ZMTP 3.

    For REQ sockets and plain subscribers alone, see `router` and `publisher`: the library calls it obsolete.
    """
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return -1


def property_of(frame: zmq.Frame, name: str) -> str | None:
    """Return what is known of the peer, e.g. "Socket-Type"; None if it is not."""
    try:
        value = frame.get(name)
    except zmq.ZMQError:
        return None
    return value if isinstance(value, str) and value else None


def user_of(frame: zmq.Frame) -> str | None:
    """Return whose key the connection was made with; None without keys."""
    return property_of(frame, "User-Id")
