"""Frames to and from sockets, without copying what is large."""

from __future__ import annotations

from typing import TYPE_CHECKING

import zmq

if TYPE_CHECKING:
    Socket = zmq.Socket[bytes]

# below this a copy is cheaper than keeping track of the original
_LARGE = 32 * 1024


def readable(socket: Socket) -> bool:
    """Whether a message can be received at once."""
    return bool(int(socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN)


def receive(socket: Socket) -> list[zmq.Frame]:
    """One whole message as it lies in the library's buffers. Raises zmq.Again if there is none."""
    frame = socket.recv(zmq.NOBLOCK, copy=False)
    frames = [frame]
    while frame.more:
        frame = socket.recv(zmq.NOBLOCK, copy=False)
        frames.append(frame)
    return frames


def payload_of(frame: zmq.Frame) -> bytes | memoryview:
    """The contents: a view of the library's buffer if it is large, which it keeps alive."""
    return frame.bytes if len(frame) < _LARGE else memoryview(frame.buffer).toreadonly()


def send_payload(socket: Socket, payload: bytes | memoryview, flags: int) -> None:
    """Send one frame; what was received goes out from the buffer that it came in."""
    if isinstance(payload, memoryview):
        origin = payload.obj
        if isinstance(origin, zmq.Frame) and len(origin) == payload.nbytes:
            socket.send(origin, flags, copy=False)
        else:
            # somebody else's buffer may change after we return
            socket.send(payload.tobytes(), flags)
    else:
        socket.send(payload, flags, copy=len(payload) < _LARGE)


def user_of(frame: zmq.Frame) -> str | None:
    """Whose key the connection was made with; None without keys."""
    try:
        user = frame.get("User-Id")
    except zmq.ZMQError:
        return None
    return user if isinstance(user, str) and user else None
