"""The parameters changed in a run, from the requests in its journal and the published states of the z feedback."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass
from html import escape

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import UnitError
from afspm.basics.formatting import PREFIXABLE, counted, quantity, unit_text
from afspm.basics.units import convert, si_unit, si_unit_or_none
from afspm.model import ControlRequest, ControlResponse, Feedback, JournalEntry, names
from afspm.night.run import Run
from afspm.report.markup import PageTimes, table

MOST_LISTED = 200
"""The largest number of listed changes of one parameter by one component."""
_PLACE = frozenset(
    {
        names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y, names.SCAN_SIZE_X, names.SCAN_SIZE_Y, names.SCAN_ANGLE,
        names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y, names.PROBE_POS_X, names.PROBE_POS_Y,
    }
)  # fmt: skip
"""Parameters that the report shows with the scans and spectra."""
_FEEDBACK = (names.FEEDBACK_ON, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN, names.ZCTRL_SETPOINT)
"""The fields of a `Feedback` in their order, as parameters."""
_MAY_SET = frozenset({ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE})
_LATE_S = 1.0
"""The largest delay, in real time, from the answer to a request to the published change."""


@dataclass(frozen=True)
class ChangedParameter:
    """A change of one parameter.

    Attributes:
        who: the component, or "component:person"; empty for a change without a request, such as at the controller.
        before, after: the values as text; `before` is empty if the record does not have it.
    """

    time_ns: int
    who: str
    parameter: str
    before: str
    after: str


def read(run: Run) -> list[ChangedParameter]:
    """Return the changes of all parameters except scan region, pixels and probe position, in the order of time.

    The feedback is published at each change, also at the controller. Other parameters are known from requests only:
    the value before the first request is missing, and so are changes at the controller.
    """
    journal = run.journal
    states = [(packet.time_ns or 0, thing) for packet, _, thing in run.messages(("ZCtrlParameters",))]
    speed = float((run.facts.get("clock") or {}).get("speed", 1.0))
    late_ns = round(_LATE_S * max(1.0, speed) * NS_PER_S)
    changes = [*_requested(journal, _PLACE.union(_FEEDBACK if states else ()))]
    changes += _of_feedback(states, [entry for entry in journal if _may_set_feedback(entry)], late_ns)
    return sorted(changes, key=lambda change: change.time_ns)


def html(changes: Iterable[ChangedParameter], clock: PageTimes) -> str:
    """Return a table with a row for each parameter and author; a click opens its list. Empty without changes."""
    groups: dict[tuple[str, str], list[ChangedParameter]] = {}
    for one in changes:
        groups.setdefault((one.parameter, one.who), []).append(one)
    rows = [
        [
            escape(parameter),
            escape(who) or "no request",
            str(len(made)),
            _known(made[0].before),
            escape(made[-1].after),
            clock.both(made[0].time_ns) if len(made) == 1 else _listed(made, clock),
        ]
        for (parameter, who), made in groups.items()
    ]
    if not rows:
        return ""
    notes = ["Of changes at the controller itself (no request), only those of the feedback are recorded."]
    if any(one.parameter == names.ZCTRL_SETPOINT and " " not in one.after for made in groups.values() for one in made):
        notes.append("The setpoint is recorded without its unit, which follows from the operating mode.")
    heads = ["parameter", "by", "times", "from", "to", "when"]
    return f'{table(heads, rows)}<p class="note">{" ".join(notes)}</p>'


def _listed(made: Sequence[ChangedParameter], clock: PageTimes) -> str:
    rows = [[clock.both(one.time_ns), _known(one.before), escape(one.after)] for one in made[:MOST_LISTED]]
    left_out = len(made) - len(rows)
    more = f'<p class="note">{counted(left_out, "more change")} in the record.</p>' if left_out else ""
    period = f"{clock.utc(made[0].time_ns)} … {clock.utc(made[-1].time_ns)}"
    return f"<details><summary>{period}</summary>{table(['when', 'from', 'to'], rows)}{more}</details>"


def _known(before: str) -> str:
    return escape(before) or "not known"


def _requested(journal: Iterable[JournalEntry], left_out: frozenset[str]) -> Iterable[ChangedParameter]:
    last: dict[str, str] = {}
    for entry in journal:
        is_set = entry.request == ControlRequest.PARAM and entry.response in _MAY_SET and entry.value
        if not is_set or entry.subject in left_out:
            continue
        name, before = entry.subject, last.get(entry.subject, "")
        if entry.response != ControlResponse.SUCCESS:
            last[name] = ""  # it may have been set
            continue
        after = last[name] = _value(entry.value, entry.unit or names.BASE_PARAMETERS.get(name) or "")
        if after != before:
            yield ChangedParameter(entry.time_ns, entry.who, name, before, after)


def _value(value: str, unit: str) -> str:
    try:
        base = si_unit(unit)
        if base in PREFIXABLE:
            return quantity(convert(float(value), unit, base), base, 6)
    except (ValueError, UnitError):
        pass  # a text, or a unit of the microscope's own: shown as requested
    return f"{value} {unit_text(unit)}".strip()


def _may_set_feedback(entry: JournalEntry) -> bool:
    if entry.sent_ns is None or entry.response not in _MAY_SET:
        return False
    if entry.request == ControlRequest.PARAM:
        return entry.subject in _FEEDBACK and bool(entry.value)
    # a treatment or a retraction may switch the feedback off
    is_action = entry.request == ControlRequest.ACTION and entry.subject not in names.BASE_ACTIONS
    return is_action or entry.request == ControlRequest.SET_ZCTRL_PARAMS


def _of_feedback(
    states: Iterable[tuple[int, Feedback]], requests: Sequence[JournalEntry], late_ns: int
) -> Iterable[ChangedParameter]:
    requests = sorted(requests, key=_sent_ns)
    before = Feedback()
    # published in SI without a unit, which an accepted request may have
    accepted = (entry for entry in requests if entry.unit and entry.response == ControlResponse.SUCCESS)
    units = {entry.subject: si_unit_or_none(entry.unit) or "" for entry in accepted}
    for time_ns, now in states:
        for name, old, new in zip(_FEEDBACK, astuple(before), astuple(now), strict=True):
            if old is not None and new is not None and old != new:
                who = _author(time_ns, requests, late_ns)
                yield ChangedParameter(
                    time_ns, who, name, *(_field(value, units.get(name, "")) for value in (old, new))
                )
        before = now


def _author(time_ns: int, requests: Sequence[JournalEntry], late_ns: int) -> str:
    # `requests` in the order of sending; the last before the change has made it, or a person at the controller
    number = bisect_right(requests, time_ns, key=_sent_ns)
    if number == 0 or time_ns > requests[number - 1].time_ns + late_ns:
        return ""
    return requests[number - 1].who


def _sent_ns(entry: JournalEntry) -> int:
    return entry.sent_ns or 0


def _field(value: float, unit: str) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return _value(f"{value:.6g}", unit)
