"""Bridge between afspm and GXSM: run this file in GXSM's Python console, and leave it running.

The bridge listens on the loopback interface, and passes on only calls of the functions listed below. A client and the
bridge first prove to each other that they know a secret, which is in a file that only this user can read. The secret
itself is never sent, so a program that listens here in place of the bridge learns nothing (`Introduction`). TLS would
need certificates for a connection within one computer; a Unix socket excludes Windows and tunnels from there; a code on
each line protects only against the administrator, who can read the secret anyway. A line that
is neither a proof nor a call ends its connection, so that no page in a browser can command GXSM. Several clients are
served, one call at a time. Set `script-control` to 0 to end the bridge. This file needs only the standard library.
"""

from __future__ import annotations

import base64
import hmac
import json
import os
import secrets
import selectors
import socket
import time
from pathlib import Path

HOST, PORT = "127.0.0.1", globals().get("PORT", 65431)  # if in use: choose another number here and in `address`
SECRET = "~/.afspm/gxsm-bridge-secret"
FOLDER = globals().get("FOLDER", str(Path.cwd()))
WELCOME = "afspm bridge 2"
# waitscan is missing on purpose: a call blocks Gxsm4 until a restart.
METHODS = {
    *("set", "get", "gets", "list_refnames", "list_actions", "action", "rtquery", "y_current"),
    *("startscan", "stopscan", "autosave", "chfname", "moveto_scan_xy"),
    *("get_geometry", "get_dimensions", "get_differentials", "get_slice", "get_probe_event"),
}
LONGEST, LONGEST_PROOF = 10_000, 200  # bytes of a line
LOOK_S, WAIT_S = 0.5, 0.1  # period of checks of script-control, of clients' deadlines
PROVES_S = 2.0  # deadline for the proof, also for a client that keeps sending
TAKES_S = 10.0  # to receive an answer; a client silent for longer may be replaced
MOST_STRANGERS, MOST_CLIENTS = 64, 8
NONCE = 64  # hexadecimal digits
gxsm = globals().get("gxsm")  # defined in the console


def packed(value):  # type: ignore[no-untyped-def]
    """Encode an array for JSON."""
    return {"array": value.dtype.str, "shape": value.shape, "bytes": base64.b64encode(value.tobytes()).decode()}


def secret() -> bytes:
    """Return the secret; create its file at the first run.

    Raises:
        PermissionError: other users can read the file. ValueError: the file is damaged.
    """
    path = Path(SECRET).expanduser()
    path.parent.mkdir(mode=0o700, exist_ok=True)
    if not path.exists():
        # created with its final mode, so that other users can't read the file at any moment
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(secrets.token_hex(32).encode())
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise PermissionError(f"other users can read {path}: chmod 600 {path}")
    found = path.read_bytes().strip()
    if len(found) < 32:
        raise ValueError(f"{path} is damaged: delete it, and run this again")
    return found


def proof(known: bytes, side: str, address: str, client_nonce: str, bridge_nonce: str) -> str:
    """Return the proof that a side ("bridge" or "client") knows the secret, for the nonces of both sides.

    The proof includes the address of the bridge as both ends of the connection see it, so that a program in between,
    which listens at another address, can't pass a proof on.
    """
    facts = "\n".join((WELCOME, side, address, client_nonce, bridge_nonce))
    return hmac.new(known, facts.encode("utf-8", "replace"), "sha256").hexdigest()


