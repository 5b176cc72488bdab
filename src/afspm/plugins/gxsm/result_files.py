"""Results of measurements: GXSM's files, one per channel of a scan, which appear late and one after the other."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from afspm.basics import NS_PER_S, AfspmError
from afspm.driver import (
    SCAN,
    Content,
    Entry,
    FileContent,
    FilePrecision,
    ResultFiles,
    as_region,
    lines_missing,
    modified_ns,
    read_result,
)
from afspm.model import Region
from afspm.plugins.gxsm.scan_memory import Rows, has_old_columns, in_files, is_unfinished

_NUMBERED: Final = re.compile(r"\d{3,}-((?:M-)?X[pm]-.+(?<!\.nc)\.nc)$")  # not ".nc.nc", which a person has typed
_PRECISION: Final = FilePrecision(part=1e-5, angle_rad=1e-6)
_CLOCK_NS: Final = 2 * NS_PER_S
"""Resolution of the start times in files, which have whole seconds, with a margin."""
LATE_S: Final = 20.0
"""Longest difference between the start delays of two scans; a start delay ends at the start time in the file."""
SOON_S: Final = 1.0
"""Longest wait for the file of a channel that the previous scan did not save either; measured: up to 0.3 s."""

_JUMP: Final = "its start: GXSM's clock was set since the scan before"
_REPLACED: Final = "another scan was begun at GXSM's panel before this one was saved: is Repeat on?"
_STOPPED: Final = "GXSM ended the scan before its last row, and no request had stopped it"
OLD_COLUMNS: Final = (
    "its first or last columns still hold the previous scan: is SubScan on at GXSM's panel? Then switch it off"
)


class GxsmFiles(ResultFiles):
    """The running or just ended measurement, and the results.

    Args:
        patience_s: longest wait for all files, experiment time.
        soon_s: longest wait for files of channels that the previous scan did not save, experiment time.
        late_s: longest difference between the start delays of two scans (`LATE_S`), experiment time.
        ends_early: True if GXSM's hardware may end a scan by itself, in its first rows (`few`).
    """

    def __init__(
        self,
        kept: Entry,
        log: logging.Logger,
        *,
        patience_s: float,
        soon_s: float,
        late_s: float,
        ends_early: bool = False,
    ) -> None:
        super().__init__(kept, log)
        self._patience_s = patience_s
        self._soon_s = soon_s
        self._late_ns = round(late_s * NS_PER_S)
        self._ends_early = ends_early
        self._by_hand = ""
        self._sizes: dict[Path, tuple[int, int]] = {}
        self._before: dict[Path, FileContent] = {}
        self._half: set[Path] = set()
        self._unsettled = False  # the last look found a new file, or one that had grown
        self._whole: dict[Path, FileContent] = {}
        self._outcome: bool | None = None  # of a measurement directly followed by the next
        self.upwards = False
        kept.setdefault("absent", [])
        kept.setdefault("channels", {})
        kept.setdefault("program", "")
        kept.setdefault("has_named", False)
        kept.setdefault("starts", [])  # start times in the last scan's files
        kept.setdefault("behind_ns", 0)  # lag of the clock in the files

    @property
    def scanning(self) -> tuple[Region, tuple[int, int]]:
        """Frame of the running scan, and (rows, columns). Valid during a scan only."""
        rows, columns = self._kept["running"]["shape"]
        return as_region(self._kept["running"]["frame"]), (rows, columns)

    @property
    def is_own(self) -> bool:
        return bool(self._kept["running"]["own"])

    @property
    def is_saved_by_gxsm(self) -> bool:
        return bool(self._kept["running"]["by_gxsm"])

    @property
    def before(self) -> tuple[Rows, int | None] | None:
        """Digests of rows in GXSM's memory before the running scan, and the scan's line at the time of reading.

        The line is None if the scan had not started. None: no rows were read.
        """
        found = self._kept["running"]["before"]
        return None if found is None else (found["rows"], found["line"])

    def looked(self, rows: Rows, line: int | None) -> None:
        """Store rows and line for `before`."""
        self._kept["running"]["before"] = {"rows": rows, "line": line}

    @property
    def place(self) -> list[float]:
        """Centre and angle of the frame at the start of the running scan, see `ScanFrame.place`."""
        found: list[float] = self._kept["running"]["place"]
        return found

    @property
    def spoiled(self) -> str:
        """The reason why the running measurement must not be published; empty: there is none."""
        return str(self._kept["running"]["spoiled"])

    def spoil(self, why: str) -> None:
        """Register a reason not to publish the running measurement; the first reason stays."""
        self._kept["running"]["spoiled"] = self.spoiled or why

    def ran(self) -> None:
        """Register that GXSM has shown the running measurement in its state."""
        self._kept["running"]["ran"] = True

    def stopped_by_hand(self) -> str:
        """Return once the evidence that a person stopped the last scan of the translator; empty: there is none."""
        found, self._by_hand = self._by_hand, ""
        return found

    def is_written(self, file: Path) -> bool:
        """Return True if the file is newer than all files in the folder at the start of the running measurement."""
        return modified_ns(file) > int(self._kept["running"]["newest_ns"])

    @property
    def has_named(self) -> bool:
        """True once GXSM has named the file of a channel in this run."""
        return bool(self._kept["has_named"])

    def named(self) -> None:
        """Register that GXSM names the file of a channel."""
        self._kept["has_named"] = True

    @property
    def channels(self) -> dict[str, list[str]]:
        """Name and unit of each channel of earlier scans, by the ending of its file's name."""
        found: dict[str, list[str]] = self._kept["channels"]
        return found

    @property
    def program(self) -> str:
        """GXSM's name and version, known only from its files; empty before the first file."""
        found: str = self._kept["program"]
        return found

    def begin(
        self, what: str, folder: Path | None, begun_ns: int, taken: Entry, *, own: bool = False, by_gxsm: bool = False
    ) -> None:
        """Register the start of a measurement. Unread files of the ended measurement are still awaited.

        Args:
            folder: folder of the measurement's files; None: unknown yet.
            begun_ns: earliest start; 0: not known, or a spectrum, whose file has no start time.
            taken: settings of the measurement: "frame", "shape" and "place" of a scan, "position" of a spectrum.
            own: True if the translator started the measurement.
            by_gxsm: True if GXSM saves by itself: files may appear before the end, and be written again.
        """
        self._by_hand = ""
        self._hurry(begun_ns / NS_PER_S)
        followed = self._kept["ended"]
        newest = self.newest_ns(folder, _files(folder, what), what)
        place = None if folder is None else str(folder)
        facts = {"folder": place, "newest_ns": newest, "begun_ns": begun_ns, "before": None, "spoiled": ""}
        self._begins(what, {**facts, "own": own, "by_gxsm": by_gxsm, "ran": False, **taken})
        if followed is not None:
            # GXSM saves a scan before it starts the next: all new files belong to the ended scan
            there = _files(_folder(followed), followed["what"])
            names = [str(file) for file in there if modified_ns(file) > followed["newest_ns"]]
            self._kept["ended"] = {**followed, "names": sorted(names)}

    def look(self, scans: Path | None, spectra: Path | None) -> None:
        """Register the files that are there before a measurement, in the folders of scans and spectra."""
        for what, folder in ((SCAN, scans), ("spectrum", spectra)):
            self.newest_ns(folder, _files(folder, what), what)

    def end(
        self,
        end_ns: int,
        now_ns: int,
        channels: Iterable[str] = (),
        folder: Path | None = None,
        *,
        is_whole: bool | None = True,
        has_more_rows: bool = False,
        before: Rows | None = None,
        near_end: bool = False,
    ) -> None:
        """Register the end of the measurement; its files are awaited from now on.

        Args:
            channels: path of each channel's file as reported by GXSM.
            folder: folder of the files, which may have changed since the start.
            is_whole: True if a scan reached its last row; False: the scan has no result; None: unknown until its files
                are compared with `before`.
            has_more_rows: True if an interrupted scan has scanned more than a few rows (`few`).
            before: rows of the previous scan, for `is_whole` None; without rows the scan has no result.
            near_end: True if a scan that is followed by the next at once was last seen in its last rows.
        """
        channels = list(channels)
        order = [next(iter(endings([Path(path)])), "") for path in channels]
        now_s = now_ns / NS_PER_S
        self._hurry(now_s)
        awaited = {"soon_s": now_s + self._soon_s, "until_s": now_s + self._patience_s}
        named = [Path(path).name for path in channels]
        facts = {"channels": order, "named": named, "before": before, "is_whole": is_whole, "near_end": near_end}
        self._ends({"end_ns": end_ns, **awaited, **facts})
        ended = self._kept["ended"]
        if folder is not None and str(folder) != ended["folder"]:  # old scans there are recognised by their start
            ended["folder"] = str(folder)
            ended["lasted_ns"] = end_ns - ended["begun_ns"] if ended["begun_ns"] else 0
            ended["begun_ns"] = ended["begun_ns"] or end_ns
        self._sizes, self._whole, self._before, self._half = {}, {}, {}, set()
        if is_whole is False:
            why = "it was stopped or never began: GXSM's first or last row still holds the previous scan"
            self._give_up(why, has_more_rows=has_more_rows)

    def _hurry(self, now_s: float) -> None:
        # The next measurement overwrites GXSM's memory and may overwrite files: read them now, or never.
        for _ in range(2):  # a file is read once it has not grown between two looks
            if self._is_followed:
                self.results(now_s)
        if self._is_followed:
            self._give_up("the next one was over before its files could be read")

    @property
    def _is_followed(self) -> bool:
        return self._kept["ended"] is not None and "names" in self._kept["ended"]

    def followed(self) -> bool | None:
        """Return once whether a measurement directly followed by the next has a result; None: nothing to report."""
        found, self._outcome = self._outcome, None
        return False if self._kept.pop("has_lost", False) else found

    def end_with_gxsm(self) -> None:
        """Give up the running measurement, since GXSM has ended and was started again.

        A scan that a person begins in the new GXSM must not be taken for it.
        """
        if self.what:
            self._log.error("the %s has no result: GXSM, which was started again, ended in it", self.what)
            self.forget()
            self._kept["has_lost"] = True  # until the next connection, which has a new object

    def forget(self) -> None:
        """Forget the running or ended measurement after a stop."""
        if self._is_followed:
            self._give_up("the one that followed it was stopped before its files were read")
        self._outcome = None
        super().forget()

    def next_s(self) -> float | None:
        """Return the deadline of awaited files, in experiment time; None: no files are awaited."""
        ended = self._kept["ended"]
        return None if ended is None else float(ended["until_s"])

    def results(self, now_s: float) -> list[str]:
        """Look for awaited files; return the last results, oldest first, named by one file and the end time in ns."""
        self.broken_off = False
        ended = self._kept["ended"]
        if ended is not None and ended["spoiled"]:
            self._give_up(ended["spoiled"])
        elif ended is not None:
            files = self._new(ended)
            is_followed = "names" in ended
            # the first look after a restart of GXSM or the translator may come after the deadline
            over = not self._unsettled and (now_s >= ended["until_s"] or (is_followed and not ended["names"]))
            gaps = [file for file, content in files.items() if lines_missing(content)]
            has_more_rows = any(
                lines_missing(content) < len(scan.values) - few(len(scan.values))
                for content in files.values()
                for scan in content.scans
            )
            if not any(scan.values.any() for content in files.values() for scan in content.scans):
                gaps = [file for file in files if ended["what"] == SCAN]  # stopped in its first line
                has_more_rows = False
            if gaps and (over or is_followed or not ended["by_gxsm"]):
                self._give_up(f"it was stopped: {gaps[0]} lacks lines", has_more_rows=has_more_rows)
            elif files and not gaps and (over or self._all(ended, files, now_s)):
                why = self._why_unfinished(ended, files) if ended["is_whole"] is None else ""
                if why:
                    self._give_up(why)
                else:
                    self._take(ended, files)
            elif over:
                self._give_up(self._missing(ended))
        return self._listed()

    def _why_unfinished(self, ended: Entry, files: Mapping[Path, FileContent]) -> str:
        before, named = ended["before"], endings(files)
        if before is None:
            return "one scan followed the other at once, and whether this one came to its end is unknown"
        numbered = {k: files[named[ending]] for k, ending in enumerate(ended["channels"]) if ending in named}
        saved = in_files(numbered, before)
        if is_unfinished(before, saved):
            return "it was stopped: its last row still holds the previous scan"
        if has_old_columns(before, saved):
            return OLD_COLUMNS
        return ""

    def read(self, entry: Entry) -> Content:
        contents = [self._whole.get(Path(file)) or read_result(file) for file in entry["files"]]
        return [_PRECISION.as_set(one, entry) for content in contents for one in content]

    def _new(self, ended: Entry) -> dict[Path, FileContent]:
        # Complete files only: a file is read once its size has been the same in two looks.
        found = {}
        self._unsettled = False
        not_before_ns = max(ended["newest_ns"], self._named_ns(ended))
        names = ended.get("names")
        there = _files(_folder(ended), ended["what"]) if names is None else [Path(name) for name in names]
        for file in sorted(file for file in there if file.exists()):
            stat = file.stat()
            if stat.st_mtime_ns <= not_before_ns:
                continue
            size = (stat.st_size, stat.st_mtime_ns)
            if self._sizes.get(file) != size:
                self._sizes[file] = size
                self._whole.pop(file, None)
                self._unsettled = True
            elif file not in self._whole:
                try:
                    self._whole[file] = read_result(file)
                except (AfspmError, OSError):
                    continue  # incomplete: GXSM is still writing it
            content = self._whole.get(file)
            self._half.discard(file)
            if content is None:
                continue
            is_before = self._is_of_before(content, ended["begun_ns"])
            if _is_half(content):
                if not is_before:  # in a folder that GXSM has not named before, all files are new
                    self._half.add(file)
            elif is_before:
                self._before[file] = content
            else:
                found[file] = content
        if ended["what"] == SCAN:  # one file for each channel: a person may save the scan again, under any name
            named = [file for file in found if file.name in ended.get("named", ())]
            ours = {**endings(found), **endings(named)}
            return {file: found[file] for file in ours.values()}
        return {file: found[file] for file in sorted(found, key=lambda file: file.stat().st_mtime_ns)[-1:]}

    def _named_ns(self, ended: Entry) -> int:
        # Of a folder that GXSM had not named at the start, only files that are hardly older than the named ones are
        # read: a folder of an earlier night may have hundreds.
        if not ended.get("lasted_ns"):
            return 0
        named = [modified_ns(Path(ended["folder"], name)) for name in ended["named"]]
        return min(named, default=0) - int(ended["lasted_ns"]) - self._late_ns

    def _is_of_before(self, content: FileContent, begun_ns: int) -> bool:
        # Files have the time of GXSM's computer, whose clock may differ from this one and be set at any time. A start
        # before the last scan's start, by GXSM's clock, therefore means that the clock was set back, not that the scan
        # is old.
        start_ns, known = content.start_ns, self._kept["starts"]
        if start_ns is None:
            return False
        if start_ns in known:
            return True
        if known and start_ns < max(known):
            return False  # the clock was set back, or the picture of another scan was opened: see `_facts`
        return start_ns + int(self._kept["behind_ns"]) < begun_ns - (self._late_ns if known else _CLOCK_NS)

    def _before_named(self, ended: Entry) -> dict[Path, FileContent]:
        # files of this scan, by their names, with the start of an earlier one: its picture was opened in the channel
        return {file: content for file, content in self._before.items() if file.name in ended.get("named", ())}

    def _facts(self, ended: Entry, files: Mapping[Path, FileContent]) -> dict[str, object]:
        # A picture that a person opens in the window of a channel during a scan takes its place, with its start and the
        # end of the scan. After a jump of GXSM's clock start and end are as far apart as they should be.
        starts = [one.start_ns for one in files.values() if one.start_ns]
        ends = [one.end_ns for one in files.values() if one.end_ns]
        facts: dict[str, object] = {"pictures": max(len(one.scans) for one in files.values())}
        begun_ns = ended["begun_ns"]
        if not (self._kept["starts"] and starts and ends and begun_ns):
            return facts
        if abs(min(starts) + self._kept["behind_ns"] - begun_ns) > self._late_ns:
            at_most_ns = ended["end_ns"] - begun_ns
            is_jump = max(ends) - min(starts) <= at_most_ns + _CLOCK_NS
            facts |= {"at_most_ns": at_most_ns, "unproved": [_JUMP] if is_jump else []}
        return facts

    def _saw(self, ended: Entry, starts: set[int]) -> None:
        self._kept["starts"] = sorted(starts)
        self._kept["behind_ns"] = ended["begun_ns"] - max(starts) if starts and ended["begun_ns"] else 0

    def _all(self, ended: Entry, files: Iterable[Path], now_s: float) -> bool:
        # A channel that the previous scan did not save either is awaited for a short time only.
        if "names" in ended:
            return all(Path(name) in self._whole for name in ended["names"])
        missing = set(ended["channels"]) - endings(files).keys() - endings(self._before_named(ended)).keys() - {""}
        return not missing or (missing <= set(self._kept["absent"]) and now_s >= ended["soon_s"])

    def _missing(self, ended: Entry) -> str:
        if "names" in ended and ended.get("near_end"):
            return "it came to its end, but the next one began and GXSM had saved no file: Movie or Multi Layer?"
        if "names" in ended:
            return "another one began before it was saved: it was stopped, or GXSM saved no file of it"
        folder = _folder(ended)
        if folder is None:
            return "GXSM does not say where it saves: check that it began and that a channel is set"
        if not folder.is_absolute():
            return f"its folder {folder} is relative to where GXSM was started: set scan_dir, probe_dir"
        if not folder.is_dir():
            return f"its folder {folder} does not exist on this computer: set scan_dir and probe_dir"
        if self._before:
            return f"GXSM saved an earlier scan in {folder}: check that this one began"
        if self._half:
            return f"{min(self._half)} was saved before the scan had ended, and GXSM has not saved it again"
        if ended["what"] == SCAN:
            return (
                f"no new file in {folder} belongs to it: close GXSM's dialog if one is open, and check that a channel "
                "is set and saved (AS)"
            )
        return f"no new .vpdata in {folder}: switch on Auto Save of probes in GXSM, and set probe_dir to its folder"

    def _give_up(self, why: str, *, has_more_rows: bool | None = None) -> None:
        # `has_more_rows`: None if the scan does not lack rows
        ended, self._kept["ended"] = self._kept["ended"], None
        is_stopped = has_more_rows or (has_more_rows is False and not self._ends_early)
        if (is_stopped or "names" in ended) and ended["what"] == SCAN and ended["own"] and ended["ran"]:
            self._by_hand = ended["spoiled"] or (_REPLACED if "names" in ended else _STOPPED)
        self._log.error("the %s has no result: %s", ended["what"], why)
        if self._before:
            self._saw(ended, {content.start_ns for content in self._before.values() if content.start_ns})
        if "names" in ended:
            self._outcome = False
        else:
            self.broken_off = True

    def _take(self, ended: Entry, files: Mapping[Path, FileContent]) -> None:
        facts, of_another = self._facts(ended, files), self._before_named(ended)
        if ended["what"] == SCAN:
            for file in sorted(self._half):
                self._log.warning("%s is left out: it was saved before the scan had ended", file)
            absent = sorted(set(ended["channels"]) - endings({**files, **of_another}).keys() - {""})
            if set(absent) - set(self._kept["absent"]):
                self._log.warning(
                    "GXSM did not save %s; from now on the translator waits for it for a short time only",
                    ", ".join(absent),
                )
            self._kept["absent"] = absent
            if facts.get("at_most_ns") is None or facts["unproved"]:
                self._saw(ended, {content.start_ns for content in files.values() if content.start_ns})
            self.upwards = any(content.upwards for content in files.values())
            for ending, file in endings(files).items():
                scan, header = files[file].scans[0], files[file].header
                self._kept["program"] = f"{header.get('Creator', '')} {header.get('Version', '')}".strip()
                self._kept["channels"][ending] = [scan.channel, scan.unit]
        self.newest_ns(_folder(ended), files, ended["what"])
        names = [str(file) for file in files]
        # the end time makes the name unique: SRanger overwrites files of spectra
        content = [_PRECISION.as_set(one, ended) for file in files.values() for one in file]
        stating = [*files.values(), *of_another.values()]
        self._add(f"{names[0]} ({ended['end_ns']})", ended, {"files": names, **facts}, content, stating)
        self._kept["ended"] = None
        if "names" in ended:
            self._outcome = True


def _is_half(content: FileContent) -> bool:
    # a scan that a person saves while it runs has no end, or the end of the scan before
    start_ns, end_ns = content.start_ns, content.end_ns
    return bool(content.scans) and start_ns is not None and (end_ns is None or end_ns < start_ns)


def few(rows: int) -> int:
    """Return the number of rows after which GXSM's simulator does not end a scan by itself."""
    # one or two rows in 60 such ends, more than two in one, while the computer was overloaded
    return max(2, rows // 8)


def endings(files: Iterable[Path]) -> dict[str, Path]:
    """Return the last file of each channel, by the part of its name after the number; other files are left out."""
    named = ((_NUMBERED.search(file.name), file) for file in files)
    return {match[1]: file for match, file in named if match}


def _folder(ended: Entry) -> Path | None:
    return None if ended["folder"] is None else Path(ended["folder"])


def _files(folder: Path | None, what: str) -> list[Path]:
    if folder is None or not folder.is_dir():
        return []
    return list(folder.glob("*.nc" if what == SCAN else "*.vpdata"))
