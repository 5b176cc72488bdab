"""Connection to SmartScan: JSON-RPC over ZeroMQ, with scripts that return a value or an error in afspm's own form."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any, Final

from afspm.basics import AfspmError, Plain, from_json
from afspm.driver import ControllerLost, ZmqConnection

RUN_SCRIPT, SCRIPT_RUNS, IS_CONNECTED, SCAN_STATUS, GEOMETRY = (
    "js_cmd",
    "js_run",
    "js_connect",
    "scan_query",
    "geometry_query",
)
_NO_PARAMETERS: Final = "None"
# one id for all requests: one request is pending at a time, and a missing reply closes the connection
_ID: Final = 1
_SHOWN: Final = 60
_HINTS: Final = (
    '"tcp://host:5581"',
    "does SmartScan run, with SmartRemote switched on?",
    "a dialog may wait on its screen, or a script of another client may be running",
)
OK, ERROR = "ok", "error"


class SmartScanError(AfspmError):
    """An error of a script, reported by SmartScan with its own text."""

    code = "park-error"


class Link:
    """A connection for one thread.

    Raises:
        ControllerLost: no program listens at the address. ConfigError: the address is malformed.
    """

    def __init__(self, address: str, timeout_s: float, monotonic_s: Callable[[], float]) -> None:
        self._address = address
        self._connection = ZmqConnection(address, timeout_s, monotonic_s, _HINTS)

    def ask(self, method: str) -> Any:
        """Call a method without parameters and return its result. Raises SmartScanError, ControllerLost."""
        return self._connection.ask(method, _request(method, _NO_PARAMETERS), _fields)["result"]

    def run(self, expression: str) -> Any:
        """Evaluate a JavaScript expression and return its value.

        Raises:
            SmartScanError: the script failed.
            ControllerLost: no reply, or a malformed reply; the connection is closed.
        """
        reply = self._connection.ask(shown(expression), _request(RUN_SCRIPT, wrapped(expression)), _fields)
        # the script of `wrapped` always returns a text: without a text the script did not run to its end
        if not reply.get("value"):
            raise self._bad(f"SmartScan gave no value of {shown(expression)}")
        return self._outcome(reply)

    def begin(self, expression: str) -> None:
        """Start a long script. Raises ControllerLost."""
        self._connection.begin(shown(expression), _request(RUN_SCRIPT, wrapped(expression)))

    def wait(self, within_s: float) -> None:
        """Wait for the reply to `begin`, at most `within_s` of real time. Raises ControllerLost."""
        self._connection.wait(within_s)

    def reply(self, what: str) -> tuple[bool, object]:
        """Return whether the reply has arrived, and its value; None for a reply without a value.

        Raises:
            SmartScanError: the script failed. ControllerLost.
        """
        reply = self._connection.reply(what, _fields)
        if reply is None:
            return False, None
        return True, self._outcome(reply) if reply.get("value") else None

    def close(self) -> None:
        self._connection.close()

    def _outcome(self, reply: Plain) -> Any:
        value = reply.get("value")
        try:
            outcome = from_json(value) if isinstance(value, str) else value
        except ValueError:
            outcome = None
        if not isinstance(outcome, dict) or len(outcome) != 1 or not outcome.keys() & {OK, ERROR}:
            raise self._bad(f"SmartScan replied {reply} to a script")
        if ERROR in outcome:
            raise SmartScanError(str(outcome[ERROR]))
        return outcome[OK]

    def _bad(self, problem: str) -> ControllerLost:
        self.close()
        return ControllerLost(
            problem, where=self._address, hint="afspm does not understand it: report it, with a trace"
        )


def wrapped(expression: str) -> str:
    """Return a script that returns the expression's value or error, since SmartScan's error form is unconfirmed."""
    ok, error = f'JSON.stringify({{"{OK}": ({expression})}})', f'JSON.stringify({{"{ERROR}": String(e)}})'
    return f"(function() {{ try {{ return {ok}; }} catch (e) {{ return {error}; }} }})()"


def shown(script: str) -> str:
    """Return the beginning of a script, for messages."""
    return script if len(script) <= _SHOWN else f"{script[:_SHOWN]}…"


def numbers(reply: object, count: int) -> list[float]:
    """Parse `count` finite numbers from a list, or from a text with commas.

    Raises:
        ControllerLost
    """
    parts = reply.split(",") if isinstance(reply, str) else reply
    try:
        found = [float(one) for one in parts] if isinstance(parts, list) else []
    except (TypeError, ValueError):
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise ControllerLost(f"SmartScan replied {reply!r} instead of {count} numbers")
    return found


def _request(method: str, parameters: str) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "method": method, "params": parameters, "id": _ID}).encode()


def _fields(raw: bytes) -> Plain:
    try:
        reply = from_json(raw)
    except ValueError as error:
        raise ControllerLost(f"SmartScan's reply is not JSON: {raw[:_SHOWN]!r}") from error
    if not isinstance(reply, dict):
        raise ControllerLost(f"SmartScan's reply is not JSON-RPC: {raw[:_SHOWN]!r}")
    if reply.get("error"):
        failure = reply["error"]
        raise SmartScanError(str(failure.get("message", failure) if isinstance(failure, dict) else failure))
    if "result" not in reply:
        raise ControllerLost(f"SmartScan's reply has no result: {raw[:_SHOWN]!r}")
    return reply
