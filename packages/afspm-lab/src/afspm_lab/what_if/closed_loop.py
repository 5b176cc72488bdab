"""Closed-loop rerun: a simulated night is run again with a change, and the outcomes are compared."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TextIO, TypeAlias

from afspm import Run, open_run
from afspm.basics import NS_PER_S, ConfigError, InvalidValue, Plain, PlainMapping, duration_text, from_json, utc_time
from afspm.experiment import toml_text
from afspm.record import ENDED, EXPERIMENT_FILE, run_json_or_empty
from afspm.report.story import RunStory
from afspm.report.story import read as read_story
from afspm.supervisor import RunOptions, run_experiment
from afspm.supervisor.own_runs import own_homes
from afspm_lab.what_if.what_if import changed_experiment

_TRUTH = "truth.jsonl"
_LASTED = "lasted"
_ALIKE, _ALIKE_REAL_S = 0.01, 5.0
_DAMAGE = ("pulse", "crash")

SettingChanges: TypeAlias = Mapping[str, Mapping[str, object]]
"""New settings, by the name of a component."""


@dataclass(frozen=True)
class Outcomes:
    """Outcomes of a recorded run and its rerun.

    Attributes:
        folder: folder of the new run.
        rows: texts for the recorded and the new run, by heading.
        lasted_alike: whether the durations differ by no more than the durations of two equal nights.
    """

    folder: Path
    rows: Mapping[str, tuple[str, str]]
    lasted_alike: bool = False

    @property
    def differs(self) -> bool:
        ignored = {_LASTED} if self.lasted_alike else set()
        return any(before != now for head, (before, now) in self.rows.items() if head not in ignored)


def rerun(
    run: str | Path,
    changes: SettingChanges | str | Path,
    *,
    runs: Path = Path("runs"),
    terminal: TextIO | None = None,
) -> Outcomes:
    """Run a simulated night again with a change and the same seeds, and compare the outcomes.

    Args:
        changes: settings by the name of a component, or an experiment file that overrides the run's.
        runs: parent folder of the new run.

    Raises:
        InvalidValue: the run was not made by this user in this folder, was not simulated, has not ended, or a change is
            not a table of settings.
        ConfigError: the changed experiment has errors.
    """
    with open_run(run) as record, TemporaryDirectory(prefix="afspm-what-if-") as made:
        facts = run_json_or_empty(record.folder)
        homes = _own_homes(record.folder)
        _require_simulated(record, facts)
        overlay = Path(made) / "changed.toml"
        overlay.write_text(_overlay(changes, facts), encoding="utf-8")
        files = _files(changes)
        experiment = changed_experiment(
            record.folder, [*homes, *(file.resolve().parent for file in files)], *files, overlay
        )
        speed = facts.get("clock", {}).get("speed")
        ended = run_experiment(experiment, RunOptions(runs=runs, speed=speed, report=False), terminal)
        with open_run(ended.folder) as again:
            return Outcomes(ended.folder, _rows(record, again), _lasted_alike(record, again, speed))


def _own_homes(folder: Path) -> list[Path]:
    if (homes := own_homes(folder)) is None:
        raise InvalidValue(
            "this run is not known as one of yours, and to run it again starts the programs that it names",
            where=str(folder),
            hint=f"if you trust them: afspm run {folder / EXPERIMENT_FILE}",
        )
    return homes


def _require_simulated(record: Run, facts: PlainMapping) -> None:
    if not record.simulated:
        raise InvalidValue(
            "only a simulated night can be run again", where=str(record.folder), hint="without --closed it is replayed"
        )
    if ENDED not in facts:
        raise InvalidValue("the run has not ended", where=str(record.folder), hint="compare it once it has")


def _files(changes: SettingChanges | str | Path) -> list[Path]:
    return [] if isinstance(changes, Mapping) else [Path(changes)]


def _overlay(changes: SettingChanges | str | Path, facts: PlainMapping) -> str:
    # the new night begins at the experiment time of the recorded one
    start_s = facts.get("clock", {}).get("start_s")
    start: dict[str, object] = {}
    if start_s is not None:
        begun: datetime = utc_time(round(start_s * NS_PER_S))
        start = {"clock": {"start": begun}}
    tables = dict(changes) if isinstance(changes, Mapping) else {}
    for name, table in tables.items():
        if not isinstance(table, Mapping):
            raise InvalidValue(f"[{name}] of a night that is run again must be settings, not {table!r}")
    try:
        return toml_text({**start, **tables})
    except (TypeError, ValueError) as error:
        raise ConfigError(f"the changes can't be written as TOML: {error}") from error


def _rows(before: Run, now: Run) -> dict[str, tuple[str, str]]:
    sides = [(read_story(one), one, _truth(one.folder)) for one in (before, now)]
    texts = {head: tuple(text(*side) for side in sides) for head, text in _OUTCOMES.items()}
    return {head: (both[0], both[1]) for head, both in texts.items()}


def _lasted_alike(before: Run, now: Run, speed: float | None) -> bool:
    # the start of the processes takes real time, which is a part of the night
    lasted_s, lasts_s = (read_story(one).lasted_ns / NS_PER_S for one in (before, now))
    return abs(lasted_s - lasts_s) <= max(_ALIKE * lasted_s, _ALIKE_REAL_S * (speed or 1.0))


def _truth(folder: Path) -> list[Plain]:
    lines: dict[int, Plain] = {}  # after a kill of the microscope the last line may come twice
    with suppress(OSError):
        for text in (folder / _TRUTH).read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):
                line = from_json(text)
                lines[line["n"]] = line
    return list(lines.values())


def _usable(_: RunStory, run: Run, truth: list[Plain]) -> str:
    # by the truth, not by the verdicts of the night: the change may concern the verdicts
    scans = [line.get("scan", {}).get("tips") for line in truth if line.get("event") == "scan"]
    known = [tips for tips in scans if tips]
    return f"{sum(not any(tip['flaws'] for tip in tips) for tips in known)} of {len(known)}" if known else "unknown"


def _damage(_: RunStory, run: Run, truth: list[Plain]) -> str:
    counts = Counter(line["event"] for line in truth if line.get("event") in _DAMAGE)
    return ", ".join(f"{count} × {name}" for name, count in sorted(counts.items())) or "none"


_OUTCOMES: Mapping[str, Callable[[RunStory, Run, list[Plain]], str]] = {
    _LASTED: lambda story, run, truth: duration_text(story.lasted_ns / NS_PER_S),
    "whole scans": lambda story, run, truth: str(len(story.scans) - story.interrupted),
    "interrupted scans": lambda story, run, truth: str(story.interrupted),
    "scans with a sharp tip": _usable,
    "spectra": lambda story, run, truth: str(story.spectra),
    "problems": lambda story, run, truth: str(len(story.problems)),
    "treatments of the tip": _damage,
    "refusals": lambda story, run, truth: str(sum(one.count for one in story.refusals)),
}
