"""`afspm run --resume`: continues a killed or stopped run in its folder."""

from __future__ import annotations

import json
import re
import socket
import sqlite3
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.errors import ConfigError, FileError
from afspm.basics.plain_data import Plain
from afspm.client.connect import find_run
from afspm.experiment import Experiment, load, load_expanded
from afspm.record import REPLAY_OF, lock_run, read_run_json
from afspm.record.journal import open_to_read
from afspm.record.run_json import EXPERIMENT_FILE, STATE_DIR
from afspm.record.run_lock import quoted, resume_command
from afspm.storage import log_folder, logged_packets
from afspm.storage.atomic import load_checkpoint
from afspm.supervisor import run as running
from afspm.supervisor.own_runs import HOMES
from afspm.supervisor.ports import require_free, require_limits
from afspm.supervisor.run import FILES, HOW, ONLY, RUN, WITHOUT, FinishedRun, RunOptions
from afspm.supervisor.run_identity import RunIdentity, new_identity
from afspm.supervisor.supervision.run_end import EndReason
from afspm.supervisor.supervisor import TOLERANCE_S

_OVER = {reason.name.lower() for reason in EndReason if reason.is_final}
_LOOPBACK = re.compile(r"tcp://(127\.0\.0\.1|localhost|\*|0\.0\.0\.0):(\d+)")
ZMTP = b"\xff"
"""First byte that a ZeroMQ socket sends."""
# orphans end within seconds; the reaper kills the rest
GONE_WITHIN_S = 10.0
STEP_NS = 1_000_000
"""Simulated time between the last packet and the resumed run, so that no two packets have the same time."""


@dataclass(frozen=True)
class ResumableRun:
    """A run that can be continued.

    Attributes:
        homes: folders of the original experiment files.
        added: names of components that the run did not have before.
    """

    folder: Path
    name: str
    experiment: Experiment
    facts: Plain
    homes: tuple[Path, ...]
    added: tuple[str, ...] = ()

    def with_overlay(self, file: Path) -> ResumableRun:
        """Return the same run with the additions of an overlay file."""
        experiment = load_expanded(self.folder / EXPERIMENT_FILE, self.homes, file)
        before = self.experiment.component_names
        added = [name for name in experiment.component_names if name not in before]
        return replace(self, experiment=experiment, added=(*self.added, *added))

    def options(self, options: RunOptions) -> RunOptions:
        """Return the options restricted to the processes that ran on this computer, and to added components."""
        names = self.experiment.component_names  # without components added by an overlay at an earlier resume
        only, without = ([name for name in self.facts.get(which, ()) if name in names] for which in (ONLY, WITHOUT))
        return replace(options, only=(*only, *self.added) if only else (), without=tuple(without))


def find(where: Path) -> ResumableRun:
    """Return the run at `where`: its folder, the folder of all runs (the newest), or its experiment file.

    Raises:
        FileError: there is no run, or one of its files can't be read.
        ConfigError: the run has ended or is a replay, or the experiment file at `where` was edited since its start.
    """
    folder = find_run(where).resolve()
    facts = read_run_json(folder)
    if REPLAY_OF in facts:
        raise ConfigError("this is a replay, and not a run", where=str(folder), hint=f"it is of {facts[REPLAY_OF]}")
    if facts.get(HOW) in _OVER:
        raise ConfigError("this run has ended normally", where=str(folder), hint="`afspm run FILE` begins another")
    file = folder / EXPERIMENT_FILE
    if not file.is_file() or not (folder / STATE_DIR).is_dir():
        raise FileError("this is not the folder of a run", where=str(folder), hint="it lacks its experiment or state")
    homes = tuple(map(Path, facts.get(HOMES, []))) or (folder,)
    experiment = load_expanded(file, homes)
    if where.suffix == ".toml":
        begun_with = [Path(name) for name in facts.get(FILES, ())]
        refuse_edited(begun_with if where.resolve() in begun_with else [where], experiment, folder)
    return ResumableRun(folder, str(facts.get("name", folder.name)), experiment, facts, homes)


def resume(found: ResumableRun, options: RunOptions, terminal: TextIO | None = None) -> FinishedRun:
    """Continue a run until it ends; every process starts from its saved memory.

    Raises:
        FileError: the run is still going on. Other errors as from `run.run`.
    """
    experiment, folder, facts = found.experiment, found.folder, found.facts
    options = found.options(options)
    experiment.require_valid(options.only, options.without)
    with lock_run(folder):
        _wait_until_gone(facts, folder)
        starts = running.dry_run(experiment, options)
        common = running.common_identity(
            experiment, starts, _resumed_identity(experiment, options, found), options, terminal
        )
        if facts.get(RUN) and common.run != facts[RUN]:
            what = "the scheduler has begun another run meanwhile"
            raise ConfigError(what, where=str(folder), hint="begin a new run here, too: `afspm run FILE --only …`")
        require_free(running.addresses_of(starts))
        require_limits(len(starts))
        names = [*facts.get("processes", ()), *found.added]
        return running.go(experiment, options, common, folder, found.name, terminal, names)


