"""A night in shadow mode: what a run would have done, beside what the person did. See docs/reference/shadow.md."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from html import escape
from typing import Final

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import FileError
from afspm.basics.formatting import duration_text
from afspm.model import ActByHand, ControlEvent, ControlRequest, ControlResponse, JournalEntry, PanelAct, Problem
from afspm.record.bad_scans import BAD, LINE_VERDICT_MESSAGE, VERDICT_MESSAGE, read_verdict
from afspm.record.report.markup import PageTimes, table
from afspm.record.run import Run
from afspm.wire.messages import SpatialROIWithScoreList, TipVerdict

SOON_S: Final = 300.0
"""Experiment time within which an act of the person answers a decision. Fixed before any night was seen."""
ANSWERS: Final = frozenset({PanelAct.WITHDRAW, PanelAct.FEEDBACK_OFF, PanelAct.VALUES})
"""Acts that answer a decision, beside a scan that ended early: the person did not simply go on."""
_ENDED_EARLY: Final = "a scan ended before its last line, and nothing but a person or the controller could end it"
_SIGMAS: Final = 1.959964
_MESSAGES: Final = ("ActByHand", LINE_VERDICT_MESSAGE, VERDICT_MESSAGE)
FILE: Final = "shadow.csv"
_HEADS: Final = ("time_ns", "kind", "afspm", "person", "after_s")


class ShadowKind(StrEnum):
    """The kind of a row: a decision of afspm, or an act of the person without one."""

    SCAN = "bad scan"
    LINES = "line alarm"
    PROBLEM = "problem"
    LIMIT = "limit"
    PERSON = "by hand"


@dataclass(frozen=True)
class ShadowRow:
    """A decision of afspm and the person's answer, or an act of the person.

    Attributes:
        time_ns: of the decision, or of the act.
        would: what afspm would have done, in words; empty for an act that no decision preceded.
        did: the act of the person, with its evidence; empty: the person went on.
        after_s: experiment time from the decision to the act; None without both.
    """

    time_ns: int
    kind: ShadowKind
    would: str
    did: str = ""
    after_s: float | None = None


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
    """

    kind: ShadowKind
    count: int
    agreed: int

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share (Wilson's score); (0, 1) without a decision."""
        n, z = self.count, _SIGMAS
        if not n:
            return 0.0, 1.0
        share = self.agreed / n
        middle = share + z * z / (2 * n)
        half = z * math.sqrt(share * (1.0 - share) / n + z * z / (4 * n * n))
        # rounding may leave the bounds of none and all a little beyond them
        return max(0.0, (middle - half) / (1 + z * z / n)), min(1.0, (middle + half) / (1 + z * z / n))


@dataclass(frozen=True)
class ShadowNight:
    """The rows of a night in the order of time, and the agreement by kind; empty for a run that commands."""

    rows: Sequence[ShadowRow] = ()
    agreement: Sequence[Agreement] = field(default_factory=tuple)


def read(run: Run) -> ShadowNight:
    """Reduce the record of a run."""
    try:
        is_shadow = run.experiment.get("control", {}).get("shadow", False)
    except FileError:  # a report needs no experiment file otherwise
        is_shadow = False
    if not is_shadow:
        return ShadowNight()
    decisions: list[ShadowRow] = []
    acts = [PersonAct(scan.time_ns, _ENDED_EARLY, answers=True) for scan in run.scans if scan.interrupted]
    for packet, _, thing in run.messages(_MESSAGES):
        time_ns = packet.time_ns or 0
        if isinstance(thing, ActByHand):
            acts.append(PersonAct(thing.time_ns, str(thing), thing.act in ANSWERS))
        elif isinstance(thing, TipVerdict):
            decisions.append(ShadowRow(time_ns, ShadowKind.LINES, _of_lines(thing)))
        elif isinstance(thing, SpatialROIWithScoreList):
            verdict = read_verdict(thing)
            if verdict is not None and verdict[1] == BAD:
                decisions.append(ShadowRow(time_ns, ShadowKind.SCAN, "would have taken the tip for bad"))
    names = run.problem_names
    for entry in filter(_is_flag, run.journal):
        would = f"{entry.who} would have had {names.name(entry.problem or 0)} solved"
        decisions.append(ShadowRow(entry.time_ns, ShadowKind.PROBLEM, would))
    limits = [
        ShadowRow(entry.time_ns, ShadowKind.LIMIT, f"would have refused this: {entry.reason}", entry.what)
        for entry in run.journal
        if entry.event is ControlEvent.BY_HAND and entry.reason
    ]
    return compare(decisions, sorted(acts, key=lambda act: act.time_ns), limits)


def compare(decisions: Sequence[ShadowRow], acts: Sequence[PersonAct], limits: Sequence[ShadowRow] = ()) -> ShadowNight:
    """Set each decision beside the first act that answers it, and list the acts beside them.

    Args:
        acts: in the order of time.
        limits: rows that are their own answer, since the act is what the limits would have refused.
    """
    answers = [act for act in acts if act.answers]
    rows, foreseen = [], set[int]()
    for one in decisions:
        soon = [act for act in answers if 0 <= act.time_ns - one.time_ns <= SOON_S * NS_PER_S]
        foreseen |= {act.time_ns for act in soon}
        if soon:
            after_s = (soon[0].time_ns - one.time_ns) / NS_PER_S
            rows.append(ShadowRow(one.time_ns, one.kind, one.would, soon[0].text, after_s))
        else:
            rows.append(one)
    agreement = []
    for kind in (ShadowKind.SCAN, ShadowKind.LINES, ShadowKind.PROBLEM):
        mine = [row for row in rows if row.kind is kind]
        agreement.append(Agreement(kind, len(mine), sum(bool(row.did) for row in mine)))
    known = sum(act.time_ns in foreseen for act in answers)
    agreement.append(Agreement(ShadowKind.PERSON, len(answers), known))
    rows += [*limits, *(ShadowRow(act.time_ns, ShadowKind.PERSON, "", act.text) for act in acts)]
    return ShadowNight(sorted(rows, key=lambda row: row.time_ns), agreement)


def html(night: ShadowNight, clock: PageTimes) -> str:
    """Return the section of the page; empty for a run that commands."""
    if not night.agreement:
        return ""
    cells = [
        [
            clock.both(row.time_ns),
            escape(row.kind),
            escape(row.would),
            escape(row.did) or ("went on" if row.would else ""),
            "" if row.after_s is None else escape(duration_text(row.after_s)),
        ]
        for row in night.rows
    ]
    shares = [[escape(text) for text in line] for line in agreement_lines(night)]
    return table(("decisions", "number", "the person acted", "95 % interval"), shares) + table(
        ("time", "", "afspm", "the person", "after"), cells
    )


def agreement_lines(night: ShadowNight) -> list[tuple[str, str, str, str]]:
    """Return kind, number, number agreed, and interval in words, of each kind."""
    return [
        (one.kind.value, str(one.count), str(one.agreed), "{:.0%} to {:.0%}".format(*one.interval))
        for one in night.agreement
    ]


def csv_text(night: ShadowNight) -> str:
    """Return the rows as CSV, with a row of names."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_HEADS)
    for row in night.rows:
        writer.writerow((row.time_ns, row.kind.value, row.would, row.did, "" if row.after_s is None else row.after_s))
    return text.getvalue()


def _is_flag(entry: JournalEntry) -> bool:
    is_flag = entry.request == ControlRequest.ADD_EXP_PRBLM and entry.response == ControlResponse.SUCCESS
    return is_flag and entry.problem != Problem.DEVICE_MALFUNCTION


def _of_lines(verdict: TipVerdict) -> str:
    would = "would have stopped the scan" if verdict.stops else "would have asked a person to look"
    return f"{would} at row {verdict.row}, changed since row {verdict.since_row}: {verdict.reason}"
