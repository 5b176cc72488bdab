"""A connected Nanosurf Studio: its values, its commands, and the state of its scan."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

import numpy as np

from afspm.basics import ConfigError, Refused
from afspm.driver import ControllerLost, LongCall, Value
from afspm.model import ControlResponse, Region, ScanLines
from afspm.plugins.nanosurf import commands
from afspm.plugins.nanosurf.commands import WORKFLOW
from afspm.plugins.nanosurf.link import Link, StudioError
from afspm.plugins.nanosurf.lua_values import written

ENUMS: Final = frozenset({"imaging.scan_mode", "imaging.slow_axis_scan_direction", "data.storage.nhf_auto_store_mode"})
"""Paths of choices, whose value is a number."""
# before release 17 there may be none (! full-version)
_FULL: Final = "root.version.full and root.version.full() or root.version.major()"
VERSIONS: Final = f"return root.version.major(), {_FULL}, root.session.list()"
"""Returns the release, the full version and the names of the sessions."""
_LARGEST_BUFFERED: Final = 2**31 - 1


@dataclass(frozen=True)
class Scanning:
    """The state of scans.

    Attributes:
        running: True while a scan runs.
        started: number of started scans since the handlers were connected; 0 if this release does not count them.
    """

    running: bool
    started: int


class Session:
    """A measurement session of Studio. Not thread-safe.

    Args:
        open_link: opens a new connection.
        release: release of Studio.
        name: name of the session; empty: the only open session.
        level: level of the session's commands; None: the lowest sufficient level.
        watches: whether begin and end of measurements are needed, which some releases report only to handlers.

    Raises:
        ControllerLost: no connection, or no such session.
        ConfigError: Studio has another release, lacks commands, or does not report scans to scripts.
    """

    def __init__(
        self, open_link: Callable[[], Link], release: int, name: str, level: int | None = None, *, watches: bool = True
    ) -> None:
        self._watches = watches
        self._open_link, self._release, self._name = open_link, release, name
        self._level = commands.level(release) if level is None else level
        self._old = commands.has_old_commands(release)
        self._is_before_this_tree = commands.is_before_this_tree(release)
        self._units: Mapping[str, str] = {}
        self._link = open_link()
        try:
            self._name = self._checked_name(name)
            self._select(self._link)
            self._check()
        except BaseException:  # Ctrl-C, too: nothing else closes this connection
            self._link.close()
            raise

    def run(self, script: str) -> list[Any]:
        """Run a script and return its values. Raises StudioError, ControllerLost."""
        return self._link.run(script)

    def do(self, command: str) -> None:
        """Call a command. Raises Refused: ACTION_ERROR: Studio reports an error."""
        try:
            self.run(f"{self.path(command)}() return 0")
        except StudioError as error:
            raise Refused(ControlResponse.ACTION_ERROR, f"Studio refused {command}: {error}") from error

    def values(self, paths: Sequence[str]) -> dict[str, Value]:
        """Return values of panels by path.

        Raises:
            ControllerLost: the script fails, or a value is in another unit than at the start: no reply can be trusted.
            Refused: PARAM_ERROR: a value is missing or not finite.
        """
        # One request for all values: they belong to the same moment, and a poll stays short.
        measured = [path for path in paths if path in self._units]
        get = "" if self._is_before_this_tree else "_get()"
        fields = [f"{self.path(path)}.{_field(path)}{get}" for path in paths]
        fields += [f"{self.path(path)}.unit{get}" for path in measured]
        returned = self._returned(", ".join(fields))
        found = dict(zip(paths, returned, strict=False))
        for path, unit in zip(measured, returned[len(paths) :], strict=False):
            if unit != self._units[path]:
                raise ControllerLost(f"the unit of {path} was changed at Studio from {self._units[path]} to {unit}")
        for path in paths:
            value = found.get(path)
            if not isinstance(value, bool | int | float | str) or (isinstance(value, float) and not isfinite(value)):
                raise Refused(ControlResponse.PARAM_ERROR, f"Studio replied {value} for {path}")
        return found

    def put(self, values: Mapping[str, Value]) -> None:
        """Set values of panels, all or none.

        Raises:
            Refused: PARAM_ERROR: Studio rejects a value, or has it in another unit than at the start.
        """
        checks = [f"same({self.path(path)}, {written(self._units[path])})" for path in values if path in self._units]
        puts = [f"put({self.path(path)}, {written(_field(path))}, {written(value)})" for path, value in values.items()]
        try:
            self.run(commands.PUT_ALL % " ".join(checks + puts))
        except StudioError as error:
            raise Refused(ControlResponse.PARAM_ERROR, f"Studio refused {', '.join(values)}: {error}") from error

    def switch(self, values: Mapping[str, Value]) -> None:
        """Set switches of panels that a measurement depends on, and read them back.

        Raises:
            Refused: PARAM_ERROR: see `put`. ACTION_ERROR: Studio keeps another value.
        """
        self.put(values)
        found = self.values(list(values))
        if kept := [f"{path} = {found[path]}" for path, value in values.items() if found[path] != value]:
            reason = f"Studio keeps {', '.join(kept)}, although another value was set; set it at Studio"
            raise Refused(ControlResponse.ACTION_ERROR, reason)

    def units(self, paths: Iterable[str]) -> dict[str, str]:
        """Return Studio's units of values by path; empty: none."""
        paths = list(paths)
        found = self.run(commands.UNITS % self._listed(paths))[0]
        return {path: str(found.get(number, "")) for number, path in enumerate(paths, 1)}

    def keep_units(self, units: Mapping[str, str]) -> None:
        """Store the expected units by path: `values` and `put` fail from now on if Studio has another unit.

        A person may change units at the panel. Values without a unit are not checked.
        """
        self._units = {path: unit for path, unit in units.items() if unit}

    def missing(self, paths: Iterable[str]) -> list[str]:
        """Return the paths that Studio lacks, as in its own tree."""
        return [str(one) for one in self.run(commands.MISSING % self._listed(paths))[0].values()]

    def path(self, path: str) -> str:
        """Return the full path of a value or command in Studio's own tree."""
        return f"{WORKFLOW}.{commands.path_in(self._release, path)}"

    @property
    def stop_all(self) -> str:
        """The script that stops scan, curve and approach."""
        return commands.stop_all(self._release)

    def moves(self) -> bool:
        """Return whether an approach or withdrawal runs, before release 17. Raises ControllerLost."""
        found = self._returned("afspm_moves.running")
        if found not in ([True], [False]):
            raise ControllerLost(f"Studio replied {found} when asked if the tip moves")
        return bool(found[0])

    def scanning(self) -> Scanning:
        """Return whether a scan runs, and the number of started scans. Raises ControllerLost."""
        # Newer releases have no is_scanning: handlers of their signals count scans instead.
        script = f"{self.path(commands.IS_SCANNING)}(), 0" if self._old else "afspm_seen.scanning, afspm_seen.started"
        found = self._returned(script)
        if len(found) != 2 or not isinstance(found[0], bool) or not isinstance(found[1], int):
            raise ControllerLost(f"Studio replied {found} when asked if it scans")
        return Scanning(*found)

    def begin(self, what: str, command: str, first: str = "", wait_s: float = 0.0) -> LongCall:
        """Start a long command on a separate connection, after the script `first`.

        Args:
            wait_s: longest wait for the reply to the command, real time.

        Raises:
            ControllerLost
        """
        link = self._open_link()
        try:
            self._select(link)
            # A long command blocks its connection: the first connection stays free for polls and stops.
            if self._is_before_this_tree:
                self.run("afspm_moves.running = true")
            link.begin(f"{first} return {self.path(command)}()")
            link.wait(wait_s)
        except BaseException:  # Ctrl-C, too: nothing else closes this connection
            link.close()
            raise
        # before release 17 a command may return at once: the signals of its end count
        return LongCall(what, link, lambda _: self._is_before_this_tree and self.moves())

    def close(self) -> None:
        self._link.close()

    # --- inside ---

    def _listed(self, paths: Iterable[str]) -> str:
        return ", ".join(written(commands.path_in(self._release, path)) for path in paths)

    def _returned(self, script: str) -> list[Any]:
        # Any session can run these scripts: an error means that this session was closed or replaced.
        try:
            return self.run(f"return {script}")
        except StudioError as error:
            raise ControllerLost(f"Studio's session is not what it was: {error}") from error

    def _checked_name(self, name: str) -> str:
        self._link.run("return root.session.select_main(0)")
        major, full, listed = self._link.run(VERSIONS)
        self.controller = f"Nanosurf Studio {full}"
        commands.has_old_commands(major)  # too old: the hint below would lead to a refusal
        if major != self._release:
            problem = f"Studio is release {major}, not {self._release}"
            raise ConfigError(problem, where="release", hint=f"release = {major}")
        found = [str(one) for one in listed.values()] if isinstance(listed, dict) else []
        if name in found or (not name and len(found) == 1):
            return name or found[0]
        hint = f"open one, or set session to one of {', '.join(found) or 'the open ones'}"
        raise ControllerLost(f"Studio has no single measurement session {name}", hint=hint)

    def _select(self, link: Link) -> None:
        try:
            # The selection of a session belongs to a connection: each connection needs its own selection.
            link.run(f"return root.session.select({written(self._name)}, {self._level})")
        except StudioError as error:
            raise ControllerLost(f"Studio's session {self._name!r} can't be selected: {error}") from error

    def _check(self) -> None:
        missing = self.missing(commands.used(self._release))
        if missing:
            names = ", ".join(missing)
            hint = "name its release (Help > About) in the setting release, and look at the level of its licence"
            raise ConfigError(f"{self.controller} has no {names}", where="release", hint=hint)
        watch = commands.WATCH_MOVES if self._is_before_this_tree else "" if self._old else commands.WATCH
        if self._watches and watch and self.run(watch)[0]:
            what = "approaches" if self._is_before_this_tree else "scans"
            problem = f"{self.controller} does not report the start and end of {what} to scripts"
            raise ConfigError(problem, where="release", hint="report it, with the release, to the afspm project")


