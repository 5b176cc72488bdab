"""Replay of all components and the scheduler of a recorded run, with changes."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from afspm import Component, Run, open_run
from afspm.basics import NS_PER_S, ConfigError, FileError, InvalidValue, Launch, day_and_time, duration_text
from afspm.basics.named_imports import trusting_only
from afspm.client import port_log
from afspm.experiment import Experiment, importing_from, toml_text
from afspm.experiment.experiment import load_expanded
from afspm.experiment.parts import ExperimentPart
from afspm.model import Role
from afspm.record import EXPERIMENT_FILE, run_json_or_empty
from afspm.scheduler import step_log
from afspm.storage.line_log import REQUESTS_FOLDER, read_lines
from afspm.supervisor import FreePorts
from afspm.supervisor.own_runs import own_homes
from afspm.transport.process.loading import find_class
from afspm.transport.process.loading import load as load_class
from afspm_lab.what_if import component_replay, hash_seeds, scheduler_replay
from afspm_lab.what_if.alignment import Difference
from afspm_lab.what_if.component_replay import ComponentReplay
from afspm_lab.what_if.port_replay import Life, PacketOf, read_lives
from afspm_lab.what_if.scheduler_replay import SchedulerReplay

_SHIFTED_S = 1.0
_EMPTY = "its log is empty"
_SHORT_BY_S, _SHORT_BY_REAL_S = 60.0, 2.0
_UNRECORDED = {
    "has_people": "what people do at its pages is not in the record",
    "is_instrument": "the answers of its instrument are not in the record",
}
_PLACE = "source"  # the end of the keys with a file and line

Changes = Mapping[str, Mapping[str, object] | type[Component]] | str | Path | None


@dataclass(frozen=True)
class Row:
    """A row of the table, for one process.

    Attributes:
        same, added, removed, changed: numbers of outputs.
        counterfactual: number of differences after the first difference that reaches the microscope.
        note: limitation of the result, as text.
    """

    name: str
    same: int
    added: int
    removed: int
    changed: int
    counterfactual: int
    note: str = ""


@dataclass
class WhatIf:
    """Differences between a recorded run and its replay with a change.

    Attributes:
        run: folder of the recorded run.
        components: replays of components, by name.
        scheduler: replay of the scheduler; None if not replayed.
        controls: replays without the change, for each changed component that differs.
        unread: reasons why processes were not replayed, by name.
        left_out: reasons why processes were left out, by name.
        untried: reasons why a change of the experiment file was not tried, by the name of its table.
        simulated: whether the microscope was simulated.
        short: times at which logs end well before the run, by name: after a full disk, or a kill without a restart.
        subscribed: names of components whose subscriptions are in the experiment file, instead of the class.
    """

    run: Path
    components: dict[str, ComponentReplay] = field(default_factory=dict)
    scheduler: SchedulerReplay | None = None
    scheduler_name: str = "scheduler"
    controls: dict[str, ComponentReplay] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    untried: dict[str, str] = field(default_factory=dict)
    simulated: bool = False
    short: dict[str, int] = field(default_factory=dict)
    subscribed: Collection[str] = ()

    @property
    def first(self) -> Difference | None:
        """The first difference of all processes; None if there is none."""
        return min(self._firsts, key=lambda one: one.at_ns, default=None)

    @property
    def counterfactual_from_ns(self) -> int | None:
        """The time of the first difference that reaches the microscope; None if there is none."""
        return min((one.at_ns for one in self._all if one.reaches), default=None)

    @property
    def differences(self) -> list[Difference]:
        """All differences in order of time, marked as counterfactual after `counterfactual_from_ns`."""
        since_ns = self.counterfactual_from_ns
        marked = (
            replace(one, counterfactual=since_ns is not None and one.at_ns > since_ns)
            for one in sorted(self._all, key=lambda one: one.at_ns)
        )
        return list(marked)

    @property
    def differs(self) -> bool:
        return self.first is not None

    @property
    def hazards(self) -> dict[str, list[str]]:
        """Dependencies of components beyond their recorded inputs, by name."""
        replays = {**self.components, **self.controls}
        return {name: one.hazards for name, one in replays.items() if one.hazards}

    def table(self) -> list[Row]:
        """Return a row for each process, with counts of equal and different outputs.

        For a component that acts, differences after `counterfactual_from_ns` count as counterfactual only, since its
        recorded inputs no longer match its decisions.
        """
        acting = {name for name, one in self.components.items() if one.acts}
        rows = []
        by_name: dict[str, list[Difference]] = {}
        for one in self.differences:
            by_name.setdefault(one.component, []).append(one)
        sames = {name: one.same for name, one in self.components.items()}
        if self.scheduler is not None:
            sames[self.scheduler_name] = self.scheduler.same
        for name, same in sames.items():
            found = by_name.get(name, [])
            counted = [one for one in found if not (one.counterfactual and name in acting)]
            kinds = [one.kind for one in counted]
            rows.append(
                Row(
                    name, same, kinds.count("added"), kinds.count("removed"), kinds.count("changed"),
                    sum(one.counterfactual for one in found), self._note(name),
                )
            )  # fmt: skip
        return rows

    def _note(self, name: str) -> str:
        one, control = self.components.get(name), self.controls.get(name)
        notes = [one.stopped] if one is not None and one.stopped else []
        if one is None and name == self.scheduler_name and self.scheduler is not None:
            notes = [text for text in (self.scheduler.stopped, self.scheduler.note) if text]
        if one is not None and one.shifted_s > _SHIFTED_S:
            notes.append(f"the same outputs, up to {duration_text(one.shifted_s)} earlier or later")
        if one is not None and one.unheard and name not in self.subscribed:
            topics = " and ".join(prefix or "all messages" for prefix in one.unheard)
            notes.append(f"it listens to {topics}, too, which its record lacks")
        if (until_ns := self.short.get(name)) is not None:
            notes.append(f"its record ends at {day_and_time(until_ns, UTC)}, before the run")
        if control is not None and control.first is not None:
            notes.append("the unchanged component differs, too")
        elif control is not None:
            notes.append("the unchanged component repeats its record")
        return "; ".join(notes)

    @property
    def _firsts(self) -> list[Difference]:
        firsts = [one.first for one in self.components.values()]
        if self.scheduler is not None:
            firsts.append(self._named(self.scheduler.first))
        return [one for one in firsts if one is not None]

    @property
    def _all(self) -> list[Difference]:
        found = [one for replayed in self.components.values() for one in replayed.differences]
        if self.scheduler is not None:
            found += [one for one in map(self._named, self.scheduler.differences) if one is not None]
        return found

    def _named(self, one: Difference | None) -> Difference | None:
        return one and replace(one, component=self.scheduler_name)


def what_if(
    run: str | Path,
    changes: Changes = None,
    *,
    only: Collection[str] = (),
    import_from: Sequence[str | Path] = (),
    step: Callable[[str], None] = lambda _: None,
) -> WhatIf:
    """Replay a recorded run with changed components, and compare their outputs with the recorded outputs.

        r = afspm.what_if("runs/night-12", {"classifier": {"sigmas": 4.0}})
        r.first     # the first difference: its time, its packet, recorded and now
        r.table()   # for each component: same, added, removed, changed

    The run must have been recorded with `[record] requests = true`. Nothing outside a temporary folder is written. A
    process that can't be replayed is listed in `unread`, unless it was changed or chosen by `only`.

    Classes are imported from the folders of the experiment files only if this user has made the run, in this folder.
    Of any other run, classes are imported that installed packages declare for afspm, that the caller has imported
    already, or that are in `import_from`.

    Args:
        run: folder of the run.
        changes: new settings or another class, by the name of a component; or an experiment file that overrides the
            run's. None: only the installed version differs.
        only: names of processes to replay; empty: all.
        import_from: folders with trusted modules.
        step: called with each step of the work, for a line of progress.

    Raises:
        FileError: the run has no recorded requests, those of a changed or chosen process can't be read, or the
            experiment file of `changes` is missing.
        ConfigError: a changed or chosen component can't be created, or a name is unknown.
        InvalidValue: a change is neither settings nor a class.
    """
    with open_run(run) as record, _trusted(record.folder, import_from, *_files(changes)) as homes:
        logs = _logs(record.folder)
        changed, untried = _changed(record.folder, changes, logs, homes)
        unknown = {*(changes if isinstance(changes, Mapping) else ()), *only} - logs.keys()
        if unknown:
            raise ConfigError(
                f"the record has no requests of {', '.join(sorted(unknown))}",
                where=str(record.folder),
                hint=f"it has those of {', '.join(sorted(logs))}",
            )
        result = WhatIf(record.folder, left_out=_without_log(record, logs), simulated=record.simulated)
        result.untried = untried
        result.subscribed = _subscribed(record)
        packet_of = record.packet_lookup()
        for name, path in sorted(logs.items()):
            if only and name not in only:
                result.left_out[name] = "only others were chosen"
                continue
            step(f"replaying {name}")
            try:
                if path.name.endswith(step_log.SUFFIX):
                    _replay_scheduler(result, name, path, changed.get(name))
                else:
                    _replay(result, name, read_lives(path), packet_of, changed.get(name))
            except (FileError, ConfigError) as error:
                if name in changed or only:
                    raise
                result.unread[name] = str(error)
        result.short = _short(result, record)
        return result


def _replay_scheduler(result: WhatIf, name: str, path: Path, changed: Changed | None) -> None:
    made = scheduler_replay.replay_file(path, None if changed is None else changed[0])
    if not made.steps:
        result.unread[name] = _EMPTY
        return
    result.scheduler_name, result.scheduler = name, made


def _short(result: WhatIf, record: Run) -> dict[str, int]:
    ends = {name: one.until_ns for name, one in result.components.items()}
    if result.scheduler is not None:
        ends[result.scheduler_name] = result.scheduler.until_ns
    speed = float(run_json_or_empty(record.folder).get("clock", {}).get("speed", 1.0))
    latest_ns = record.newest_ns - round(max(_SHORT_BY_S, _SHORT_BY_REAL_S * speed) * NS_PER_S)
    return {name: until_ns for name, until_ns in ends.items() if until_ns is not None and until_ns < latest_ns}


Changed = tuple[Mapping[str, object] | None, component_replay.Make | None]


def _replay(
    result: WhatIf,
    name: str,
    lives: list[Life],
    packet_of: PacketOf,
    changed: Changed | None,
) -> None:
    if not lives:
        result.unread[name] = _EMPTY
        return
    if why := _unrecorded(lives[0].facts["launch"]["class"]):
        result.left_out[name] = why
        return
    settings, make = changed or (None, None)
    made = component_replay.replay(lives, packet_of, result.run, make=make or load_class, settings=settings)
    if made.first is not None and made.forbidden and changed is None:
        result.unread[name] = f"a replay does not allow what it does: it {made.forbidden}"
        return
    result.components[name] = made
    if made.first is None:
        return
    # is it the change? the unchanged component must repeat its record; if not, the watch finds its hidden dependencies
    control = component_replay.replay(lives, packet_of, result.run, watch=True)
    if changed is not None:
        result.controls[name] = control
    elif control.hazards:
        made.hazards += [one for one in control.hazards if one not in made.hazards]
    if control.first is not None and not control.hazards:
        control.hazards += hash_seeds.hazards(result.run, name)
        made.hazards += [one for one in control.hazards if one not in made.hazards]


def _unrecorded(class_path: str) -> str:
    try:
        class_ = find_class(class_path, "", of_process=True)
    except ConfigError:  # the replay has the error, unless the change gives another class
        return ""
    return next((why for mark, why in _UNRECORDED.items() if getattr(class_, mark, False)), "")


def _logs(folder: Path) -> dict[str, Path]:
    found = {}
    for path in (folder / REQUESTS_FOLDER).glob(f"*{port_log.SUFFIX}"):
        is_scheduler = path.name.endswith(step_log.SUFFIX)
        found[path.name.removesuffix(step_log.SUFFIX if is_scheduler else port_log.SUFFIX)] = path
    if not found:
        raise FileError(
            "this run has no recorded requests",
            where=str(folder),
            hint="set requests = true in [record] of the experiment file before a run",
        )
    return found


def _without_log(record: Run, logs: Mapping[str, Path]) -> dict[str, str]:
    why = (
        "its requests are not in this folder; only the scheduler and subclasses of Component keep them, where they run"
    )
    if not (record.folder / EXPERIMENT_FILE).is_file():
        return {}
    return {name: why for name, part in record.experiment.items() if _is_component(part) and name not in logs}


def _subscribed(record: Run) -> list[str]:
    if not (record.folder / EXPERIMENT_FILE).is_file():
        return []
    keys = {"envelopes", "subscriber"}
    return [name for name, part in record.experiment.items() if _is_component(part) and keys & part.keys()]


def _is_component(part: object) -> bool:
    return isinstance(part, dict) and bool(part.get("component"))


def _changed(
    folder: Path, changes: Changes, logs: Mapping[str, Path], homes: Sequence[Path]
) -> tuple[dict[str, Changed], dict[str, str]]:
    # the changes by name, and for each change that is not tried its reason
    if changes is None:
        return {}, {}
    if isinstance(changes, str | Path):
        return _changed_by_file(folder, Path(changes), logs, homes)
    found: dict[str, Changed] = {}
    for name, change in changes.items():
        if isinstance(change, type):
            found[name] = (None, _made_by(change))
        elif isinstance(change, Mapping):
            settings = {**_settings(logs[name]), **_in_si(folder, name, change, homes)} if name in logs else change
            found[name] = (settings, None)
        else:
            raise InvalidValue(
                f"a change can't be {change!r}", where=name, hint="give a dict of settings, or a class of a component"
            )
    return found, {}


def _in_si(folder: Path, name: str, change: Mapping[str, object], homes: Sequence[Path]) -> Mapping[str, object]:
    # texts may have units, as in an experiment file
    if not ('"' in json.dumps([*change.values()], default=repr) and (folder / EXPERIMENT_FILE).is_file()):
        return change
    with TemporaryDirectory(prefix="afspm-what-if-") as made:
        overlay = Path(made) / "changed.toml"
        try:
            overlay.write_text(toml_text({name: dict(change)}), encoding="utf-8")
        except (TypeError, ValueError):  # an object, for a class of the caller
            return change
        starts = changed_experiment(folder, homes, overlay).launches(take_address=FreePorts().address)
    settings = next((one.launch.settings for one in starts if one.launch.name == name), {})
    return {key: settings.get(key, value) for key, value in change.items()}


def _made_by(class_: type[Component]) -> component_replay.Make:
    return lambda launch: class_(**launch.settings)


def _settings(path: Path) -> dict[str, object]:
    launch = _launch(path)
    return dict(launch.settings)


def _launch(path: Path) -> Launch:
    for kind, facts, *_ in read_lines(path):
        if kind == "life":
            return Launch.from_json(json.dumps(facts.get("launch", facts)))
    raise FileError("has no beginning of a life", where=str(path))


def _changed_by_file(
    folder: Path, file: Path, logs: Mapping[str, Path], homes: Sequence[Path]
) -> tuple[dict[str, Changed], dict[str, str]]:
    if not file.is_file():
        raise FileError("there is no such file", where=str(file))
    experiment = changed_experiment(folder, homes, file)
    found: dict[str, Changed] = {}
    for start in experiment.launches(take_address=FreePorts().address):
        launch = start.launch
        if start.role is Role.TRANSLATOR or launch.name not in logs:
            continue
        before = _launch(logs[launch.name])
        if start.role is Role.SCHEDULER:
            launch = replace(launch, settings=at_recorded_places(before.settings, launch.settings))
        if (launch.class_, json.dumps(launch.settings)) == (before.class_, json.dumps(before.settings)):
            continue
        found[launch.name] = (launch.settings, _loaded_as(launch.class_))
    untried = _untried(changed_experiment(folder, homes), experiment, found, logs)
    if untried and not found:  # without an error this would look as if the change made no difference
        raise ConfigError(
            "nothing that this file changes can be tried: "
            + "; ".join(f"[{name}] {why}" for name, why in untried.items()),
            where=str(file),
            hint=f"the record has the requests of {', '.join(sorted(logs))}",
        )
    return found, untried


def at_recorded_places(before: object, now: object) -> Any:
    """Return changed settings of a scheduler in which each limit keeps its recorded file and line.

    A refusal names file and line, which would differ for the same limits in another file.
    """
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return now
    return {
        key: before[key] if key.endswith(_PLACE) and key in before else at_recorded_places(before.get(key), value)
        for key, value in now.items()
    }


def _untried(before: Experiment, now: Experiment, found: Collection[str], logs: Collection[str]) -> dict[str, str]:
    recorded, changed = ({part.name: part for part in one.parts.components} for one in (before, now))
    untried = dict.fromkeys(set(now.parts.unused) - {*before.parts.unused}, "is no process of the experiment")
    for name in sorted({**recorded, **changed}):
        if name in found or _content(recorded.get(name)) == _content(changed.get(name)):
            continue
        if name not in recorded:
            untried[name] = "is new, so the record has no inputs of it"
        elif name not in logs:
            untried[name] = "is changed, but its requests are not in the record"
        elif name not in changed:
            untried[name] = "is left out of the changed experiment, but is replayed as it was"
        else:
            untried[name] = "is replayed as it was: only other settings or another class can be tried"
    return untried


def _content(part: ExperimentPart | None) -> object:
    return part and (part.class_path, part.command, part.settings, part.own)


def _loaded_as(class_path: str) -> component_replay.Make:
    return lambda launch: load_class(replace(launch, class_=class_path))


def changed_experiment(folder: Path, homes: Sequence[Path], *files: Path) -> Experiment:
    """Return the experiment of a run, with overriding files applied.

    Args:
        homes: folders in which classes are found; at least one.

    Raises:
        ConfigError: the experiment has errors.
    """
    experiment = load_expanded(folder / EXPERIMENT_FILE, homes, *files)
    experiment.require_valid()
    return experiment


@contextmanager
def _trusted(folder: Path, import_from: Sequence[str | Path], *files: Path) -> Iterator[list[Path]]:
    # yields the folders in which classes are found
    given = [Path(path).resolve() for path in import_from]
    if missing := [path for path in given if not path.is_dir()]:
        raise FileError("there is no such folder", where=str(missing[0]), hint="see --import-from")
    own = own_homes(folder)
    if own is not None:  # as in the run, the user's classes are found beside the experiment files
        homes = [*own, *(file.resolve().parent for file in files), *given]
        with importing_from(homes):
            yield homes
        return
    with TemporaryDirectory(prefix="afspm-what-if-") as empty:  # without any folder, the run folder would be one
        homes = given or [Path(empty)]
        with importing_from(homes), trusting_only(homes):
            yield homes


def _files(changes: Changes) -> list[Path]:
    return [Path(changes)] if isinstance(changes, str | Path) else []
