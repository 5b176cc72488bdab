"""Frames to and from sockets, without copying what is large."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import zmq
from zmq.backend import Socket as _Library
from zmq.backend import zmq_poll

if TYPE_CHECKING:
    Socket = zmq.Socket[bytes]

# below this a copy is cheaper than keeping track of the original
_LARGE = 32 * 1024


# The library's own methods, without the checks and the enumerations of the classes above them: those take longer than
# the sending and receiving itself.
_send: Any = _Library.send
_receive: Any = _Library.recv
_NOBLOCK, _SNDMORE, _POLLIN = int(zmq.NOBLOCK), int(zmq.SNDMORE), int(zmq.POLLIN)
_SRCFD, _NOBLOCK_MORE = int(zmq.SRCFD), int(zmq.NOBLOCK | zmq.SNDMORE)
# (the argument `copy`: a frame costs less than bytes, since it knows whether more frames follow)
_AS_FRAME = False


def readable(socket: Socket) -> bool:
    """Whether a message can be received at once."""
    # to ask for the option EVENTS takes longer: the library first makes an enumeration of its number
    return bool(zmq_poll([(socket, _POLLIN)], 0))


def receive(socket: Socket) -> list[bytes | memoryview]:
    """The contents of the frames of one whole message; empty if there is none.

    What is large is a view of the library's buffer, which it keeps alive.
    """
    contents: list[bytes | memoryview] = []
    more = True
    try:
        while more:
            frame: Any = _receive(socket, _NOBLOCK, _AS_FRAME)
            more = frame.more
            contents.append(frame.bytes if len(frame) < _LARGE else memoryview(frame).toreadonly())
    except zmq.Again:
        pass  # before the first frame: a message comes whole
    return contents


def receive_small(socket: Socket) -> tuple[zmq.Frame | None, list[bytes]]:
    """One whole message whose frames are small: the first, which knows the connection, and the contents of all."""
    try:
        first = frame = _receive(socket, _NOBLOCK, _AS_FRAME)
    except zmq.Again:
        return None, []
    contents = [frame.bytes]
    while frame.more:
        frame = _receive(socket, _NOBLOCK, _AS_FRAME)
        contents.append(frame.bytes)
    return first, contents


def send(socket: Socket, frames: list[bytes]) -> bool:
    """Send one whole, small message, which uses up the list; False if nobody is there to take it. Never blocks."""
    last = frames.pop()
    try:
        for frame in frames:
            _send(socket, frame, _NOBLOCK_MORE)
        _send(socket, last, _NOBLOCK)
    except zmq.Again:
        return False
    return True


def send_packet(socket: Socket, head: Sequence[bytes], payload: bytes | memoryview, tail: bytes | None) -> None:
    """Send a message with a payload, which if it was received goes out from the buffer that it came in."""
    for frame in head:
        _send(socket, frame, _SNDMORE)
    flags = 0 if tail is None else _SNDMORE
    if isinstance(payload, memoryview):
        origin = payload.obj
        if isinstance(origin, zmq.Frame) and len(origin) == payload.nbytes:
            _send(socket, origin, flags, copy=False)
        else:
            # somebody else's buffer may change after we return
            _send(socket, payload.tobytes(), flags)
    else:
        _send(socket, payload, flags, copy=len(payload) < _LARGE)
    if tail is not None:
        _send(socket, tail, 0)


def descriptor_of(frame: zmq.Frame) -> int | None:
    """The descriptor of the connection that a message came by; None: a peer of a protocol older than ZMTP 3."""
    try:
        return int(frame.get(_SRCFD))
    except zmq.ZMQError:
        return None


def property_of(frame: zmq.Frame, name: str) -> str | None:
    """What is known of the peer, e.g. "Socket-Type"; None if it is not."""
    try:
        value = frame.get(name)
    except zmq.ZMQError:
        return None
    return value if isinstance(value, str) and value else None


def user_of(frame: zmq.Frame) -> str | None:
    """Whose key the connection was made with; None without keys."""
    return property_of(frame, "User-Id")
