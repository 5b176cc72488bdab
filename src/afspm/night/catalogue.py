"""The catalogue of all runs under a folder, with an SQLite index that can be rebuilt at any time."""

from __future__ import annotations

import json
import os
import re
import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics.argument_checks import PATH, Argument, checked, is_text
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import FileError, InvalidValue
from afspm.basics.formatting import counted
from afspm.basics.plain_data import Plain
from afspm.model import ControlRequest, ControlResponse, JournalEntry
from afspm.model.parameter_names import BASE_ACTIONS
from afspm.model.planned_work import path_length_m
from afspm.night.bad_scans import BAD
from afspm.night.run import Run, open_run
from afspm.night.tables import ScanRow
from afspm.record import describe_state
from afspm.record.journal import not_a_table
from afspm.record.run_json import RUN_FILE
from afspm.wire.messages import CONTROL_STATE, DRIFT_RESCAN, JOURNAL

INDEX_FILE: Final = "runs.sqlite"
_FORMAT: Final = 3
_WATCHED: Final = (RUN_FILE, "journal.sqlite", "journal.sqlite-wal")
"""Files of a run whose change shows that the run has changed."""
_SEARCHED: Final = ("sample", "person", "project", "technique", "probe")
_WORDS: Final = Argument(
    "a list of texts",
    lambda value: isinstance(value, Sequence) and not isinstance(value, str) and all(map(is_text, value)),
    'e.g. ["sample:gold"]',
)
_WORD: Final = re.compile(r"(?:(\w+):)?(.+)", re.DOTALL)


@dataclass(frozen=True)
class RunSummary:
    """The summary of one run.

    Attributes:
        folder: path of the run, relative to the folder of all runs, with "/".
        name: the name of the experiment.
        began_ns, ended_ns: first control state, and end, in experiment time, or else first and last publication; None
            if nothing was published.
        state: running, ended or cut off, in words.
        metadata: sample, person, project, technique … where known.
        scans, spectra: the numbers of complete scans, and of spectra.
        problems: the names of all flagged problems, except routine flags.
        notes: the texts of all notes.
        scanned_m: the path of the probe in scans, trace and retrace, in metres.
        treatments: the number of successful executions of each action beside the base actions, by name.
        judged: the number of scans with a verdict on the tip, and of scans with a good last verdict.
        damage: the reason why the record can't be read; empty for a readable record.
    """

    folder: str
    name: str
    began_ns: int | None = None
    ended_ns: int | None = None
    state: str = ""
    metadata: Mapping[str, str] = field(default_factory=dict)
    simulated: bool = False
    scans: int = 0
    spectra: int = 0
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    scanned_m: float = 0.0
    treatments: Mapping[str, int] = field(default_factory=dict)
    judged: tuple[int, int] = (0, 0)
    damage: str = ""

    @property
    def measured(self) -> str:
        scans, spectra = counted(self.scans, "scan"), counted(self.spectra, "spectrum", "spectra")
        return f"{scans}, {spectra}" if self.spectra else scans

    def texts(self) -> dict[str, str]:
        """Return the searched fields, by name."""
        lists = {"problem": self.problems, "note": self.notes}
        texts = {"folder": self.folder, "name": self.name, "state": self.state, "microscope": self.microscope}
        texts |= {name: self.metadata.get(name, "") for name in _SEARCHED}
        return texts | {name: "\n".join(all_) for name, all_ in lists.items()}

    @property
    def microscope(self) -> str:
        return " ".join(filter(None, (self.metadata.get("vendor"), self.metadata.get("microscope"))))


FIELDS: Final = tuple(RunSummary("", "").texts())
"""The fields that a search may name, as `field:word`."""


@checked({"root": PATH, "words": _WORDS})
def find_runs(
    root: str | Path, words: Sequence[str] = (), since: date | None = None, until: date | None = None
) -> list[RunSummary]:
    """Return the runs under a folder whose texts contain all words, the newest first.

    Args:
        root: the folder to search with all its subfolders. The index `runs.sqlite` is written there, if possible.
        words: each in any field, or as "sample:gold" in that field; case is ignored.
        since, until: days (UTC). Runs that ended before `since` or began after `until` are left out.

    Raises:
        FileError: there is no such folder.
        InvalidValue: a word names an unknown field.
    """
    wanted, root = [_read_word(word) for word in words], Path(root)
    if not root.is_dir():
        raise FileError(
            "there is no such folder", where=str(root), hint="runs are in runs/, or in the folder of --runs"
        )
    found = [run for run in _up_to_date(root) if _was_within(run, since, until) and _has(run.texts(), wanted)]
    return sorted(found, key=lambda run: (run.began_ns or 0, run.folder), reverse=True)