class Introduction:
    """The handshake in the first two lines of a connection: both sides prove that they know the secret.

        client: ["challenge", nonce]     bridge: {"value": [nonce, proof]}
        client: ["response", proof]      bridge: {"value": "afspm bridge 2"}

    Attributes:
        is_over: True after the client's proof.
    """

    def __init__(self, known: bytes, address: str) -> None:
        self._known, self._address, self._expected = known, address, ""
        self.is_over = False

    def reply_to(self, line: bytes) -> str:
        """Return the answer to a line; empty to disconnect."""
        return self.reply(parsed(line))

    def reply(self, call) -> str:  # type: ignore[no-untyped-def]
        """Return the answer to a parsed line; empty to disconnect."""
        step, *arguments = call or [""]
        text = arguments[0] if len(arguments) == 1 and isinstance(arguments[0], str) else ""
        if step == "challenge" and len(text) == NONCE and not self._expected:
            nonce = secrets.token_hex(NONCE // 2)
            self._expected = proof(self._known, "client", self._address, text, nonce)
            return json.dumps({"value": [nonce, proof(self._known, "bridge", self._address, text, nonce)]})
        expected = self._expected.encode()
        if step == "response" and expected and hmac.compare_digest(expected, text.encode("utf-8", "replace")):
            self.is_over = True
            return json.dumps({"value": WELCOME})
        return ""


def parsed(line: bytes):  # type: ignore[no-untyped-def]
    """Parse a call in JSON, ["method", arguments…] with texts and numbers; return None for anything else."""
    try:
        call = json.loads(line)
    except (ValueError, RecursionError):
        return None
    is_call = isinstance(call, list) and call and isinstance(call[0], str)
    return call if is_call and all(isinstance(one, (str, int, float)) for one in call) else None


def answer(method, arguments) -> str:  # type: ignore[no-untyped-def]
    """Execute a call; return the value or the error as JSON."""
    try:
        if method == "getcwd":
            return json.dumps({"value": FOLDER})
        if method not in METHODS:
            raise NameError(f"{method} is not a method that the bridge passes on")
        value = getattr(gxsm, method)(*arguments)
        # Gxsm3 returns uninitialised memory from `action`, which must not be touched
        return json.dumps({"value": None if method == "action" else value}, default=packed)
    except Exception as error:  # any error of GXSM goes to the client, and the bridge serves the others
        return json.dumps({"error": f"{type(error).__name__}: {error}"})


def wanted() -> bool:
    """Return True while `script-control` is set, so that the script has to run."""
    return gxsm is not None and gxsm.get("script-control") > 0.5


class Client:
    """A connection of a client. Times are monotonic.

    Attributes:
        until_s: deadline for the proof, later for receiving an answer.
        active_s: time of the last received bytes, at first of the connection.
        is_open: False once the connection has to end.
    """

    def __init__(self, connection: socket.socket, known: bytes, now_s: float) -> None:
        self.connection = connection
        connection.settimeout(0.0)
        self._introduction = Introduction(known, "{}:{}".format(*connection.getsockname()))
        self._received = self._unsent = b""
        self.until_s, self.active_s = now_s + PROVES_S, now_s
        self.is_open = True

    @property
    def is_stranger(self) -> bool:
        return not self._introduction.is_over

    @property
    def has_line(self) -> bool:
        """True if a complete line can be answered now."""
        return self.is_open and not self._unsent and b"\n" in self._received

    @property
    def events(self) -> int:
        """The events to wait for. No call is received until the last answer is sent completely."""
        return selectors.EVENT_WRITE if self._unsent else selectors.EVENT_READ

    def exchange(self, now_s: float) -> None:
        """Send the rest of an answer, or receive. A line that is too long ends the connection."""
        if self._unsent:
            self.send("", now_s)
        elif not self.has_line:
            part = self.connection.recv(65536)
            self._received, self.active_s = self._received + part, now_s
            longest = LONGEST_PROOF if self.is_stranger else LONGEST
            self.is_open = bool(part) and len(self._received) <= longest

    def reply(self) -> str:
        """Return the answer to the next line; empty to disconnect."""
        line, self._received = self._received.split(b"\n", 1)
        call = parsed(line)
        if self.is_stranger:
            return self._introduction.reply(call)
        return answer(call[0], call[1:]) if call else ""

    def send(self, reply: str, now_s: float) -> None:
        """Send the part of an answer that the connection accepts now, and queue the rest."""
        self._unsent += reply.encode()
        try:
            sent = self.connection.send(self._unsent)
        except BlockingIOError:
            sent = 0
        self._unsent = self._unsent[sent:]
        if not self.is_stranger and (reply or sent):
            self.until_s = now_s + TAKES_S

    def is_late(self, now_s: float) -> bool:
        """Return True if the deadline for the proof or for receiving an answer has passed."""
        return now_s >= self.until_s and (self.is_stranger or bool(self._unsent))


class Bridge:
    """The server for all connections to one listening socket."""

    def __init__(self, listener: socket.socket, known: bytes) -> None:
        self._listener, self._known = listener, known
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._clients: list[Client] = []
        self._refused, self._shown_s = 0, 0.0

    def serve(self) -> None:
        look_s = time.monotonic()
        while True:
            if time.monotonic() >= look_s:
                if not wanted():
                    return
                look_s = time.monotonic() + LOOK_S
            for key, _ in self._selector.select(0.0 if any(one.has_line for one in self._clients) else WAIT_S):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._guarded(key.data, key.data.exchange)
            for client in [one for one in self._clients if one.has_line]:
                self._guarded(client, lambda now_s, one=client: self._answer(one, now_s))
            now_s = time.monotonic()
            for client in [one for one in self._clients if not one.is_open or one.is_late(now_s)]:
                if client.is_open and client.is_stranger:
                    self._refuse("no proof in time")
                self._drop(client)

    def close(self) -> None:
        for client in list(self._clients):
            self._drop(client)
        self._selector.close()

    def _accept(self) -> None:
        try:
            client = Client(self._listener.accept()[0], self._known, time.monotonic())
        except OSError:  # the client has disconnected before the connection was accepted
            return
        self._clients.append(client)
        self._selector.register(client.connection, client.events, client)
        strangers = [one for one in self._clients if one.is_stranger]
        if len(strangers) > MOST_STRANGERS:
            self._drop(strangers[0])

    def _guarded(self, client: Client, act) -> None:  # type: ignore[no-untyped-def]
        if not client.is_open:
            return
        try:
            act(time.monotonic())
        except OSError as error:
            client.is_open = False
            if not client.is_stranger:
                print(f"afspm bridge: lost a client: {error}")  # noqa: T201
        self._selector.modify(client.connection, client.events, client)

    def _answer(self, client: Client, now_s: float) -> None:
        was_stranger, reply = client.is_stranger, client.reply()
        if not reply:
            client.is_open = False
            self._refuse("neither a proof nor a call")
            return
        if was_stranger and not client.is_stranger and not self._has_room(client, now_s):
            client.is_open = False
            reply = json.dumps({"error": f"the bridge serves {MOST_CLIENTS} clients already: end one of them"})
        client.send(reply + "\n", now_s)

    def _has_room(self, client: Client, now_s: float) -> bool:
        # The client that is silent longest may have lost its connection without notice: a new client takes its place.
        others = [one for one in self._clients if one is not client and not one.is_stranger]
        if len(others) < MOST_CLIENTS:
            return True
        silent = min(others, key=lambda one: one.active_s)
        if now_s < silent.active_s + TAKES_S:
            return False
        self._drop(silent)
        return True

    def _refuse(self, why: str) -> None:
        # At most one line in ten seconds: a flood of connections must not fill GXSM's console.
        self._refused += 1
        if time.monotonic() >= self._shown_s + 10.0:
            print(f"afspm bridge: refused connections: {self._refused}, the last for {why}")  # noqa: T201
            self._shown_s = time.monotonic()

    def _drop(self, client: Client) -> None:
        client.is_open = False
        self._clients.remove(client)
        self._selector.unregister(client.connection)
        client.connection.close()


def run() -> None:
    """Set `script-control` to 1, and serve clients until the entry is 0."""
    known = secret()
    if gxsm is not None:
        gxsm.set("script-control", "1")
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, PORT))
        listener.listen(MOST_STRANGERS)
        print("afspm bridge: listening at {}:{}".format(*listener.getsockname()))  # noqa: T201
        bridge = Bridge(listener, known)
        try:
            bridge.serve()
        finally:
            bridge.close()
    print("afspm bridge: ended")  # noqa: T201


if not __name__.startswith("afspm."):
    if gxsm is None:
        import gxsm  # type: ignore[import-not-found,no-redef]
    run()