def _resumed_identity(experiment: Experiment, options: RunOptions, found: ResumableRun) -> RunIdentity:
    # Simulated time goes on after the last time in the record. If only some processes are resumed, those on other
    # computers have kept the old clock, so it is kept here.
    facts = found.facts
    simulated = bool(facts.get("simulated")) or experiment.simulated(options.only, options.without)
    if not simulated:
        clock = _real_clock_after(found.folder, experiment.clock())
    elif options.only or options.without:
        clock = ExperimentClock.from_dict(facts["clock"])
    else:
        clock = _clock_after(facts, found.folder)
    return RunIdentity(clock, str(facts.get(RUN) or new_identity()), simulated)


def _real_clock_after(folder: Path, clock: ExperimentClock) -> ExperimentClock:
    # Where the wall clock was set back (a battery is empty, or it was wrong before), components would wait until it
    # has caught up, and packets would get times that are not theirs.
    seen_ns = last_seen_ns(folder)
    if seen_ns <= clock.now_ns() + round(TOLERANCE_S * NS_PER_S):
        return clock
    return ExperimentClock.starting_now((seen_ns + STEP_NS) / NS_PER_S)


def _clock_after(facts: Plain, folder: Path) -> ExperimentClock:
    before = ExperimentClock.from_dict(facts["clock"])
    seen_ns = max(last_seen_ns(folder), round(before.start_s * NS_PER_S))
    return ExperimentClock.starting_now((seen_ns + STEP_NS) / NS_PER_S, before.speed)


def last_seen_ns(folder: Path) -> int:
    """Return the latest experiment time in the files of a run's folder; 0 if there is none."""
    seen = [0]
    state = folder / STATE_DIR
    seen += [entry.packet.time_ns or 0 for entry in logged_packets(log_folder(state))]
    for file in state.glob("*.json"):
        try:
            kept, _ = load_checkpoint(file, json.loads)
        except FileError:
            continue
        translator = kept.get("translator", {}) if isinstance(kept, dict) else {}
        for values in (kept, translator):
            if isinstance(values, dict):
                seen += [values[name] for name in ("last_ns", "seen_ns") if isinstance(values.get(name), int)]
    with suppress(FileError, sqlite3.DatabaseError):  # damaged: the recorder moves it aside
        journal = open_to_read(folder)
        with closing(journal):
            newest = journal.execute("SELECT coalesce(max(time_ns), 0) FROM packets WHERE source = ''")
            seen.append(newest.fetchone()[0])
    return max(seen)


def _wait_until_gone(facts: Plain, folder: Path) -> None:
    # processes that lost their parent end by themselves, within seconds; two of one name must not share a folder
    until_s = ExperimentClock.real().monotonic_s() + GONE_WITHIN_S
    ports = {
        int(match[2]): name
        for name, process in facts.get("processes", {}).items()
        for use in ("publish", "serve")
        if (match := _LOOPBACK.fullmatch(str(process.get(use))))
    }
    if not ports:
        return
    with ThreadPoolExecutor(len(ports)) as pool:  # on Windows a refused connection takes two seconds
        for name, is_gone in zip(ports.values(), pool.map(lambda port: _is_gone(port, until_s), ports), strict=True):
            if not is_gone:
                hint = "end it, then resume the run"
                raise FileError(f"{name} of this run is still running", where=str(folder), hint=hint)


def _is_gone(port: int, until_s: float) -> bool:
    # a listener that ends closes the connection, which is noticed at once
    clock = ExperimentClock.real()
    while (left_s := until_s - clock.monotonic_s()) > 0.0:
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=left_s) as peer:
                if peer.recv(1) not in (b"", ZMTP):
                    return True  # another program has the port by now
                while peer.recv(1024):
                    peer.settimeout(max(0.001, until_s - clock.monotonic_s()))
        except TimeoutError:
            return False
        except OSError:
            return True
    return False


def refuse_edited(files: Sequence[Path], begun: Experiment, folder: Path) -> None:
    """Refuse to resume the run in `folder` if its experiment files have changed: limits, for instance.

    Args:
        files: files that the run was started with.
        begun: the experiment as it was at the start.

    Raises:
        ConfigError: the files now describe another experiment.
    """
    differs = differing(_expanded(begun), _expanded(load(*files)))
    if differs:
        named = " ".join(map(quoted, files))
        raise ConfigError(
            f"was edited since this run was begun, which goes on as it was: {'; '.join(differs)}",
            where=", ".join(map(str, files)),
            hint=f"{resume_command(folder)} goes on without what was edited, "
            f"`afspm run {named}` begins a new run with it",
        )


def _expanded(experiment: Experiment) -> dict[str, object]:
    # both files expanded, so that a default written out by hand counts as no difference
    experiment.resolved  # noqa: B018  (adds what the file leaves open)
    return tomllib.loads(experiment.expanded(secrets=False))


def differing(before: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """Return the differences of two expanded experiment files: each differing section with its keys."""
    found = []
    for name in {**before, **now}:
        then, later = before.get(name), now.get(name)
        if then == later:
            continue
        if isinstance(then, dict) and isinstance(later, dict):
            keys = [key for key in {**then, **later} if then.get(key) != later.get(key)]
            found.append(f"[{name}] {', '.join(keys)}")
        elif isinstance(then, dict) or isinstance(later, dict):
            found.append(f"[{name}] is {'new' if then is None else 'gone'}")
        else:
            found.append(name)
    return found
