"""A night in shadow mode: what a run would have done, beside what the person did. See docs/reference/shadow.md."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from html import escape
from typing import Final

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import FileError, InvalidValue
from afspm.basics.formatting import counted, duration_text, position_text, quantity
from afspm.model import (
    ActByHand,
    ControlEvent,
    ControlRequest,
    ControlResponse,
    Frame,
    JournalEntry,
    PanelAct,
    Problem,
    RegistrationOutcome,
    ScopeState,
    names,
)
from afspm.night.bad_scans import BAD, read_verdict
from afspm.night.measurement_history import DriftPoint
from afspm.night.run import Run
from afspm.night.tables import NoteRow, ScanRow
from afspm.record.run_json import SOLVES
from afspm.report.markup import PageTimes, table
from afspm.wire.messages import TipVerdict

SOON_S: Final = 300.0
"""Experiment time within which an act of the person answers a decision. Fixed before any night was seen."""
ANSWERS: Final = frozenset({PanelAct.WITHDRAW, PanelAct.FEEDBACK_OFF, PanelAct.VALUES})
"""Acts that answer a decision, beside a scan that ended early: the person did not simply go on."""
_OF_THE_SCAN: Final = (ScopeState.SCANNING, ScopeState.INTERRUPTED)
_SIGMAS: Final = 1.959964
FILE: Final = "shadow.csv"
_HEADS: Final = ("number", "time_ns", "kind", "afspm", "person", "after_s", "left_s", "mark", "comment")
RIGHT: Final = "right"
WRONG: Final = "wrong"
_MARKS: Final = (RIGHT, WRONG)
_FRAME: Final = frozenset({
    *(names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y, names.SCAN_SIZE_X, names.SCAN_SIZE_Y, names.SCAN_ANGLE),
    *(names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y),
})  # fmt: skip
"""Settings with which a translator discards the running scan when a person changes them."""
_SAME_FRAME: Final = 1e-3
"""Frames are equal if their edges differ by less than this part of their size."""


_ANSWERED: Final = "the person acted at"
NONE_SEEN: Final = "none seen"
_AFTER_A_DECISION: Final = "afspm had decided before"
_TIP_CHANGED: Final = "; the tip changed meanwhile, which may have shifted the image"


class ShadowKind(StrEnum):
    """The kind of a row: a decision of afspm, or an act of the person without one."""

    TAKEN = "scan"
    SCAN = "bad scan"
    LINES = "line alarm"
    PROBLEM = "problem"
    REPAIR = "repair"
    DRIFT = "drift"
    CONTROL = "control"
    LIMIT = "limit"
    CONTACT = "contact lost"
    PERSON = "by hand"


_UNANSWERED: Final = (ShadowKind.CONTROL, ShadowKind.DRIFT, ShadowKind.CONTACT)
"""Kinds without an answer: a component that waits all night is no decision, and no act answers drift."""
COUNTED: Final = (ShadowKind.SCAN, ShadowKind.LINES, ShadowKind.PROBLEM)
"""Kinds with a counted agreement: a person answers them, if at all, by an act."""


@dataclass(frozen=True)
class ShadowMark:
    """The opinion of a person on a row: right or wrong, and why."""

    right: bool
    comment: str = ""


@dataclass(frozen=True)
class ShadowRow:
    """A decision of afspm and the person's answer, or an act of the person.

    Attributes:
        time_ns: of the decision, or of the act.
        would: what afspm would have done, in words; empty for an act that no decision preceded.
        did: the act of the person, with its evidence; empty: the person went on.
        after_s: experiment time from the decision to the act; None without both.
        left_s: experiment time from a line alarm to the end of its scan; None for other rows.
        number: the place in the table, from 1.
    """

    time_ns: int
    kind: ShadowKind
    would: str
    did: str = ""
    after_s: float | None = None
    left_s: float | None = None
    number: int = 0
    mark: ShadowMark | None = None

    @property
    def answer(self) -> str:
        """The act of the person, or "went on"; empty where nothing is answered."""
        return self.did or ("went on" if self.would and self.kind not in _UNANSWERED else "")


@dataclass(frozen=True)
class PersonAct:
    """An act of the person with its evidence, and whether it answers a decision."""

    time_ns: int
    text: str
    answers: bool


@dataclass(frozen=True)
class Agreement:
    """The number of decisions of a kind, and the number that the person answered.

    For `ShadowKind.PERSON`: the number of acts that can answer, and how many a decision preceded.

    Attributes:
        right, wrong: the number of rows that a person marked so.
    """

    kind: ShadowKind
    count: int
    agreed: int
    right: int = 0
    wrong: int = 0

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share that the person answered."""
        return interval(self.agreed, self.count)

    @property
    def interval_right(self) -> tuple[float, float]:
        """The 95 % interval of the share that is right, of the marked rows."""
        return interval(self.right, self.right + self.wrong)


