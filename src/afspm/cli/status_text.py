"""Status of a running experiment, as text for a terminal of any width and as JSON. The data are from an `Overview`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from afspm import wire
from afspm.basics import time_of_day, utc_time
from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import area_text, day_and_time, duration_text
from afspm.model import LogLine, ProcessCondition, ProcessState, Progress, Region, ScopeState
from afspm.night import OVER, ROUTINE, Overview, Plans, Span
from afspm.night.overview import OLD_S

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

BAR = 24
# processes in these conditions share one line; all others have a line each
WELL = (ProcessCondition.ALIVE, ProcessCondition.BUSY)
BAD = (ProcessCondition.SILENT, ProcessCondition.GIVEN_UP, ProcessCondition.RESTARTING)
LEVELS = {"WARNING": "yellow", "ERROR": "bold red", "CRITICAL": "bold red"}
_PROCESS = ("name", "role", "step_age_s", "starts", "pid", "last_exit")


@dataclass(frozen=True, slots=True)
class RunDescription:
    """Facts about a run that are not in its packets.

    Attributes:
        replay_of: folder of the replayed run; empty if this is no replay.
        began_ns: experiment time at its start; None if unknown.
        plans: planned work of each component; None: no estimate.
        speed: experiment seconds per real second.
        fancy: whether the terminal can show block characters.
    """

    name: str
    folder: str
    simulated: bool = False
    replay_of: str = ""
    began_ns: int | None = None
    speed: float = 1.0
    fancy: bool = True
    plans: Plans = field(default_factory=dict)


def bar(part: float, *, fancy: bool = True, width: int = BAR) -> str:
    full = min(width, max(0, round(part * width)))
    return ("█" * full + "░" * (width - full)) if fancy else "[" + "#" * full + "." * (width - full) + "]"


def flagged(seen: Overview) -> Iterator[tuple[int, str, Span | None]]:
    """Yield each flagged problem: its number, its name, and the span with start and source of the flag, if known."""
    for number in seen.control.problems if seen.control else ():
        yield number, seen.problems.name(number), seen.timelines.problems[number].now


def problems_as_json(seen: Overview) -> list[dict[str, object]]:
    """Return the flagged problems for programs."""
    return [
        {
            "number": number,
            "name": name,
            "since": _iso(span.start_ns if span else None),
            "by": span.by if span else "",
        }
        for number, name, span in flagged(seen)
    ]


def log_line(line: LogLine) -> Text:
    from rich.text import Text

    text = Text.assemble((f"{time_of_day(line.time_ns)} ", "dim"), (f"{line.name} ", "cyan"))
    return text.append(line.text, LEVELS.get(line.level, ""))


class StatusText:
    """The status of a run at one moment of experiment time, as text and as JSON."""

    def __init__(self, seen: Overview, run: RunDescription, now_ns: int) -> None:
        self._seen = seen
        self._run = run
        self._now_ns = now_ns

    def screen(self, *, silent_s: float = 0.0, log_lines: int = 8) -> Group:
        from rich.console import Group
        from rich.text import Text

        lines = [self._head()]
        if silent_s > OLD_S:
            warning = f"no news for {duration_text(silent_s)}: the scheduler is restarting, or can't be reached"
            lines.append(Text(warning, "bold yellow"))
        lines += [
            self._control(),
            *self._tip(),
            *self._problems(),
            *self._waits(),
            *self._lent(),
            self._scanning(),
            *self._progress(),
            *self._end(),
            *self._drift(),
        ]
        lines += self._processes()
        lines += self._refusals()
        lines += self._announced()
        lines += self._notes()
        lines += map(log_line, list(self._seen.log)[-log_lines:] if log_lines > 0 else ())
        for line in lines:
            line.no_wrap, line.overflow = False, "fold"
        return Group(*lines)

    def summary(self) -> str:
        """Return control, problems and state of the microscope in one line."""
        return "; ".join(
            " ".join(line.plain.split()) for line in (self._control(), *self._problems(), self._microscope())
        )

    def _head(self) -> Text:
        from rich.text import Text

        run = self._run
        line = Text.assemble((run.name, "bold")).append("  REPLAY" if run.replay_of else "", "bold yellow")
        line.append("  SIMULATED" if run.simulated else "", "bold red")
        line.append(f"  {day_and_time(self._now_ns)}")
        if run.began_ns is not None:
            line.append(f", running{self._since(run.began_ns)}")
        return line.append(f", {run.speed:g} x real time" if run.speed != 1.0 else "")

    def _since(self, since_ns: int | None) -> str:
        return "" if since_ns is None else f" for {duration_text((self._now_ns - since_ns) / NS_PER_S)}"

    def _control(self) -> Text:
        line, seen = _label("control"), self._seen
        if seen.control is None:
            return line.append("not known yet")
        mode = seen.control.mode.name
        line.append(mode, "bold yellow" if mode == "MANUAL" else "")
        if mode == "MANUAL":
            line.append(self._since(seen.timelines.mode.changed_ns))
            return line.append(f": {seen.by_hand}", "yellow") if seen.by_hand else line
        return line.append(f", {seen.in_control or 'nobody'} is in control{self._since(seen.control_since_ns)}")

    def _tip(self) -> Iterator[Text]:
        tip = self._seen.tip
        if tip is not None and tip.by_hand:
            yield _label("tip").append(f"{tip}; {tip.remedy}" if tip.remedy else str(tip), "yellow")

    def _problems(self) -> Iterator[Text]:
        for _, name, span in flagged(self._seen):
            is_routine = self._seen.is_routine(span)
            line = _label("problem").append(name, "" if is_routine else "bold red")
            if span is not None:
                line.append(f"{self._since(span.start_ns)}{f', flagged by {span.by}' if span.by else ''}")
            if is_routine:
                line.append(f": {ROUTINE}", "dim")
            yield line

    def _waits(self) -> Iterator[Text]:
        for entry in self._seen.waits_at(self._now_ns):
            until = time_of_day(entry.again_ns or 0)
            yield _label("waits").append(f"{entry.who} until {until}: {entry.reason}", "yellow")

    def _lent(self) -> Iterator[Text]:
        for loan in self._seen.loans:
            line = _label("lent").append(loan.text.replace(", lent by", ", by"))
            line.append("; others may have changed it" if loan.is_unsure else "", "yellow")
            yield line.append(f"; not set back: {loan.why}" if loan.why else "", "bold red")
        for one in self._seen.overruled:
            yield _label("settings").append(one.text, "yellow")

    def _microscope(self) -> Text:
        line, status = _label("microscope"), self._seen.status
        if status is None:
            return line.append("has not reported yet")
        now = self._seen.timelines.scope_state.now
        line.append(status.state.name.lower().replace("_", " ")).append(", paused" if status.paused else "", "yellow")
        return line.append(self._since(now.start_ns if now else None))

    def _scanning(self) -> Text:
        line, seen = self._microscope(), self._seen
        if seen.status is None or seen.status.state is not ScopeState.SCANNING:
            return line
        if (progress := seen.scan_progress(self._now_ns)) is not None:
            line.append(f"  {self._bar(progress[0])} {self._left(progress[1])}")
        parameters = seen.readings.scan_parameters
        if parameters is None or not isinstance(parameters.region, Region):
            return line
        pixels = f", {parameters.shape[1]} x {parameters.shape[0]}" if isinstance(parameters.shape, tuple) else ""
        size = area_text(parameters.region.size_m)
        return line.append(f"  {size if self._run.fancy else size.replace('µ', 'u')}{pixels}", "dim")

    def _bar(self, part: float) -> str:
        return f"{bar(part, fancy=self._run.fancy)} {100 * part:3.0f} %"

    def _left(self, left_ns: int | None) -> str:
        if left_ns is None:
            return ""
        speed = self._run.speed
        real = f" ({duration_text(left_ns / speed / NS_PER_S)} real)" if speed != 1.0 else ""
        return f"{duration_text(left_ns / NS_PER_S)} left{real}"

    def _progress(self) -> Iterator[Text]:
        for report in self._seen.progress_at(self._now_ns).values():
            if report.of <= 0:
                continue
            left_ns = report.remaining_ns(self._now_ns)
            left = "longer than expected" if left_ns == 0 else self._left(left_ns)
            left += f", ends {day_and_time(self._now_ns + left_ns, seconds=False)}" if left_ns else ""
            count = f"{report.name}: {report.done} of {report.of}  {self._bar(report.done / report.of)} "
            yield _label("progress").append(count + ("done" if report.done >= report.of else left))

    def _end(self) -> Iterator[Text]:
        if (end_ns := self._end_ns()) is not None:
            left = self._left(end_ns - self._now_ns) if end_ns > self._now_ns else "later than expected"
            yield _label("end").append(f"about {day_and_time(end_ns, seconds=False)}, {left}")

    def _end_ns(self) -> int | None:
        return self._seen.expected_end_ns(self._run.plans, self._run.began_ns, self._now_ns)

    def _drift(self) -> Iterator[Text]:
        if registered := self._seen.registration:
            yield _label("drift").append(registered)

    def _processes(self) -> Iterator[Text]:
        seen, states = self._seen, self._seen.processes.values()
        running = [state.name for state in states if state.condition not in OVER]
        unheard = {name: ns for name in running if (ns := seen.silent_ns(name, self._run.speed)) is not None}
        well = [_well(state) for state in states if state.condition in WELL and state.name not in unheard]
        if well:
            yield _label("processes").append(", ".join(well))
        for state in states:
            line = _label("process").append(f"{state.name} ")
            if state.name in unheard:
                gone = duration_text(unheard[state.name] / NS_PER_S)
                line.append("no report", "bold red")
                yield line.append(f" for {gone}: its supervisor is gone, or can't be reached")
            elif state.condition not in WELL:
                condition = state.condition.name.lower().replace("_", " ")
                line.append(condition, "bold red" if state.condition in BAD else "yellow").append(
                    self._changed_since(state)
                )
                yield line.append(f" ({state.last_exit})" if state.last_exit else "")

    def _changed_since(self, state: ProcessState) -> str:
        if state.condition is ProcessCondition.ENDED:
            return f" {duration_text((self._now_ns - state.since_ns) / NS_PER_S)} ago"
        return self._since(state.since_ns)

    def _refusals(self, most: int = 3) -> Iterator[Text]:
        last: dict[tuple[str, str, str], tuple[int, int]] = {}
        for entry in self._seen.refusals:
            key = (entry.who, entry.what, entry.reason)
            last[key] = (last.pop(key, (0, 0))[0] + 1, entry.time_ns)
        for (who, what, reason), (count, time_ns) in list(last.items())[-most:]:
            again = f" ({count} times)" if count > 1 else ""
            line = _label("refused").append(f"{time_of_day(time_ns)} {who}: {what}{again}")
            yield line.append(f": {reason}" if reason else "", "yellow")

    def _notes(self, most: int = 3) -> Iterator[Text]:
        numbers = {scan.time_ns: scan.number for scan in self._seen.scans}
        for note in list(self._seen.notes)[-most:]:
            on = f" on scan {numbers[note.scan_ns]}" if note.scan_ns in numbers else ""
            yield _label("note").append(f"{time_of_day(note.time_ns)} {note.who}{on}: {note.text}")

    def _announced(self) -> Iterator[Text]:
        for envelope, (time_ns, message) in self._seen.announced.items():
            yield _label("message").append(f"{time_of_day(time_ns)} {envelope}: {wire.as_text(message)}")

    def as_json(self) -> dict[str, object]:
        """Return the status for programs.

        Times are ISO 8601 in UTC. Durations are in experiment seconds, except the real seconds of `step_age_s`.
        """
        seen, run = self._seen, self._run
        control, running, end_ns = seen.control, seen.scan_progress(self._now_ns), self._end_ns()
        return {
            "running": True,
            "experiment": run.name,
            "folder": run.folder,
            "simulated": run.simulated,
            "replay_of": run.replay_of or None,
            "time": _iso(self._now_ns),
            "mode": control.mode.name if control else None,
            "holder": control.holder if control else None,
            "since": _iso(seen.control_since_ns),
            "by_hand": seen.by_hand or None,
            "tip": None if seen.tip is None else {"engaged": seen.tip.engaged, "feedback_on": seen.tip.feedback_on},
            "problems": problems_as_json(seen),
            "waits": [
                {"who": one.who, "what": one.what, "until": _iso(one.again_ns), "reason": one.reason}
                for one in seen.waits_at(self._now_ns)
            ],
            "lent": [
                {
                    "parameter": one.value.name,
                    "value": one.value.value,
                    "base": one.base.value,
                    "unit": one.value.unit,
                    "by": one.lender,
                    "unsure": one.is_unsure,
                    "reason": one.why,
                }
                for one in seen.loans
            ],
            "overruled": [
                {
                    "parameter": one.planned.name,
                    "states": one.planned.value,
                    "value": one.value.value,
                    "unit": one.value.unit,
                    "component": one.lender,
                    "by": one.by or None,
                    "left_in_manual": one.is_asked,
                }
                for one in seen.overruled
            ],
            "state": seen.status.state.name if seen.status else None,
            "scan": None if running is None else {"part": round(running[0], 4), "remaining_s": _seconds(running[1])},
            "progress": {name: self._progress_json(report) for name, report in seen.progress_at(self._now_ns).items()},
            "end": None if end_ns is None else {"time": _iso(end_ns), "remaining_s": _seconds(end_ns - self._now_ns)},
            "processes": [self._process_json(state) for state in seen.processes.values()],
            "refusals": [
                {"time": _iso(one.time_ns), "who": one.who, "what": one.what, "reason": one.reason}
                for one in seen.refusals
            ],
            "messages": {
                envelope: {"time": _iso(time_ns), "content": wire.as_plain(message)}
                for envelope, (time_ns, message) in seen.announced.items()
            },
            "notes": [
                {"time": _iso(one.time_ns), "who": one.who, "text": one.text, "scan": _iso(one.scan_ns)}
                for one in seen.notes
            ],
            "log": [
                {"time": _iso(line.time_ns), "name": line.name, "level": line.level, "text": line.text}
                for line in seen.log
            ],
        }

    def _progress_json(self, report: Progress) -> dict[str, object]:
        left_ns = report.remaining_ns(self._now_ns)
        end = None if left_ns is None else _iso(self._now_ns + left_ns)
        return {"done": report.done, "of": report.of, "remaining_s": _seconds(left_ns), "end": end}

    def _process_json(self, state: ProcessState) -> dict[str, object]:
        return {
            **{name: getattr(state, name) for name in _PROCESS},
            "condition": state.condition.name,
            "since": _iso(state.since_ns),
            "heard_of": self._seen.silent_ns(state.name, self._run.speed) is None,
        }


def _label(name: str) -> Text:
    from rich.text import Text

    return Text.assemble((f"{name:11}", "dim"))


def _well(state: ProcessState) -> str:
    facts = []
    if state.condition is ProcessCondition.BUSY and state.step_age_s >= 1.0:
        facts.append(f"busy for {duration_text(state.step_age_s)}")
    if state.starts > 1:
        facts.append(f"started {state.starts} times")
    return f"{state.name} ({', '.join(facts)})" if facts else state.name


def _seconds(ns: int | None) -> float | None:
    return None if ns is None else ns / NS_PER_S


def _iso(time_ns: int | None) -> str | None:
    return None if time_ns is None else utc_time(time_ns).isoformat()
