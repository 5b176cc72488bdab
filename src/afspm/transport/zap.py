"""Who is let in: the handler of ZeroMQ's authentication protocol (ZAP, RFC 27) for CURVE keys."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

import zmq
from zmq.utils import z85

from afspm.transport.wakeup import WakeUp

DOMAIN = b"afspm"
_ADDRESS = "inproc://zeromq.zap.01"


class Authenticator:
    """Answers, in a thread of its own, whether the owner of a key may connect, and what the owner's name is.

    The name then is the "User-Id" of each message that comes by the connection.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], peers: Mapping[bytes, str]) -> None:
        self._names = {z85.decode(key): name.encode() for key, name in peers.items()}
        self._stop: WakeUp[None] = WakeUp()
        # bound before anything else is: a connection that finds no handler would be refused for ever
        self._socket: zmq.Socket[bytes] = context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(_ADDRESS)
        self._thread = threading.Thread(target=self._serve, name="authenticator", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._stop.fileno(), zmq.POLLIN)
        while self._stop.fileno() not in (ready := dict(poller.poll())):
            if self._socket in ready:
                self._socket.send_multipart(self.answer(self._socket.recv_multipart()))
        self._socket.close()

    def answer(self, request: Sequence[bytes]) -> list[bytes]:
        """The reply to one request of the protocol: 200 and the name, or 400 and no name."""
        version, request_id, domain, _address, _identity, mechanism, *credentials = [*request, *[b""] * 7][:7]
        known = version == b"1.0" and domain == DOMAIN and mechanism == b"CURVE" and len(request) == 7
        name = self._names.get(credentials[0]) if known else None
        if name is None:
            return [b"1.0", request_id, b"400", b"this key is not among the public keys", b"", b""]
        return [b"1.0", request_id, b"200", b"OK", name, b""]

    def close(self) -> None:
        """Stop the thread, before the context is closed."""
        self._stop.post()
        self._thread.join()
        self._stop.close()
