"""Replay of a recorded scheduler's decisions: its pure core gets the recorded inputs, step by step."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import NoReturn

from afspm.basics import ConfigError, ExperimentClock, FileError, Launch, PlainList, WireError
from afspm.components import restored
from afspm.scheduler import SavedState, Scheduler, SchedulerCore, WireCodec, events
from afspm.scheduler.coordinate_frame import TIP_FRAME, CoordinateFrame
from afspm.scheduler.saved_state import KIND as STATE_KIND
from afspm.scheduler.saved_state import VERSION as STATE_VERSION
from afspm.scheduler.step_log import Restored, StateSums, Step, facts_of, read_cached, read_event
from afspm.storage.line_log import read_lines
from afspm.transport import ProcessActivity, ProcessContext
from afspm.transport.process.loading import load as load_class
from afspm_lab.what_if.alignment import Difference, Output, PacketName, aligned

MakeCore = Callable[[], SchedulerCore]
CoreOf = Callable[[Launch], tuple[MakeCore, CoordinateFrame]]
_REACHING = ("Forward", "Kill")


@dataclass
class SchedulerReplay:
    """The result of a replay of a scheduler.

    Attributes:
        steps: number of steps compared.
        same: number of equal effects.
        differences: all differences, in order of the steps.
        first: the first difference; None if all effects are equal.
        first_step: the first step, counted from 1, with a different state or effect; None if all effects are equal.
        stopped: reason why the replay ended before the record; empty for a complete replay.
        note: limitation of the result, as text.
        until_ns: time of the last step; None if there is none.
    """

    steps: int
    same: int
    differences: list[Difference]
    first: Difference | None
    first_step: int | None = None
    stopped: str = ""
    real_s: float = 0.0
    recorded_s: float = 0.0
    note: str = ""
    until_ns: int | None = None


def read_steps(path: Path, core_of: CoreOf) -> Iterator[tuple[MakeCore, Restored] | Step]:
    """Yield the start of each life of a scheduler, followed by its steps.

    Raises:
        FileError: the file can't be read, or is not a step log.
        ConfigError: a scheduler can't be created.
    """
    frame: CoordinateFrame = TIP_FRAME
    try:
        for kind, *rest in read_lines(path):
            if kind == "life":
                launch, saved, cached = rest
                state = None if saved is None else restored(SavedState, saved, STATE_KIND, STATE_VERSION)
                make, frame = core_of(Launch.from_json(json.dumps(launch)))
                yield make, Restored(state, read_cached(cached))
            elif kind == "step":
                event, *more = rest
                yield Step(read_event(event, frame.reports), *more)
    except (IndexError, KeyError, TypeError, ValueError, WireError) as error:
        raise FileError(f"is not a step log: {error!r}", where=str(path)) from error


def replay_file(path: Path, settings: Mapping[str, object] | None = None) -> SchedulerReplay:
    """Replay the scheduler of a run.

    Args:
        settings: settings that replace all settings of the launch line; None: the recorded settings.

    Raises:
        FileError: the file can't be read, or is not a step log.
        ConfigError: the settings can't be used.
    """
    return replay(read_steps(path, lambda launch: _core_of(launch, settings)))


def replay(recorded: Iterable[tuple[MakeCore, Restored] | Step]) -> SchedulerReplay:
    """Feed recorded inputs to new scheduler cores, and compare the effects.

    Args:
        recorded: for each life, first the function that makes its core and the restored state, then the steps.
    """
    before, now = list[Output](), list[Output]()
    core: SchedulerCore | None = None
    steps, life, stopped, note = 0, 0, "", ""
    parted: int | None = None  # step since which the states differ
    first: Difference | None = None
    sums = StateSums()
    began_s, times = time.perf_counter(), list[int]()
    for one in recorded:
        if not isinstance(one, Step):
            make, beginning = one
            life, core, sums = life + 1, make(), StateSums()
            if beginning.saved is not None:
                core.restore(beginning.saved)
            core.restore_cache(beginning.cached)
            continue
        if core is None:
            continue
        steps += 1
        times = [*times[:1], one.now_ns]
        if isinstance(one.event, events.FrameReported):
            note = "results of the coordinate frame's worker are the recorded ones"
        try:
            made = _stepped(core, one)
        except Exception as error:  # changed decisions may fail on inputs of another night, and in any way
            stopped = f"step {steps} fails: {type(error).__name__}: {error}"
            made = [["error", "", stopped]]
        effects = json.loads(json.dumps(made))
        if parted is None and (effects != one.effects or sums.changed(core.state) != one.state):
            parted = steps
        place = PacketName(one.now_ns, _input_name(one.event))
        before += [_output(facts, place, life) for facts in one.effects]
        now += [_output(facts, place, life) for facts in effects]
        if first is None and effects != one.effects:
            first = _first(one.effects, effects, place, life)
        if stopped:
            break
    real_s, recorded_s = time.perf_counter() - began_s, (times[-1] - times[0]) / 1e9 if times else 0.0
    until_ns = times[-1] if times else None
    if first is None:
        return SchedulerReplay(steps, len(before), [], None, None, stopped, real_s, recorded_s, note, until_ns)
    same, differences = aligned("scheduler", before, now)
    return SchedulerReplay(steps, same, differences, first, parted, stopped, real_s, recorded_s, note, until_ns)


def _stepped(core: SchedulerCore, one: Step) -> list[PlainList]:
    if one.event is None:
        return [*map(facts_of, core.start(one.now_s, one.now_ns))]
    return [*map(facts_of, core.step(one.event, one.now_s, one.now_ns))]


def _first(recorded: list[PlainList], now: list[PlainList], place: PacketName, life: int) -> Difference:
    before, after = next((a, b) for a, b in zip_longest(recorded, now) if a != b)
    if before is not None and after is not None and before[:2] != after[:2]:  # one of them lacks an effect
        before, after = (before, None) if len(recorded) > len(now) else (None, after)
    there = None if before is None else _output(before, place, life)
    here = None if after is None else _output(after, place, life)
    if before is not None and after is not None and before[0] == "SaveState":
        parts = ", ".join(name for name, total in before[3].items() if after[3].get(name) != total)
        here = None if here is None else replace(here, text=f"saves another state: {parts}")
    return Difference("scheduler", there, here)


def _output(facts: PlainList, place: PacketName, life: int) -> Output:
    kind, key, text, *rest = facts
    reaches = kind in _REACHING
    return Output(kind, key, json.dumps([text, *rest]), text, place, place.time_ns, life, reaches)


def _input_name(event: events.Input | None) -> str:
    match event:
        case None:
            return "start"
        case events.PacketIn(packet):
            return packet.envelope
        case events.RequestIn(_, name, request):
            return f"request of {name}: {request.subject}"
        case _:
            return type(event).__name__


def _core_of(launch: Launch, settings: Mapping[str, object] | None) -> tuple[MakeCore, CoordinateFrame]:
    launch = replace(launch, settings=launch.settings if settings is None else dict(settings), keeps_requests=False)
    scheduler = load_class(launch)
    if not isinstance(scheduler, Scheduler):
        raise ConfigError(f"{launch.class_} is not afspm's scheduler", where=launch.name)
    clock = ExperimentClock.real()  # the settings do not depend on it
    context = ProcessContext(launch, clock, _no_port, logging.getLogger("afspm.what_if"), ProcessActivity(clock))
    frame = scheduler.coordinates(context, in_process=True).frame  # its worker is never started
    core_settings = scheduler.settings(context)
    return (lambda: SchedulerCore(core_settings, WireCodec(), frame)), frame


def _no_port(*_: object) -> NoReturn:
    raise AssertionError("the decisions open no port")
