"""Lets afspm call GXSM: run this in GXSM's Python console, and leave it running.

It listens on this computer only, for one client at a time, and passes on calls of the functions named below and no
others. Set `script-control` to 0 to end it. Nothing but Python itself is needed here.
"""

from __future__ import annotations

import base64
import json
import select
import socket

HOST, PORT = "127.0.0.1", globals().get("PORT", 65431)
METHODS = {
    *("set", "get", "gets", "list_refnames", "list_actions", "action", "rtquery", "y_current"),
    *("startscan", "stopscan", "autosave", "chfname", "moveto_scan_xy"),
    *("get_geometry", "get_dimensions", "get_differentials", "get_slice", "get_probe_event"),
}
LONGEST = 10_000
CALLS_A_LOOK = 50  # at script-control
LOOK_S = 0.5
SILENT_LOOKS = 20  # one that says nothing for so long is gone if another comes: its connection may have been lost
gxsm = globals().get("gxsm")  # the console has it


def packed(value):  # type: ignore[no-untyped-def]
    """An array, which JSON does not know."""
    return {"array": value.dtype.str, "shape": value.shape, "bytes": base64.b64encode(value.tobytes()).decode()}


def answer(line: bytes) -> str:
    """What a call, ["method", arguments…] in JSON, comes to."""
    try:
        method, *arguments = json.loads(line)
        if method not in METHODS:
            raise NameError(f"{method} is not passed on")
        value = getattr(gxsm, method)(*arguments)
        # what `action` returns in Gxsm3 is not initialised: it must not be looked at
        return json.dumps({"value": None if method == "action" else value}, default=packed)
    except Exception as error:
        return json.dumps({"error": f"{type(error).__name__}: {error}"})


def wanted() -> bool:
    """Whether the script is to go on."""
    return gxsm is not None and gxsm.get("script-control") > 0.5


def serve(client: socket.socket, listener: socket.socket) -> None:
    """Answer one client until it goes, or the script is to end."""
    received, calls, silent = b"", 0, 0
    while calls % CALLS_A_LOOK or wanted():
        if not select.select([client], [], [], LOOK_S)[0]:
            calls, silent = 0, silent + 1
            if silent >= SILENT_LOOKS and select.select([listener], [], [], 0.0)[0]:
                return
            continue
        silent = 0
        part = client.recv(65536)
        received += part
        if not part or len(received) > LONGEST:
            return
        while b"\n" in received:
            line, received = received.split(b"\n", 1)
            client.sendall(answer(line).encode() + b"\n")
            calls += 1


def run() -> None:
    """Listen until script-control is 0."""
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
                        serve(client, listener)
                except OSError as error:
                    print(f"afspm bridge: the client is gone: {error}")  # noqa: T201
    print("afspm bridge: ended")  # noqa: T201


if not __name__.startswith("afspm."):
    if gxsm is None:
        import gxsm  # type: ignore[import-not-found,no-redef]
    run()
