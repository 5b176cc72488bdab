"""A running experiment in words, for a terminal of any width, and as JSON. What is told comes from an `Overview`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from afspm.clock import NS_PER_S
from afspm.formatting import area_text, day_and_time, duration_text, time_of_day
from afspm.model import JournalEntry, LogLine, ProcessCondition, ProcessState, Region, ScopeState
from afspm.record.overview import OLD_S, OVER, Overview
from afspm.record.timeline import Span

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

BAR = 24
WELL = (ProcessCondition.ALIVE, ProcessCondition.BUSY)
LEVELS = {"WARNING": "yellow", "ERROR": "bold red", "CRITICAL": "bold red"}


@dataclass(frozen=True, slots=True)
class About:
    """What is known of a run besides what it publishes.

    Attributes:
        began_ns: experiment time at its start; None if it is not known.
        speed: experiment seconds in a real second.
        fancy: whether the terminal can show block characters.
    """

    name: str
    folder: str
    simulated: bool = False
    began_ns: int | None = None
    speed: float = 1.0
    fancy: bool = True


def bar(part: float, *, fancy: bool = True, width: int = BAR) -> str:
    """A part of a whole (0 to 1) as a bar."""
    full = min(width, max(0, round(part * width)))
    return ("█" * full + "░" * (width - full)) if fancy else "[" + "#" * full + "." * (width - full) + "]"


def screen(seen: Overview, about: About, now_ns: int, *, silent_s: float = 0.0, log_lines: int = 8) -> Group:
    """All that there is to see at a moment."""
    from rich.console import Group
    from rich.text import Text

    lines = [_head(seen, about, now_ns)]
    if silent_s > OLD_S:
        told = f"no news for {duration_text(silent_s)}: the scheduler is being started again, or can't be reached"
        lines.append(Text(told, "bold yellow"))
    lines += [_control(seen, now_ns), *_problems(seen, now_ns), _scanning(seen, about, now_ns)]
    lines += [
        *_progress(seen, about, now_ns),
        *_processes(seen, about, now_ns),
        *_refusals(seen),
        *_log(seen, log_lines),
    ]
    for line in lines:
        line.no_wrap, line.overflow = False, "fold"
    return Group(*lines)


def summary(seen: Overview, now_ns: int) -> str:
    """The most important in one line."""
    parts = [_control(seen, now_ns), *_problems(seen, now_ns), _microscope(seen, now_ns)]
    return "; ".join(" ".join(line.plain.split()) for line in parts)


def _label(name: str) -> Text:
    from rich.text import Text

    return Text.assemble((f"{name:11}", "dim"))


def _head(seen: Overview, about: About, now_ns: int) -> Text:
    from rich.text import Text

    line = Text.assemble((about.name, "bold"))
    if about.simulated:
        line.append("  SIMULATED", "bold red")
    line.append(f"  {day_and_time(now_ns)}")
    if about.began_ns is not None:
        line.append(f", running for {duration_text((now_ns - about.began_ns) / NS_PER_S)}")
    if about.speed != 1.0:
        line.append(f", {about.speed:g} x real time")
    return line


def _since(since_ns: int | None, now_ns: int) -> str:
    return "" if since_ns is None else f" for {duration_text((now_ns - since_ns) / NS_PER_S)}"


def _control(seen: Overview, now_ns: int) -> Text:
    line = _label("control")
    if seen.control is None:
        return line.append("not known yet")
    mode = seen.control.mode.name
    line.append(mode, "bold yellow" if mode == "MANUAL" else "")
    if mode == "MANUAL":
        return line.append(_since(seen.modes.changed_ns, now_ns))
    who = f"{seen.control.holder} is in control" if seen.control.holder else "nobody is in control"
    return line.append(f", {who}{_since(seen.control_since_ns, now_ns)}")


def flagged(seen: Overview) -> Iterator[tuple[int, str, Span | None]]:
    """(number, name, since when and by whom) of each problem that is flagged."""
    for number in seen.control.problems if seen.control else ():
        yield number, seen.problems.name(number), seen.problem_timelines[number].now


def _problems(seen: Overview, now_ns: int) -> Iterator[Text]:
    for _, name, span in flagged(seen):
        line = _label("problem").append(name, "bold red")
        if span is not None:
            line.append(_since(span.start_ns, now_ns))
            if span.by:
                line.append(f", flagged by {span.by}")
        yield line


def _microscope(seen: Overview, now_ns: int) -> Text:
    line = _label("microscope")
    if seen.status is None:
        return line.append("has not been heard of yet")
    now = seen.states.now
    line.append(seen.status.state.name.lower().replace("_", " "))
    if seen.status.paused:
        line.append(", paused", "yellow")
    return line.append(_since(now.start_ns if now else None, now_ns))


def _scanning(seen: Overview, about: About, now_ns: int) -> Text:
    """What the microscope does, and how far it is with a scan."""
    line = _microscope(seen, now_ns)
    if seen.status is None or seen.status.state is not ScopeState.SCANNING:
        return line
    if (progress := seen.scan_progress(now_ns)) is not None:
        line.append(f"  {_bar(progress[0], about)} {_left(progress[1], about)}")
    return line.append(f"  {_size(seen)}", "dim")


def _size(seen: Overview) -> str:
    parameters = seen.scan_parameters
    if parameters is None or not isinstance(parameters.region, Region):
        return ""
    pixels = f", {parameters.shape[1]} x {parameters.shape[0]}" if isinstance(parameters.shape, tuple) else ""
    return f"{area_text(parameters.region.size_m)}{pixels}"


def _bar(part: float, about: About) -> str:
    return f"{bar(part, fancy=about.fancy)} {100 * part:3.0f} %"


def _left(left_ns: int | None, about: About) -> str:
    if left_ns is None:
        return ""
    real = f" ({duration_text(left_ns / about.speed / NS_PER_S)} real)" if about.speed != 1.0 else ""
    return f"{duration_text(left_ns / NS_PER_S)} left{real}"


def _progress(seen: Overview, about: About, now_ns: int) -> Iterator[Text]:
    for told in seen.told_progress.values():
        if told.of <= 0:
            continue
        line = _label("progress").append(f"{told.name}: {told.done} of {told.of}  {_bar(told.done / told.of, about)} ")
        left_ns = told.remaining_ns(now_ns)
        if told.done >= told.of:
            yield line.append("done")
        else:
            yield line.append("longer than expected" if left_ns == 0 else _left(left_ns, about))


def _processes(seen: Overview, about: About, now_ns: int) -> Iterator[Text]:
    """Those that are well in one line; each of the others in its own."""
    states = seen.processes.values()
    running = [state.name for state in states if state.condition not in OVER]
    unheard = {name: ns for name in running if (ns := seen.unheard_ns(name, about.speed)) is not None}
    well = [state for state in states if state.condition in WELL and state.name not in unheard]
    if well:
        yield _label("processes").append(", ".join(map(_well, well)))
    for state in states:
        if state.name in unheard:
            line = _label("process").append(f"{state.name} ").append("not heard of", "bold red")
            yield line.append(
                f" for {duration_text(unheard[state.name] / NS_PER_S)}: whoever started it is gone, or can't be reached"
            )
        if state.name in unheard or state.condition in WELL:
            continue
        is_bad = state.condition in (ProcessCondition.SILENT, ProcessCondition.GIVEN_UP, ProcessCondition.RESTARTING)
        condition = state.condition.name.lower().replace("_", " ")
        line = _label("process").append(f"{state.name} ").append(condition, "bold red" if is_bad else "yellow")
        line.append(_lately(state, now_ns))
        yield line.append(f" ({state.last_exit})" if state.last_exit else "")


def _lately(state: ProcessState, now_ns: int) -> str:
    """Since when it is so; of what is over, when that was."""
    if state.condition is ProcessCondition.ENDED and state.since_ns is not None:
        return f" {duration_text((now_ns - state.since_ns) / NS_PER_S)} ago"
    return _since(state.since_ns, now_ns)


def _well(state: ProcessState) -> str:
    told = []
    if state.condition is ProcessCondition.BUSY and state.step_age_s >= 1.0:
        told.append(f"busy for {duration_text(state.step_age_s)}")
    if state.starts > 1:
        told.append(f"started {state.starts} times")
    return f"{state.name} ({', '.join(told)})" if told else state.name


def _refusals(seen: Overview, most: int = 3) -> Iterator[Text]:
    """The last; what was refused again and again in the same way, once."""
    last: dict[tuple[str, str, str], tuple[int, int]] = {}
    for entry in seen.refusals:
        key = (entry.who, entry.what, entry.reason)
        last[key] = (last.pop(key, (0, 0))[0] + 1, entry.time_ns)
    for (who, what, reason), (count, time_ns) in list(last.items())[-most:]:
        again = f" ({count} times)" if count > 1 else ""
        line = _label("refused").append(f"{time_of_day(time_ns)} {who}: {what}{again}")
        yield line.append(f": {reason}" if reason else "", "yellow")


def _log(seen: Overview, most: int) -> Iterator[Text]:
    if most > 0:
        yield from map(log_line, list(seen.log)[-most:])


def log_line(line: LogLine) -> Text:
    """What a process said, coloured by how bad it is."""
    from rich.text import Text

    text = Text.assemble((f"{time_of_day(line.time_ns)} ", "dim"), (f"{line.name} ", "cyan"))
    return text.append(line.text, LEVELS.get(line.level, ""))


def as_json(seen: Overview, about: About, now_ns: int) -> dict[str, Any]:
    """The same for programs. Times as ISO 8601 in UTC, durations in experiment seconds."""
    control, running = seen.control, seen.scan_progress(now_ns)
    return {
        "experiment": about.name,
        "folder": about.folder,
        "simulated": about.simulated,
        "time": _iso(now_ns),
        "mode": control.mode.name if control else None,
        "holder": control.holder if control else None,
        "since": _iso(seen.control_since_ns),
        "problems": [_problem_json(*problem) for problem in flagged(seen)],
        "state": seen.status.state.name if seen.status else None,
        "scan": None if running is None else {"part": round(running[0], 4), "remaining_s": running[1] / NS_PER_S},
        "progress": {
            name: _progress_json(told.done, told.of, told.remaining_ns(now_ns))
            for name, told in seen.told_progress.items()
        },
        "processes": [_process_json(state, seen, about) for state in seen.processes.values()],
        "refusals": [_entry_json(entry) for entry in seen.refusals],
        "log": [_line_json(line) for line in seen.log],
    }


def _problem_json(number: int, name: str, span: Span | None) -> dict[str, Any]:
    since_ns, by = (span.start_ns, span.by) if span else (None, "")
    return {"number": number, "name": name, "since": _iso(since_ns), "by": by}


def _progress_json(done: int, of: int, left_ns: int | None) -> dict[str, Any]:
    return {"done": done, "of": of, "remaining_s": None if left_ns is None else left_ns / NS_PER_S}


def _process_json(state: ProcessState, seen: Overview, about: About) -> dict[str, Any]:
    return {
        "heard_of": seen.unheard_ns(state.name, about.speed) is None,
        "name": state.name,
        "role": state.role,
        "condition": state.condition.name,
        "since": _iso(state.since_ns),
        "step_age_s": state.step_age_s,
        "starts": state.starts,
        "pid": state.pid,
        "last_exit": state.last_exit,
    }


def _entry_json(entry: JournalEntry) -> dict[str, Any]:
    return {"time": _iso(entry.time_ns), "who": entry.who, "what": entry.what, "reason": entry.reason}


def _line_json(line: LogLine) -> dict[str, Any]:
    return {"time": _iso(line.time_ns), "name": line.name, "level": line.level, "text": line.text}


def _iso(time_ns: int | None) -> str | None:
    return None if time_ns is None else datetime.fromtimestamp(time_ns / NS_PER_S, UTC).isoformat()
