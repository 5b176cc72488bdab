"""Lets afspm call GXSM: run this in GXSM's Python console, and leave it running.

It listens on this computer only, for one client at a time, and passes on calls of the functions named below and no
others. A client first sends a secret, which is in a file that only this user can read; a line that is neither that nor
a call ends the connection, so that no page in a browser can command GXSM. Set `script-control` to 0 to end it. Nothing
but Python itself is needed here.
"""

from __future__ import annotations

import base64
import hmac
import json
import os
import secrets
import select
import socket
from pathlib import Path

HOST, PORT = "127.0.0.1", globals().get("PORT", 65431)  # if it is in use: another number here and in `address`
SECRET = Path("~/.afspm/gxsm-bridge-secret").expanduser()
FOLDER = globals().get("FOLDER", str(Path.cwd()))
WELCOME = "afspm bridge"
METHODS = {
    *("set", "get", "gets", "list_refnames", "list_actions", "action", "rtquery", "y_current"),
    *("startscan", "stopscan", "autosave", "chfname", "moveto_scan_xy"),
    *("get_geometry", "get_dimensions", "get_differentials", "get_slice", "get_probe_event"),
}
LONGEST = 10_000
CALLS_A_LOOK = 50  # at script-control
LOOK_S = 0.5
STRANGER_LOOKS = 2
SILENT_LOOKS = 20  # one that says nothing for so long is gone if another comes: its connection may have been lost
gxsm = globals().get("gxsm")  # the console has it


def packed(value):  # type: ignore[no-untyped-def]
    """An array, which JSON does not know."""
    return {"array": value.dtype.str, "shape": value.shape, "bytes": base64.b64encode(value.tobytes()).decode()}


def secret() -> bytes:
    """Return the secret, made when this is run for the first time."""
    SECRET.parent.mkdir(mode=0o700, exist_ok=True)
    if not SECRET.exists():
        with os.fdopen(os.open(SECRET, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(secrets.token_hex(32).encode())
    if os.name == "posix" and SECRET.stat().st_mode & 0o077:
        raise PermissionError(f"other users can read {SECRET}: chmod 600 {SECRET}")
    found = SECRET.read_bytes().strip()
    if len(found) < 32:
        raise ValueError(f"{SECRET} is damaged: delete it, and run this again")
    return found


def parsed(line: bytes):  # type: ignore[no-untyped-def]
    """Return a call, ["method", arguments…] in JSON; None if it is none."""
    try:
        call = json.loads(line)
    except (ValueError, RecursionError):
        return None
    is_call = isinstance(call, list) and call and isinstance(call[0], str)
    return call if is_call and all(isinstance(one, (str, int, float)) for one in call) else None


def answer(method, arguments) -> str:  # type: ignore[no-untyped-def]
    """Return what a call comes to."""
    try:
        if method == "getcwd":
            return json.dumps({"value": FOLDER})
        if method not in METHODS:
            raise NameError(f"{method} is not a method that the bridge passes on")
        value = getattr(gxsm, method)(*arguments)
        # what `action` returns in Gxsm3 is not initialised: it must not be looked at
        return json.dumps({"value": None if method == "action" else value}, default=packed)
    except Exception as error:
        return json.dumps({"error": f"{type(error).__name__}: {error}"})


def wanted() -> bool:
    """Return True if the script is to go on."""
    return gxsm is not None and gxsm.get("script-control") > 0.5


def serve(client: socket.socket, listener: socket.socket, known: bytes) -> None:
    """Answer one client until it goes, says what is no call, or the script is to end."""
    received, calls, silent, welcome = b"", 0, 0, False
    while calls % CALLS_A_LOOK or wanted():
        if not select.select([client], [], [], LOOK_S)[0]:
            calls, silent = 0, silent + 1
            if silent >= (SILENT_LOOKS if welcome else STRANGER_LOOKS) and select.select([listener], [], [], 0.0)[0]:
                return
            continue
        silent = 0
        part = client.recv(65536)
        received += part
        if not part or len(received) > LONGEST:
            return
        while b"\n" in received:
            line, received = received.split(b"\n", 1)
            call = parsed(line) if welcome else None
            if call is not None:
                reply = answer(call[0], call[1:])
            elif not welcome and hmac.compare_digest(line, known):
                welcome, reply = True, json.dumps({"value": WELCOME})
            else:
                print("afspm bridge: refused a client that sent neither the secret nor a call")  # noqa: T201
                return
            client.sendall(reply.encode() + b"\n")
            calls += 1


def run() -> None:
    """Listen until script-control is 0."""
    known = secret()
    if gxsm is not None:
        gxsm.set("script-control", "1")
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, PORT))
        listener.listen(1)
        print("afspm bridge: listening at {}:{}".format(*listener.getsockname()))  # noqa: T201
        while wanted():
            if select.select([listener], [], [], LOOK_S)[0]:
                client, _ = listener.accept()
                client.settimeout(10.0)  # one that does not take its answers is let go
                try:
                    with client:
                        serve(client, listener, known)
                except OSError as error:
                    print(f"afspm bridge: lost the client: {error}")  # noqa: T201
    print("afspm bridge: ended")  # noqa: T201


if not __name__.startswith("afspm."):
    if gxsm is None:
        import gxsm  # type: ignore[import-not-found,no-redef]
    run()
