"""A connected SmartScan: its values, its commands, and the state of its scan."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final

from afspm.basics import Refused
from afspm.driver import ANSWERS_S, ControllerLost, LongCall, Value
from afspm.model import ControlResponse
from afspm.plugins.park.link import (
    GEOMETRY,
    IS_CONNECTED,
    SCAN_STATUS,
    SCRIPT_RUNS,
    Link,
    SmartScanError,
    numbers,
)

TRUE, FALSE = frozenset({"true", "1"}), frozenset({"false", "0"})
_GEOMETRY: Final = ("pixelHeight", "pixelWidth", "width", "height", "offsetX", "offsetY", "rotation")


class _NoReply:
    """The connection of a script whose reply went to an earlier connection."""

    def reply(self, what: str) -> tuple[bool, object]:
        return True, None

    def close(self) -> None: ...


class Session:
    """SmartScan over one connection, with a further connection for each long script. Not thread-safe.

    Args:
        open_link: opens a new connection.
        scanning, idle: words of `scan_query`, in lower case.

    Raises:
        ControllerLost: no connection, SmartScan is not ready, or `scan_query` returns an unknown word.
    """

    def __init__(self, open_link: Callable[[], Link], scanning: Collection[str], idle: Collection[str]) -> None:
        self._open_link, self._scanning, self._idle = open_link, scanning, idle
        self._link = open_link()
        self._shows_scripts = False
        try:
            # an unknown word in an answer must be found now, not during the first scan
            self._link.ask(IS_CONNECTED)
            self.scanning()
        except SmartScanError as error:
            self._link.close()
            raise ControllerLost(f"SmartScan is not ready: {error}") from error
        except BaseException:  # Ctrl-C, too: nothing else closes this connection
            self._link.close()
            raise

    def values(self, paths: Sequence[str]) -> dict[str, Value]:
        """Return values by path below `spm`.

        Raises:
            Refused: PARAM_ERROR: SmartScan reports an error, or a value is missing, not finite or not plain.
        """
        try:
            found = self._link.run(f"[{', '.join(f'spm.{path}' for path in paths)}]")
        except SmartScanError as error:
            raise Refused(ControlResponse.PARAM_ERROR, f"SmartScan refused {', '.join(paths)}: {error}") from error
        if not isinstance(found, list) or len(found) != len(paths) or not all(map(_is_value, found)):
            raise Refused(ControlResponse.PARAM_ERROR, f"SmartScan replied {found} for {', '.join(paths)}")
        return dict(zip(paths, found, strict=True))

    def is_number(self, path: str) -> bool:
        """Return True if a path below `spm` leads to a number. Raises ControllerLost."""
        try:
            return bool(self._link.run(f"typeof spm.{path}") == "number")
        except SmartScanError:
            return False

    def put(self, values: Mapping[str, Value]) -> None:
        """Set values by path below `spm`, in order.

        Raises:
            Refused: PARAM_ERROR: SmartScan rejects a value; the values before it stay set.
        """
        given = ", ".join(f"spm.{path} = {json.dumps(value)}" for path, value in values.items())
        self._do(given, ", ".join(values), ControlResponse.PARAM_ERROR)

    def put_members(self, path: str, members: Mapping[str, Value]) -> None:
        """Set members of an object, which SmartScan accepts only as a whole. Raises Refused: PARAM_ERROR."""
        # SmartScan's gains are one object: setting a member alone has no effect.
        given = "".join(f"all[{json.dumps(name)}] = {json.dumps(value)}; " for name, value in members.items())
        changed = f"spm.{path} = (function (all) {{ {given}return all; }})(spm.{path})"
        self._do(changed, path, ControlResponse.PARAM_ERROR)

    def do(self, command: str) -> None:
        """Call a command, e.g. "scan.stop()". Raises Refused: ACTION_ERROR: SmartScan reports an error."""
        self._do(f"spm.{command}", command, ControlResponse.ACTION_ERROR)

    def run(self, expression: str) -> object:
        """Evaluate an expression and return its value. Raises SmartScanError, ControllerLost."""
        return self._link.run(expression)

    def geometry(self) -> dict[str, float]:
        """Return the frame by SmartScan's names, in µm, degrees and pixels. Raises ControllerLost."""
        return dict(zip(_GEOMETRY, numbers(self._asked(GEOMETRY), len(_GEOMETRY)), strict=True))

    def set_geometry(self, wanted: Mapping[str, float]) -> None:
        """Set the frame by SmartScan's names, in µm, degrees and pixels. Raises Refused: PARAM_ERROR."""
        self._do(f"spm.scan.setScanGeometry({json.dumps(dict(wanted))})", "the frame", ControlResponse.PARAM_ERROR)

    def scanning(self) -> bool:
        """Return True while a scan runs. Raises ControllerLost: the answer is an unknown word."""
        hint = "note its answers during a scan and without one, and set scanning_words and idle_words"
        return self._word(SCAN_STATUS, self._scanning, self._idle, hint)

    def script_runs(self) -> bool:
        """Return True while a script runs. Raises ControllerLost: the answer is an unknown word."""
        found = self._word(SCRIPT_RUNS, TRUE, FALSE, "report it, with a trace")
        self._shows_scripts = self._shows_scripts or found
        return found

    def begin(self, what: str, expression: str, wait_s: float = 0.0) -> LongCall:
        """Start a long script on a separate connection; wait up to `wait_s` of real time for its reply.

        Whether the reply arrives at the end of a script, or at once without a value, is unconfirmed. After an early
        reply SmartScan is polled for the end of the script.

        Raises:
            ControllerLost
        """
        link = self._open_link()
        try:
            link.begin(expression)
            link.wait(wait_s)
        except BaseException:  # Ctrl-C, too: nothing else closes this connection
            link.close()
            raise
        # A value of None means that SmartScan has replied before the end of the script.
        # Until SmartScan has shown a running script, a script that it does not show may run all the same.
        return LongCall(
            what,
            link,
            is_unfinished=lambda value: value is None and self.script_runs(),
            is_seen=lambda: self.script_runs() or not self._shows_scripts,
        )

    def start(self, what: str, expression: str, refusal: int) -> LongCall:
        """Start a long script as `begin`. Raises Refused with the code `refusal`: it fails within `ANSWERS_S`."""
        call = self.begin(what, expression, ANSWERS_S)
        call.require_accepted(SmartScanError, "SmartScan", refusal)
        return call

    def resumed(self, what: str) -> LongCall:
        """Return the call of a script that an earlier connection started: only `script_runs` shows its end."""
        return LongCall(what, _NoReply(), lambda value: self.script_runs())

    def close(self) -> None:
        self._link.close()

    # --- inside ---

    def _do(self, expression: str, what: str, refusal: int) -> None:
        try:
            self._link.run(f"({expression}, 0)")
        except SmartScanError as error:
            raise Refused(refusal, f"SmartScan refused {what}: {error}") from error

    def _asked(self, method: str) -> object:
        try:
            return self._link.ask(method)
        except SmartScanError as error:
            raise ControllerLost(f"SmartScan does not answer {method}: {error}") from error

    def _word(self, method: str, yes: Collection[str], no: Collection[str], hint: str) -> bool:
        found = str(self._asked(method)).strip().casefold()
        if found not in yes and found not in no:
            known = ", ".join(sorted({*yes, *no}))
            raise ControllerLost(f"SmartScan replied {found!r} to {method}, and not one of {known}", hint=hint)
        return found in yes


def _is_value(found: object) -> bool:
    return isinstance(found, bool | int | str) or (isinstance(found, float) and math.isfinite(found))
