"""What comes of a measurement: Nanonis' file of it, or, where there is none, what it has in memory."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any, Final

from afspm.errors import AfspmError, FileError
from afspm.files import read
from afspm.microscopes.nanonis import fetched
from afspm.model import Scan, Spectrum
from afspm.translator.driver import LOST
from afspm.translator.result_files import SCAN, Content, ResultFiles, as_set, lines_missing

_PRINTED: Final = 2e-6
"""Relative: what a file has of a position, of which it prints seven digits."""

_TURNED_RAD: Final = 1e-3
"""The same of the angle, in degrees with three digits."""

Fetch = Callable[[Mapping[str, Any]], Sequence[Scan | Spectrum]]


class NanonisFiles(ResultFiles):
    """The measurement that is running or has just ended, and the results.

    Args:
        session_dir: where the session folder of Nanonis' computer is seen from here; None: it is this computer.
        own_folder: for what is fetched.
        patience_s: how long a file may take before the data is fetched instead.
    """

    def __init__(
        self,
        kept: dict[str, Any],
        session_dir: Path | None,
        own_folder: Path,
        patience_s: float,
        log: logging.Logger,
    ) -> None:
        super().__init__(kept, log)
        self._session_dir = session_dir
        self._own_folder = own_folder
        self._patience_s = patience_s
        self._read: dict[str, Content] = {}
        kept.setdefault("fetched", 0)

    def begin(self, what: str, session: str, taken: Mapping[str, Any]) -> None:
        """A measurement begins.

        Args:
            session: Nanonis' session folder.
            taken: "frame" of a scan, "position" of a spectrum.
        """
        taken = {"seen": what != SCAN, **taken}
        folder = self._session_dir or Path(session)
        newest = max((file.stat().st_mtime_ns for file in self._files(folder, what)), default=0)
        self._begins(what, {"folder": str(folder), "newest_ns": newest, **taken})

    @property
    def was_seen(self) -> bool:
        """Whether what is running was ever seen running: if not, what Nanonis has in memory is of the scan before."""
        return self._kept["running"] is not None and bool(self._kept["running"].get("seen", True))

    def seen(self) -> None:
        """What is running was seen running."""
        if self._kept["running"] is not None:
            self._kept["running"]["seen"] = True

    def end(self, now_ns: int, now_s: float, told: str | None = None) -> None:
        """It has ended, or more is known of its end.

        Args:
            told: where Nanonis says that it saved it; empty: it did not; None: it has not said.
        """
        running = self._kept["running"]
        if running is not None:
            seen = Path(running["folder"]).is_dir()
            fetch_at_s = now_s + (self._patience_s if seen else 0.0)
            self._ends({"told": told, "end_ns": now_ns, "fetch_at_s": fetch_at_s})
        ended = self._kept["ended"]
        if ended is not None and told is not None:
            ended["told"] = told
            if not told:
                ended["fetch_at_s"] = now_s

    def has_file(self) -> bool:
        """Whether a file of what is running has appeared."""
        running = self._kept["running"]
        return running is not None and self._file({**running, "told": None}) is not None

    def next_s(self) -> float | None:
        """When to look again at the latest."""
        ended = self._kept["ended"]
        return None if ended is None else float(ended["fetch_at_s"])

    def results(self, now_s: float, fetch: Fetch) -> list[str]:
        """The last results, oldest first.

        Args:
            fetch: gets from Nanonis what is in no file.
        """
        self.broken_off = False
        ended = self._kept["ended"]
        if ended is not None:
            file = self._file(ended)
            if file is not None and (content := self._whole(file, ended)) is not None:
                self._add(file, ended, content)
            elif now_s >= ended["fetch_at_s"]:
                self._kept["ended"] = None
                self._fetch(fetch, ended, file)
        return self._listed()

    def load(self, result: str) -> Content:
        """Read one of the results, with the parameters that it was taken with.

        Raises:
            FileError: it is no result any more, or its file has gone.
        """
        entry = self._found(result)
        if result not in self._read:
            self._read = {result: _content(Path(result), entry)}
        return self._read[result]

    def _fetch(self, fetch: Fetch, ended: Mapping[str, Any], file: Path | None) -> None:
        missed = str(file or ended["told"] or f"in {ended['folder']}")
        try:
            if not ended.get("seen", True):
                raise FileError("it was never seen running")
            content = list(fetch(ended))
            _refuse_gaps(content)
        except LOST:
            self._kept["ended"] = dict(ended)  # once it is found again
            raise
        except AfspmError as error:
            self._log.error("no file of the %s (%s), and it can't be fetched: %s", ended["what"], missed, error)
            self.broken_off = True
            return
        if ended["told"] != "":
            self._log.warning("no whole file of the %s (%s): it was fetched from Nanonis", ended["what"], missed)
        self._kept["fetched"] += 1
        path = self._own_folder / f"nanonis-{self._kept['fetched']:04d}{fetched.SUFFIX}"
        fetched.write(path, content)
        self._add(path, ended, _content(path, ended))

    def _add(self, file: Path, ended: Mapping[str, Any], content: Content) -> None:
        name = str(file)
        self._comes(name, ended, {})
        self._kept["ended"] = None
        self._read = {name: content}

    def _whole(self, file: Path, ended: Mapping[str, Any]) -> Content | None:
        try:
            content = _content(file, ended)
            _refuse_gaps(content)
            return content
        except (AfspmError, OSError):
            return None  # not yet

    def _file(self, ended: Mapping[str, Any]) -> Path | None:
        """The file of what has ended, if it is there."""
        if ended["told"]:
            # whatever the other computer calls its folder, the name is the same
            folder = self._session_dir
            path = Path(ended["told"]) if folder is None else folder / PureWindowsPath(ended["told"]).name
            return path if path.is_file() and path.stat().st_mtime_ns > ended["newest_ns"] else None
        if ended["told"] == "":
            return None
        times = [(file.stat().st_mtime_ns, file) for file in self._files(Path(ended["folder"]), ended["what"])]
        new = [(time_ns, file) for time_ns, file in times if time_ns > ended["newest_ns"]]
        return max(new)[1] if new else None

    def _files(self, folder: Path, what: str) -> list[Path]:
        return list(folder.glob("*.sxm" if what == SCAN else "*.dat")) if folder.is_dir() else []


def _content(path: Path, entry: Mapping[str, Any]) -> Content:
    found = fetched.read(path) if path.suffix == fetched.SUFFIX else list(read(path))
    return [_as_taken(one, entry) for one in found]


def _as_taken(one: Scan | Spectrum, entry: Mapping[str, Any]) -> Scan | Spectrum:
    """With the frame or position that was set, of which the file has as many digits as it prints, and our time."""
    if isinstance(one, Scan):
        return as_set(one, entry, part=_PRINTED, angle_rad=_TURNED_RAD)
    x, y = entry["position"]
    there = one.position_m is None or math.dist(one.position_m, (x, y)) <= 10 * _PRINTED * max(abs(x), abs(y)) + 1e-12
    position = (x, y) if there else one.position_m
    return replace(one, kind=entry["what"], position_m=position, time_ns=entry["end_ns"])


def _refuse_gaps(content: Sequence[Scan | Spectrum]) -> None:
    """Raises FileError: lines that were never scanned, of a scan that was broken off."""
    for one in content:
        if missing := lines_missing(one):
            raise FileError(f"{missing} of its {one.values.shape[0]} lines were not scanned")
