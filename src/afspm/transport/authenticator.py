"""The handler of ZeroMQ's authentication protocol (ZAP, RFC 27) for CURVE keys."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import zmq
from zmq.utils import z85

from afspm.basics.errors import ConfigError
from afspm.transport.keys import Keys, public_keys
from afspm.transport.polling import WakeUp

DOMAIN = b"afspm"
_ADDRESS = "inproc://zeromq.zap.01"


class Authenticator:
    """Answers, in a thread of its own, whether the owner of a key may connect, and what the owner's name is.

    The name then is the "User-Id" of each message that comes by the connection. A key that is made while the experiment
    runs is let in, too: when an unknown one comes, the folder of keys is read again if it has changed.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], keys: Keys) -> None:
        self._keys = keys
        self._names = {z85.decode(key): name.encode() for key, name in keys.peers.items()}
        self._read_ns: int | None = None
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
        """Return the reply to one request of the protocol: 200 and the name, or 400 and no name."""
        version, request_id, domain, _address, _identity, mechanism, *credentials = [*request, *[b""] * 7][:7]
        known = version == b"1.0" and domain == DOMAIN and mechanism == b"CURVE" and len(request) == 7
        name = self._name_of(credentials[0]) if known else None
        if name is None:
            return [b"1.0", request_id, b"400", b"this key is not among the public keys", b"", b""]
        return [b"1.0", request_id, b"200", b"OK", name, b""]

    def _name_of(self, key: bytes) -> bytes | None:
        if key not in self._names:
            self._read_again()
        return self._names.get(key)

    def _read_again(self) -> None:
        """Read the folder again. No new file gives a known key another name."""
        folder = self._keys.folder
        if folder is None:
            return
        try:
            changed_ns = folder.stat().st_mtime_ns
            if changed_ns == self._read_ns:
                return
            found = {z85.decode(key): name.encode() for key, name in public_keys(folder, self._keys.name).items()}
        except (OSError, ConfigError, ValueError):
            return  # one that is just being written: it is read again when the next peer connects
        self._names, self._read_ns = {**found, **self._names}, changed_ns

    def close(self) -> None:
        """Stop the thread, before the context is closed."""
        self._stop.post()
        self._thread.join()
        self._stop.close()