def _read_word(word: str) -> tuple[str, str]:
    match = _WORD.fullmatch(word.strip())
    if match is None:
        raise InvalidValue(f"{word!r} is not a word to search for", hint='e.g. "gold" or "sample:gold"')
    if match[1] and match[1] not in FIELDS:
        raise InvalidValue(f"runs have no {match[1]!r} to look in", hint=f"there are {', '.join(FIELDS)}")
    return match[1] or "", match[2].casefold()


def _has(texts: Mapping[str, str], words: Sequence[tuple[str, str]]) -> bool:
    folded = {name: text.casefold() for name, text in texts.items()}
    return all(word in folded[name] if name else any(word in text for text in folded.values()) for name, word in words)


def _was_within(run: RunSummary, since: date | None, until: date | None) -> bool:
    # a run without known start or end overlaps no days
    if run.began_ns is None or run.ended_ns is None:
        return since is None and until is None
    starts_ns = None if since is None else _midnight_ns(since)
    ends_ns = None if until is None else _midnight_ns(until + timedelta(days=1))
    return (starts_ns is None or run.ended_ns >= starts_ns) and (ends_ns is None or run.began_ns < ends_ns)


def _midnight_ns(day: date) -> int:
    return int(datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()) * NS_PER_S


# --- the index: the summary of each run, until the run changes ------------------------------------------------------


def _up_to_date(root: Path) -> list[RunSummary]:
    with closing(_opened(root)) as index:
        known = {folder: (stamp, about) for folder, stamp, about in index.execute("SELECT * FROM runs")}
        read: list[tuple[RunSummary, str]] = []
        for path in _folders(root):
            # taken before the run is read: packets recorded meanwhile are then read next time
            folder, stamp = path.relative_to(root).as_posix(), _stamp(path)
            known_stamp, about = known.get(folder, ("", ""))
            is_known = known_stamp == stamp
            read.append((_from_json(about) if is_known else replace(_summary(path), folder=folder), stamp))
        with suppress(sqlite3.OperationalError), index:  # a disk that is full or can't be written to costs time alone
            # rewritten as a whole, so that deleted runs disappear
            index.execute("DELETE FROM runs")
            rows = [(run.folder, stamp, json.dumps(asdict(run))) for run, stamp in read]
            index.executemany("INSERT INTO runs VALUES (?, ?, ?)", rows)
    return [run for run, _ in read]


def _opened(root: Path) -> sqlite3.Connection:
    # a damaged index, or one of another version, is rebuilt; where the folder can't be written, the index is in memory
    file = root / INDEX_FILE
    # the second attempt creates the index again after a damaged one was removed
    for _ in range(2):
        try:
            return _prepared(sqlite3.connect(file))
        except sqlite3.OperationalError:
            break
        except (sqlite3.DatabaseError, ValueError):
            file.unlink(missing_ok=True)
    return _prepared(sqlite3.connect(":memory:"))


def _prepared(index: sqlite3.Connection) -> sqlite3.Connection:
    try:
        (version,) = index.execute("PRAGMA user_version").fetchone()
        if version not in (0, _FORMAT):
            raise ValueError("of another version")
        # an index may come with a folder from another person, like a journal
        if not_a_table(index):
            raise ValueError("not made by afspm")
        index.execute("CREATE TABLE IF NOT EXISTS runs (folder TEXT PRIMARY KEY, stamp TEXT NOT NULL, about TEXT)")
        index.execute(f"PRAGMA user_version = {_FORMAT}")
    except BaseException:  # only to close: every error is raised again
        index.close()
        raise
    return index


def _folders(root: Path) -> Iterator[Path]:
    # links are not followed: `latest` points to a run that is listed anyway
    for folder, inner, files in os.walk(root):
        if RUN_FILE in files:
            inner.clear()
            yield Path(folder)


def _stamp(folder: Path) -> str:
    stamps = []
    for name in _WATCHED:
        with suppress(OSError):
            stat = (folder / name).stat()
            if stat.st_size:  # SQLite's readers leave empty files
                stamps.append(f"{name} {stat.st_mtime_ns}/{stat.st_size}")
    return " ".join(stamps)


def _from_json(text: str) -> RunSummary:
    about: Plain = json.loads(text)
    lists = {name: tuple(about[name]) for name in ("problems", "notes", "judged")}
    return RunSummary(**{one.name: about[one.name] for one in fields(RunSummary)} | lists)


def _summary(folder: Path) -> RunSummary:
    try:
        with open_run(folder) as run:
            return _read(run)
    except FileError as error:
        return RunSummary("", folder.name, damage=error.what)
    except Exception as error:  # broad: a folder of another person may hold anything, and must not hide all other runs
        return RunSummary("", folder.name, damage=f"is damaged: {type(error).__name__}: {error}")


