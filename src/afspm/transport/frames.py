"""Sending and receiving of whole messages, without copies of large frames."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from afspm.model import Packet
from afspm.wire import Buffer

Socket = zmq.Socket[bytes]

# as plain integers: combining the library's enums takes longer than a send
_NOW, _MORE = int(zmq.NOBLOCK), int(zmq.SNDMORE)
_LARGE_BYTES = 32 * 1024
"""Below this size a copy is cheaper than a reference to the received buffer."""


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
    """Return the contents of frames: large ones as views of the received buffer, which a view keeps alive."""
    return [frame.bytes if len(frame) < _LARGE_BYTES else memoryview(frame.buffer).toreadonly() for frame in frames]


def send_frames(socket: Socket, frames: Sequence[bytes]) -> bool:
    """Send a whole message; return False if no peer can take the message. Never blocks.

    Raises:
        zmq.ZMQError: the addressed peer is gone, on sockets that report it.
    """
    last = len(frames) - 1
    for index, frame in enumerate(frames):
        try:
            socket.send(frame, _NOW if index == last else _NOW | _MORE)
        except zmq.Again:
            # The connection was lost between two frames, and libzmq drops all frames up to the next end of a message.
            # So it gets the rest of this one: otherwise it would drop the next message, and report success.
            if 0 < index < last:
                send_frames(socket, frames[index + 1 :])
            return False
    return True


def send_packet(
    socket: Socket, packet: Packet, stamp: bytes | None, *, topic: bytes | None = None, track: bool = False
) -> zmq.MessageTracker | None:
    """Publish a packet; a received payload is sent from its own buffer. Never blocks.

    Args:
        stamp: the third frame, a serialised time; None: the packet has two frames.
        topic: frame before the envelope, for a replay to one subscriber; None: no such frame.
        track: whether to return a tracker, which is done once the packet has left the queues of all subscribers.

    Raises:
        zmq.Again: the queue of a subscriber is full, and the socket may not drop packets (XPUB_NODROP).
    """
    payload: Buffer | zmq.Frame = packet.payload
    if isinstance(payload, memoryview):
        origin = payload.obj
        # copy any other buffer: it may change while ZeroMQ is still sending it
        payload = origin if isinstance(origin, zmq.Frame) and len(origin) == payload.nbytes else payload.tobytes()
    if topic is not None:
        socket.send(topic, _NOW | _MORE)
    envelope: bytes | zmq.Frame = packet.envelope.encode()
    if track:
        envelope = zmq.Frame(envelope, track=True, copy=False)  # libzmq has no owner to release of a copied frame
    socket.send(envelope, _NOW | _MORE, copy=not track)
    socket.send(payload, _NOW if stamp is None else _NOW | _MORE, copy=False)  # libzmq copies small frames all the same
    if stamp is not None:
        socket.send(stamp, _NOW)
    return envelope.tracker if isinstance(envelope, zmq.Frame) else None


def descriptor_of(frame: zmq.Frame) -> int:
    """Return the file descriptor of a message's connection; -1 for peers older than ZMTP 3.

    Only for REQ sockets, see `router`: the library calls this option obsolete.
    """
    try:
        return int(frame.get(zmq.SRCFD))
    except zmq.ZMQError:
        return -1


def property_of(frame: zmq.Frame, name: str) -> str | None:
    """Return a property of the peer, e.g. "Socket-Type"; None if unknown."""
    try:
        value = frame.get(name)
    except zmq.ZMQError:
        return None
    return value if isinstance(value, str) and value else None


def user_of(frame: zmq.Frame) -> str | None:
    """Return the owner of the connection's key; None without keys."""
    return property_of(frame, "User-Id")