def interval(agreed: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson's score); (0, 1) without a count."""
    if not count:
        return 0.0, 1.0
    share, z = agreed / count, _SIGMAS
    middle = share + z * z / (2 * count)
    half = z * math.sqrt(share * (1.0 - share) / count + z * z / (4 * count * count))
    # rounding may leave the bounds of none and all a little beyond them
    return max(0.0, (middle - half) / (1 + z * z / count)), min(1.0, (middle + half) / (1 + z * z / count))


@dataclass(frozen=True)
class ShadowNight:
    """The rows of a night in the order of time, and the agreement by kind; empty for a run that commands."""

    rows: Sequence[ShadowRow] = ()
    agreement: Sequence[Agreement] = field(default_factory=tuple)

    def row(self, number: int) -> ShadowRow:
        """Return a row by its number. Raises InvalidValue if there is none."""
        for row in self.rows:
            if row.number == number:
                return row
        hint = f"1 to {len(self.rows)}" if self.rows else "the run is no shadow, or nothing has happened yet"
        raise InvalidValue(f"the shadow's table has no row {number}", hint=hint)

    @property
    def answered(self) -> tuple[int, int]:
        """The number of decisions with a counted agreement, and the number that the person answered."""
        some = [of_kind for of_kind in self.agreement if of_kind.kind in COUNTED]
        return sum(of_kind.count for of_kind in some), sum(of_kind.agreed for of_kind in some)

    def left_s(self, *, right: bool) -> float:
        """Return the scan time left at all line alarms that a person marked right, or wrong."""
        marked = (row for row in self.rows if row.mark is not None and row.mark.right is right)
        return sum(row.left_s or 0.0 for row in marked)


def mark_text(row: ShadowRow, opinion: str) -> str:
    """Return the note that marks a row, to be written at the time of the row.

    Args:
        opinion: "right" or "wrong", and perhaps a comment after it.

    Raises:
        InvalidValue: the opinion begins with neither.
    """
    if _opinion(opinion) is None:
        raise InvalidValue(f"{opinion!r} is neither right nor wrong", hint='write e.g. "wrong, it was the sample"')
    return f"{row.kind}: {opinion}"


def _opinion(text: str) -> ShadowMark | None:
    word = next((known for known in _MARKS if text.lower().startswith(known)), "")
    rest = text[len(word) :]
    return ShadowMark(word == RIGHT, rest.strip(" ,;:.")) if word and not rest[:1].isalnum() else None


def read(run: Run) -> ShadowNight:
    """Reduce the record of a run."""
    try:
        is_shadow = run.experiment.get("control", {}).get("shadow", False)
    except FileError:  # a report needs no experiment file otherwise
        is_shadow = False
    if not is_shadow:
        return ShadowNight()
    scans, problems, solvers = run.scans, run.problem_names, _solvers(run)
    judgements = list(run.judgements())
    decisions = [*of_drift(run.drift, scans, changes=run.tip_changes_ns())]
    taken = [
        ShadowRow(scan.time_ns, ShadowKind.TAKEN, _judged(scan), f"took scan {scan.number} to its last line")
        for scan in scans
        if not scan.interrupted
    ]
    alarms: dict[tuple[int, ...], ShadowRow] = {}
    early = [scan for scan in scans if scan.interrupted]
    lost = _lost_in(run, early)
    decisions += [
        ShadowRow(scan.time_ns, ShadowKind.CONTACT, f"lost contact with the controller in scan {scan.number}")
        for scan in lost
    ]
    by_hand: list[ActByHand] = [act for _, _, act in run.messages(("ActByHand",))]
    acts = [PersonAct(act.time_ns, str(act), act.act in ANSWERS) for act in by_hand]
    for short in (scan for scan in early if scan not in lost):
        if spoiled := _spoiled(short, by_hand):  # it may have its last line, and the act counts already
            acts.append(PersonAct(short.time_ns, f"scan {short.number} has no result: {spoiled}", answers=False))
        else:
            acts.append(PersonAct(short.time_ns, f"scan {short.number} ended before its last line", answers=True))
    for time_ns, verdict in judgements:
        if isinstance(verdict, TipVerdict):
            _add_alarm(alarms, time_ns, verdict, scans)
        elif (judged := read_verdict(verdict)) is not None and judged[1] == BAD:
            scan = run.scan_at(judged[0])
            which = "" if scan is None else f" of scan {scan.number}"
            decisions.append(ShadowRow(time_ns, ShadowKind.SCAN, f"would have taken the tip{which} for bad"))
    for entry in filter(_is_flag, run.journal):
        problem = problems.name(entry.problem or 0)
        would = f"{entry.who} would have had {problem} solved"
        decisions.append(ShadowRow(entry.time_ns, ShadowKind.PROBLEM, would))
        for solver in solvers.get(problem, ()):
            would = f"{solver} would have been given control to solve {problem}"
            decisions.append(ShadowRow(entry.time_ns, ShadowKind.REPAIR, would))
    limits = [
        ShadowRow(entry.time_ns, ShadowKind.LIMIT, f"would have refused this: {entry.reason}", entry.what)
        for entry in run.journal
        if entry.event is ControlEvent.BY_HAND and entry.reason
    ]
    decisions += [*alarms.values(), *_asked(run.journal)]
    return compare(decisions, sorted(acts, key=lambda act: act.time_ns), [*limits, *taken], run.notes)


def compare(
    decisions: Sequence[ShadowRow],
    acts: Sequence[PersonAct],
    limits: Sequence[ShadowRow] = (),
    notes: Sequence[NoteRow] = (),
) -> ShadowNight:
    """Set each decision beside the first act that answers it, and list the acts beside them.

    Args:
        acts: in the order of time.
        limits: rows that are their own answer, such as an act that the limits would have refused.
        notes: those of `mark_text` at the time of a row are marks; of several the last written one counts.
    """
    answers = [act for act in acts if act.answers]
    rows, foreseen = [], set[int]()
    for decision in decisions:
        soon = [act for act in answers if 0 <= act.time_ns - decision.time_ns <= SOON_S * NS_PER_S]
        if decision.kind in COUNTED:
            foreseen |= {act.time_ns for act in soon}
        if soon and decision.kind not in _UNANSWERED:
            after_s = (soon[0].time_ns - decision.time_ns) / NS_PER_S
            rows.append(replace(decision, did=soon[0].text, after_s=after_s))
        else:
            rows.append(decision)
    rows += [*limits, *(ShadowRow(act.time_ns, ShadowKind.PERSON, "", act.text) for act in acts)]
    marks = _marks(notes)
    numbered = [
        replace(row, number=number, mark=marks.get((row.time_ns, row.kind)))
        for number, row in enumerate(sorted(rows, key=lambda row: row.time_ns), 1)
    ]
    known = sum(act.time_ns in foreseen for act in answers)
    return ShadowNight(numbered, [*_agreements(numbered), Agreement(ShadowKind.PERSON, len(answers), known)])


def _agreements(rows: Sequence[ShadowRow]) -> Iterator[Agreement]:
    for kind in ShadowKind:
        mine = [row for row in rows if row.kind is kind]
        marked = [row.mark.right for row in mine if row.mark is not None]
        if kind in COUNTED or (marked and kind is not ShadowKind.PERSON):
            acted = sum(bool(row.did) for row in mine)
            yield Agreement(kind, len(mine), acted, sum(marked), len(marked) - sum(marked))


def _marks(notes: Sequence[NoteRow]) -> dict[tuple[int, ShadowKind], ShadowMark]:
    marks = {}
    for note in sorted(notes, key=lambda note: note.written_ns or 0):
        kind, colon, opinion = note.text.partition(": ")
        mark = _opinion(opinion) if colon else None
        if mark is not None and kind in list(ShadowKind):
            marks[note.time_ns, ShadowKind(kind)] = mark
    return marks


def html(night: ShadowNight, clock: PageTimes) -> str:
    """Return the section of the page; empty for a run that commands."""
    if not night.agreement:
        return ""
    cells = [
        [
            str(row.number),
            clock.both(row.time_ns),
            escape(row.kind),
            escape(row.would),
            escape(row.answer),
            "" if row.after_s is None else escape(duration_text(row.after_s)),
            "" if row.mark is None else f"{_word(row.mark)}<small>{escape(row.mark.comment)}</small>",
        ]
        for row in night.rows
    ]
    shares = [[escape(text) for text in line] for line in agreement_lines(night)]
    heads = (
        "decisions",
        "number",
        "the person acted (by hand: after a decision)",
        "95 % interval",
        "marked right",
        "marked wrong",
        "95 % interval",
    )
    return (
        table(heads, shares)
        + f'<p class="note">{escape(marks_in_words(night))}</p>'
        + table(("row", "time", "kind", "afspm", "the person", "after", "marked"), cells)
    )


def marks_in_words(night: ShadowNight) -> str:
    """Return the number of marks, and the scan time that line alarms would have saved and lost."""
    marked = sum(row.mark is not None for row in night.rows)
    if not marked:
        return 'No row is marked yet: afspm note RUN --row NUMBER "right", or "wrong".'
    saved, lost = (duration_text(night.left_s(right=right)) for right in (True, False))
    return f"{counted(marked, 'row')} marked; line alarms would have saved {saved} and lost {lost} of scans."


def agreement_lines(night: ShadowNight) -> list[tuple[str, ...]]:
    """Return a line of each kind: number, number answered with interval, and number marked right, wrong, interval."""
    return [
        (
            *(row.kind.value, str(row.count)),
            *(_answered(row) if row.kind in (*COUNTED, ShadowKind.PERSON) else ("", "")),
            *(str(row.right), str(row.wrong), _between(row.interval_right) if row.right + row.wrong else ""),
        )
        for row in night.agreement
    ]


def agreement_in_words(night: ShadowNight) -> list[str]:
    """Return a sentence for each kind that an act answers, and one for the acts by hand."""
    return [
        f"{kind}: {NONE_SEEN}"
        if share == NONE_SEEN
        else f"{kind}: {count}, {_AFTER_A_DECISION if kind == ShadowKind.PERSON else _ANSWERED} {agreed} of them"
        f" ({share} with 95 %)"
        for kind, count, agreed, share, *_ in agreement_lines(night)
        if agreed
    ]


def _answered(row: Agreement) -> tuple[str, str]:
    return str(row.agreed), _between(row.interval) if row.count else NONE_SEEN


def _between(share: tuple[float, float]) -> str:
    return "{:.0f} % to {:.0f} %".format(*(100.0 * bound for bound in share))


def _word(mark: ShadowMark) -> str:
    return RIGHT if mark.right else WRONG


def csv_text(night: ShadowNight) -> str:
    """Return the rows as CSV, with a row of names."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_HEADS)
    for row in night.rows:
        times = ("" if value is None else value for value in (row.after_s, row.left_s))
        mark = ("", "") if row.mark is None else (_word(row.mark), row.mark.comment)
        writer.writerow((row.number, row.time_ns, row.kind.value, row.would, row.did, *times, *mark))
    return text.getvalue()


def _is_flag(entry: JournalEntry) -> bool:
    is_flag = entry.request == ControlRequest.ADD_EXP_PRBLM and entry.response == ControlResponse.SUCCESS
    return is_flag and entry.problem != Problem.DEVICE_MALFUNCTION


def _lost_in(run: Run, scans: Sequence[ScanRow]) -> list[ScanRow]:
    # a scan that a lost contact interrupts goes on at the controller: no person has ended it
    states = [(packet.time_ns or 0, status.state) for packet, _, status in run.messages(("ScopeStateMsg",))]
    lost = []
    for scan in scans:
        later = (state for time_ns, state in states if time_ns >= scan.time_ns and state not in _OF_THE_SCAN)
        if next(later, None) is ScopeState.UNDEFINED:
            lost.append(scan)
    return lost


def _spoiled(scan: ScanRow, by_hand: Sequence[ActByHand]) -> str:
    # the act during a scan for which its translator discards it, also if it was scanned to its last line
    for act in by_hand:
        if scan.began_ns is not None and scan.began_ns <= act.time_ns <= scan.time_ns:
            if act.act is PanelAct.VALUES and any(change.parameter in _FRAME for change in act.changes):
                return "its frame was changed while it ran"
            if act.act is PanelAct.FEEDBACK_OFF:
                return "the z feedback was switched off while it ran"
    return ""


def _judged(scan: ScanRow) -> str:
    if scan.tip_score is None:
        return "did not judge the tip"
    return "would have taken the tip for bad" if scan.tip_score == BAD else "would have gone on"


def _add_alarm(
    alarms: dict[tuple[int, ...], ShadowRow], time_ns: int, verdict: TipVerdict, scans: Sequence[ScanRow]
) -> None:
    # a detector repeats its alarm about one change as the evidence grows: that is one decision
    of_scan = verdict.timestamp.ToNanoseconds() or time_ns
    key = of_scan, verdict.since_row, int(verdict.stops)
    if first := alarms.get(key):
        alarms[key] = replace(first, would=f"{first.would}; again at row {verdict.row}: {verdict.reason}")
    else:
        alarms[key] = _of_lines(time_ns, verdict, scans)


def _of_lines(time_ns: int, verdict: TipVerdict, scans: Sequence[ScanRow]) -> ShadowRow:
    would = "would have stopped the scan" if verdict.stops else "would have asked a person to look"
    ends_ns = (scan.time_ns for scan in scans if (scan.began_ns or scan.time_ns) <= time_ns <= scan.time_ns)
    left_s = next(((end_ns - time_ns) / NS_PER_S for end_ns in ends_ns), None)
    left = "" if left_s is None else f", {duration_text(left_s)} before its end"
    text = f"{would} at row {verdict.row}{left}, changed since row {verdict.since_row}: {verdict.reason}"
    return ShadowRow(time_ns, ShadowKind.LINES, text, left_s=left_s)


def _solvers(run: Run) -> Mapping[str, Sequence[str]]:
    solvers: dict[str, list[str]] = {}
    for name, process in (run.facts.get("processes") or {}).items():
        for problem in process.get(SOLVES, ()):
            solvers.setdefault(problem, []).append(name)
    return solvers


def _asked(journal: Sequence[JournalEntry]) -> Iterator[ShadowRow]:
    # a component asks again and again while it waits: a row for each would hide the others
    asked = [entry for entry in journal if entry.request == ControlRequest.REQUEST_CTRL]
    for who in dict.fromkeys(entry.who for entry in asked):
        times_ns = [entry.time_ns for entry in asked if entry.who == who]
        would = f"{who} would have asked for control, and waits ({counted(len(times_ns), 'request')})"
        yield ShadowRow(times_ns[0], ShadowKind.CONTROL, would)


def of_drift(
    points: Sequence[DriftPoint], scans: Sequence[ScanRow], changes: Sequence[int] = ()
) -> Iterator[ShadowRow]:
    """Yield a row of each scan after the first: the drift so far, and where a run would have had a repeated frame.

    Args:
        changes: times in ns at which a tip was seen to be changed. A second apex or another length shifts the image, so
            the rows after the first of them are marked.
    """
    # a frame that a person sets again is meant for the same place on the sample, which has moved meanwhile
    first = dict[int, tuple[float, float]]()
    placed: list[ScanRow] = []
    for scan in scans:
        began_ns = scan.time_ns if scan.began_ns is None else scan.began_ns
        point = next((candidate for candidate in points if began_ns <= candidate.time_ns <= scan.time_ns), None)
        if point is None or scan.region is None or scan.region.frame is Frame.SAMPLE:
            continue
        if not placed and point.translation_m == (0.0, 0.0):  # the first scan, from which the drift is counted
            placed, first[scan.number] = [scan], point.translation_m
            continue
        moved_m, doubt = point.translation_m, quantity(point.sd_m, "m", 3)
        before = next((earlier for earlier in placed if _same_frame(earlier, scan)), None)
        if before is None:
            placed.append(scan)
            first[scan.number] = moved_m
        how = "" if point.outcome is RegistrationOutcome.REGISTERED else f" ({point.outcome.label}: {point.reason})"
        text = f"scan {scan.number}: the sample had moved by {_place(moved_m)} ± {doubt}{how}"
        if placed and any(placed[0].time_ns < changed_ns <= scan.time_ns for changed_ns in changes):
            text += _TIP_CHANGED
        if before is not None:
            (x, y), (x_now, y_now), (x_then, y_then) = scan.region.center_m, moved_m, first[before.number]
            way_m = (x_now - x_then, y_now - y_then)
            if math.hypot(*way_m) > (point.sd_m or 0.0):  # a run would not follow what may be nothing
                text += f"; a run would have had the frame of scan {before.number} at"
                text += f" {_place((x + way_m[0], y + way_m[1]))} instead of {_place(scan.region.center_m)}"
        yield ShadowRow(scan.time_ns, ShadowKind.DRIFT, text)


def _place(xy_m: tuple[float, float]) -> str:
    # rounded to a nanometre's tenth: the doubt of a place is larger, as a rule
    x, y = (round(value, 10) + 0.0 for value in xy_m)  # no minus before a zero
    return position_text((x, y))


def _same_frame(scan: ScanRow, other: ScanRow) -> bool:
    if scan.region is None or other.region is None:
        return False
    by = scan.region.compared(other.region)
    return max(by.apart, by.size, abs(by.turned_rad)) <= _SAME_FRAME