def _read(run: Run) -> RunSummary:
    # rescans are needed to recognise routine flags of thermal-drift
    overview = run.overview((CONTROL_STATE.name, JOURNAL.name, DRIFT_RESCAN.name))
    began = next(iter(overview.timelines.control.spans), None)
    scans = run.scans
    return RunSummary(
        folder="",
        name=run.name,
        began_ns=(run.oldest_ns or None) if began is None else began.start_ns,
        ended_ns=overview.ended_ns or run.newest_ns or None,
        state=describe_state(run.folder),
        metadata=run.metadata,
        simulated=run.simulated,
        scans=sum(not scan.interrupted for scan in scans),
        spectra=len(run.spectra),
        problems=tuple(sorted({span.label for span in overview.problem_spans})),
        notes=tuple(note.text for note in run.notes),
        scanned_m=sum(_scanned_m(run, scan) for scan in scans),
        treatments=dict(Counter(entry.what for entry in run.journal if _is_treatment(entry))),
        judged=_judged(run.verdicts()),
    )


def _scanned_m(run: Run, scan: ScanRow) -> float:
    # the path of the probe along the lines of a scan, trace and retrace; 0 if no line was seen
    if scan.region is None or scan.shape is None:
        return 0.0
    rows = scan.shape[0]
    if scan.interrupted:
        with suppress(FileError):  # a damaged scan counts as complete, which is the upper bound
            first = next(iter(run.scan(scan).values()))
            rows = int(np.isfinite(first.values).any(axis=1).sum())
    return path_length_m(scan.region, rows)


def _is_treatment(entry: JournalEntry) -> bool:
    is_done = entry.request == ControlRequest.ACTION and entry.response == ControlResponse.SUCCESS
    return is_done and entry.what not in BASE_ACTIONS


def _judged(verdicts: Sequence[tuple[int, float]]) -> tuple[int, int]:
    last = dict(verdicts)
    return len(last), sum(score != BAD for score in last.values())


UNNAMED = ""
"""The name of the probe in runs whose [metadata] names none."""


@dataclass(frozen=True)
class ProbeHistory:
    """The use of one probe over all its runs.

    Attributes:
        name: the name in [metadata] `probe`; `UNNAMED` for all runs without a name, perhaps several probes.
        runs: the folders of the runs, oldest first.
        first_ns, last_ns: start of the first and end of the last run, in experiment time; None: not known.
        scans, spectra: numbers of complete scans and of spectra.
        scanned_m: the path along scan lines, trace and retrace, in metres.
        treatments: the number of executions of each treatment, by the name of its action.
        flagged: the number of runs in which a problem was flagged.
        judged, good: the number of scans with a verdict on the tip, and of scans with a good last verdict.
        simulated: whether all runs were simulated.
    """

    name: str
    runs: tuple[str, ...]
    first_ns: int | None
    last_ns: int | None
    scans: int
    spectra: int
    scanned_m: float
    treatments: Mapping[str, int]
    flagged: int
    judged: int
    good: int
    simulated: bool


def probe_histories(runs: Iterable[RunSummary]) -> list[ProbeHistory]:
    """Return a history for each probe, the most recently used first. Damaged runs are left out."""
    by_probe: dict[str, list[RunSummary]] = {}
    for run in sorted(runs, key=lambda run: (run.began_ns or 0, run.folder)):
        if not run.damage:
            by_probe.setdefault(run.metadata.get("probe", UNNAMED), []).append(run)
    histories = [_history(name, used) for name, used in by_probe.items()]
    return sorted(histories, key=lambda probe: probe.last_ns or 0, reverse=True)


def _history(name: str, runs: list[RunSummary]) -> ProbeHistory:
    treatments: Counter[str] = Counter()
    for run in runs:
        treatments.update(run.treatments)
    return ProbeHistory(
        name=name,
        runs=tuple(run.folder for run in runs),
        first_ns=min((run.began_ns for run in runs if run.began_ns is not None), default=None),
        last_ns=max((run.ended_ns for run in runs if run.ended_ns is not None), default=None),
        scans=sum(run.scans for run in runs),
        spectra=sum(run.spectra for run in runs),
        scanned_m=sum(run.scanned_m for run in runs),
        treatments=dict(treatments.most_common()),
        flagged=sum(bool(run.problems) for run in runs),
        judged=sum(run.judged[0] for run in runs),
        good=sum(run.judged[1] for run in runs),
        simulated=all(run.simulated for run in runs),
    )