def _field(path: str) -> str:
    return "value_raw" if path in ENUMS else "value"


def new_lines(
    session: Session, buffer: int, region: Region, shape: tuple[int, int], start: int, *, upwards: bool
) -> list[ScanLines]:
    """Return the complete lines of all channels after the first `start` lines of the scan.

    Returns:
        one item for each channel, all with the same lines, rows ascending in y; empty without new lines.
    """
    # the lines are in the order of scanning (! image-buffer)
    found = session.run(commands.BUFFER_LINES % buffer)[0]
    channels = [_buffered_channel(one, shape[1]) for one in found.values()]
    done = min((len(values) for _, _, values in channels), default=0)
    if done <= start:
        return []
    first = start if upwards else shape[0] - done
    lines = []
    for name, unit, values in channels:
        rows = values[start:done] if upwards else values[start:done][::-1]
        lines.append(ScanLines(region, shape, name, unit, first, np.ascontiguousarray(rows)))
    return lines


def _buffered_channel(found: dict[int, Any], columns: int) -> tuple[str, str, np.ndarray]:
    name, unit, span, raw = (found[number] for number in (1, 2, 3, 4))
    values = np.array(list(raw.values()), dtype=np.float64) / _LARGEST_BUFFERED * float(span)
    rows = len(values) // columns
    return str(name), str(unit), values[: rows * columns].reshape(rows, columns)
