"""Results of measurements: Nanonis' files, or the data in its memory."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path, PureWindowsPath
from typing import Final

import numpy as np

from afspm.basics import AfspmError, FileError
from afspm.driver import (
    LOST,
    SCAN,
    Content,
    Entry,
    FileContent,
    FilePrecision,
    ResultFiles,
    lines_missing,
    missing_text,
    newest,
    read_result,
)
from afspm.model import Spectrum
from afspm.plugins.nanonis import fetched

_PRECISION: Final = FilePrecision(part=2e-6, angle_rad=1e-3, positions=True)
"""Scan files have seven digits of a length, and four digits of an angle in degrees: errors of up to 0.05 degrees."""

Fetch = Callable[[Entry], Content]


class NanonisFiles(ResultFiles):
    """The running or just ended measurement, and the results.

    Args:
        session_dir: local path of the session folder; None: the path on Nanonis' computer.
        own_folder: folder for fetched data.
        patience_s: longest wait for a file before the data is fetched, experiment time.
    """

    precision = _PRECISION

    def __init__(
        self,
        kept: Entry,
        session_dir: Path | None,
        own_folder: Path,
        patience_s: float,
        log: logging.Logger,
    ) -> None:
        super().__init__(kept, log)
        self._session_dir = session_dir
        self._own_folder = own_folder
        self._patience_s = patience_s
        self._has_followed = False
        kept.setdefault("fetched", 0)
        kept.setdefault("followed", None)

    def begin(self, what: str, session: str, taken: Mapping[str, object]) -> None:
        """Register the start of a measurement.

        Args:
            session: path of the session folder on Nanonis' computer.
            taken: settings of the measurement: "frame" of a scan, "position" of a spectrum.
        """
        folder = self._session_dir or Path(session)
        newest_ns = self.newest_ns(folder, _files(folder, what), what)
        # the frame is read right before the start, so a change before the first poll is seen as well
        under_way = {"under_way": taken["frame"]} if what == SCAN else {}
        facts = {"folder": str(folder), "newest_ns": newest_ns, **taken, **under_way}
        self._begins(what, {"seen": what != SCAN, **facts})

    def look(self, folder: Path) -> None:
        """Register the files that are there before a measurement: they are not its results."""
        for what in (SCAN, "spectrum"):
            self.newest_ns(folder, _files(folder, what), what)

    @property
    def was_seen(self) -> bool:
        """True if Nanonis has reported the present scan as running; before, its memory may hold the previous scan.

        Always True during a spectrum, False without a measurement.
        """
        return self._kept["running"] is not None and bool(self._kept["running"].get("seen", True))

    def seen(self) -> None:
        """Record that Nanonis has reported the measurement as running."""
        if self._kept["running"] is not None:
            self._kept["running"]["seen"] = True

    def end(self, now_ns: int, now_s: float, path: str | None = None) -> None:
        """Register the end of the running measurement, and the reported file of the ended measurement.

        Args:
            path: file path reported by Nanonis; empty: not saved, so the data is fetched at once; None: not reported.
        """
        running = self._kept["running"]
        if running is not None:
            # Without access to the folder no file can appear: fetch at once.
            patience_s = self._patience_s if Path(running["folder"]).is_dir() else 0.0
            path = "" if path is None and running.get("unsaved") else path
            self._ends({"reported": path, "end_ns": now_ns, "fetch_at_s": now_s + patience_s})
        if path is not None:
            self._reported(now_s, path)

    def scan_reported(self, now_s: float, path: str) -> None:
        """Register the reported file of a scan that has ended; arguments as of `end`."""
        if self._kept["ended"] is not None and self._kept["ended"]["what"] == SCAN:
            self._reported(now_s, path)

    def _reported(self, now_s: float, path: str) -> None:
        ended = self._kept["ended"]
        if ended is not None:
            ended["reported"] = path
            if not path:
                ended["fetch_at_s"] = now_s

    def end_followed(self, now_ns: int, now_s: float, path: str) -> None:
        """Register the end of a scan, and that the next scan of a continuous series is running already.

        The scan's data is not fetched if the file is incomplete: Nanonis' memory already holds the next scan.

        Args:
            path: file path reported by Nanonis. A file from before the scan is left out: the report came late.
        """
        self.end(now_ns, now_s, path)
        ended = self._kept["ended"]
        if ended is not None and self._file(ended) is not None:
            self._kept["followed"], self._kept["ended"] = ended, None

    def followed(self) -> bool | None:
        """Return True once for each scan registered by `end_followed`, when its file is read; None otherwise."""
        found, self._has_followed = self._has_followed, False
        return found or None

    def forget(self) -> None:
        self._kept["followed"], self._has_followed = None, False
        super().forget()

    def has_file(self) -> bool:
        """Return True if a file of the running measurement has appeared."""
        running = self._kept["running"]
        return running is not None and self._file({**running, "reported": None}) is not None

    def next_s(self) -> float | None:
        """Return the time from which awaited data is fetched instead, in experiment time; None: no data is awaited."""
        ended = self._kept["followed"] or self._kept["ended"]
        return None if ended is None else float(ended["fetch_at_s"])

    def results(self, now_s: float, fetch: Fetch) -> list[str]:
        """Look for the awaited file, or fetch its data; return the last results, oldest first, by their files' paths.

        Args:
            fetch: fetches the data of a measurement from Nanonis' memory.
        """
        self.broken_off = False
        followed, ended = self._kept["followed"], self._kept["ended"]
        if followed is not None:
            self._take_followed(followed, now_s)
        elif ended is not None:
            file = self._file(ended)
            if file is not None and (content := self._whole(file)) is not None:
                self._take(file, ended, content)
            elif now_s >= ended["fetch_at_s"]:
                self._kept["ended"] = None
                self._fetch(fetch, ended, file)
        return self._listed()

    def listed(self) -> list[str]:
        """Return the last results, without looking for new ones."""
        return self._listed()

    def read(self, entry: Entry) -> Content:
        return _as_set(read_result(Path(entry["result"])), entry)

    def _fetch(self, fetch: Fetch, ended: Entry, file: Path | None) -> None:
        missed, missing = str(file or ended["reported"] or f"in {ended['folder']}"), ""
        try:
            if not ended.get("seen", True):
                raise FileError("the controller never reported it as running")
            content = fetch(ended)
            # A stopped scan stays in Nanonis' memory with NaN in the missing lines.
            if missing := missing_text(content) or _points_missing(content):
                self.missing = missing
                raise FileError(missing)
        except LOST:
            self._kept["ended"] = dict(ended)  # to fetch after the next connection
            raise
        except AfspmError as error:
            if missing:  # it was stopped, which is no fault of a file
                text = "the %s was stopped, and has no file: %s; its data, which is not published, is kept in %s"
                self._log.warning(text, ended["what"], missing, file or self._written(content, ended, "-stopped"))
            else:
                what = ended["what"]
                self._log.error("the %s has no file (%s), and can't be fetched over TCP: %s", what, missed, error)
            self.broken_off = True
            return
        if ended["reported"] != "":
            self._log.warning("the %s has no complete file (%s); it was fetched over TCP", ended["what"], missed)
        path = self._written(content, ended)
        self._take(path, ended, read_result(path))

    def _written(self, content: Content, ended: Entry, mark: str = "") -> Path:
        self._kept["fetched"] += 1
        path = self._own_folder / f"nanonis-{self._kept['fetched']:04d}{mark}.nc"
        fetched.write(path, content, ended["end_ns"])
        return path

    def _take_followed(self, followed: Entry, now_s: float) -> None:
        file = self._file(followed)
        if file is not None and (content := self._whole(file)) is not None:
            self._add(str(file), followed, {}, _as_set(content, followed), [content])
            self._kept["followed"], self._has_followed = None, True
        elif now_s >= followed["fetch_at_s"]:
            self._kept["followed"] = None
            self._log.error("the scan before the present one is lost: its file %s is incomplete", followed["reported"])

    def _take(self, file: Path, ended: Entry, content: FileContent) -> None:
        self.newest_ns(Path(ended["folder"]), [file] if file.parent != self._own_folder else [], ended["what"])
        self._add(str(file), ended, {}, _as_set(content, ended), [content])
        self._kept["ended"] = None

    def _whole(self, file: Path) -> FileContent | None:
        try:
            content = read_result(file)
        except (AfspmError, OSError):
            return None  # incomplete: Nanonis is still writing it
        return None if lines_missing(content) else content

    def _file(self, ended: Entry) -> Path | None:
        if ended["reported"]:
            # the folder has another path on Nanonis' computer, but the file has the same name
            folder = self._session_dir
            path = Path(ended["reported"]) if folder is None else folder / PureWindowsPath(ended["reported"]).name
            return newest([path] if path.is_file() else [], ended["newest_ns"])[1]
        if ended["reported"] == "":
            return None
        return newest(_files(Path(ended["folder"]), ended["what"]), ended["newest_ns"])[1]


def _files(folder: Path, what: str) -> list[Path]:
    return list(folder.glob("*.sxm" if what == SCAN else "*.dat")) if folder.is_dir() else []


def _as_set(content: FileContent, entry: Entry) -> Content:
    return [_PRECISION.as_set(one, entry) for one in content]


def _points_missing(content: Content) -> str:
    # NaN where a stopped spectrum did not measure, as in scans (! stopped-spectrum)
    for one in content:
        if isinstance(one, Spectrum) and (points := int(np.isnan(one.values[:, 1:]).all(axis=1).sum())):
            return f"{points} of its {len(one.values)} points were not measured"
    return ""
