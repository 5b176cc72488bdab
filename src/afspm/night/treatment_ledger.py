"""The ledger of a run: the recorded treatments of tip and sample."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import UnitError
from afspm.basics.units import convert, si_unit
from afspm.model import ControlRequest, ControlResponse, JournalEntry, Region, names

_COUNTS = frozenset({ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE})
"""Responses to an action that was carried out, or may have been."""
KEEP_AWAY_M = 500e-9
"""The distance that the `TipCorrector` keeps from scanned regions by default."""
XY = tuple[float, float]


class TreatmentPlace(NamedTuple):
    """The action of a treatment, such as "x-pulse", and the position of the probe."""

    action: str
    xy_m: XY


@dataclass(frozen=True)
class TreatmentLedger:
    """Totals of the treatments in a run.

    Attributes:
        pulses, pulse_v_s: number of bias pulses, and the sum of |voltage| times duration.
        crashes, crash_depth_m: number of controlled crashes, and the sum of their depths.
        unknown: treatments whose voltage, duration or depth the record does not show; the sums lack them.
        in_keep_away: treatments nearer than the given distance to a region scanned before.
        feedback_off_s: time in which the published feedback was off, without the time after requested retractions.
        by: number of treatments of each author.
        places: the treatments with a known position, in the order of time.
    """

    pulses: int = 0
    pulse_v_s: float = 0.0
    crashes: int = 0
    crash_depth_m: float = 0.0
    unknown: int = 0
    in_keep_away: int = 0
    feedback_off_s: float = 0.0
    by: dict[str, int] = field(default_factory=dict)
    places: tuple[TreatmentPlace, ...] = ()

    @property
    def treatments(self) -> int:
        return self.pulses + self.crashes


def treatment_ledger(
    journal: Iterable[JournalEntry],
    positions: Sequence[tuple[int, XY]],
    scanned: Sequence[tuple[int, Region]],
    feedback: Sequence[tuple[int, bool]],
    end_ns: int,
    keep_away_m: float,
) -> TreatmentLedger:
    """Return the ledger of a run, from its journal and published states.

    Args:
        journal: the journal entries in the order of time.
        positions: times and positions of the probe.
        scanned: starts and regions of scans.
        feedback: times at which the feedback's state was published, with True for on.
        end_ns: the end of the run.
        keep_away_m: distance from scanned regions within which a treatment counts as near.
    """
    ledger, values, retracted = TreatmentLedger(), dict[str, float](), list[tuple[int, bool]]()
    for entry in treatments_once(list(journal)):
        if entry.response not in _COUNTS:
            continue
        if entry.request == ControlRequest.PARAM and entry.subject:
            _keep_value(values, entry)
        elif entry.request == ControlRequest.ACTION and entry.subject in (names.RETRACT, names.ENGAGE):
            retracted.append((entry.time_ns, entry.subject == names.RETRACT))
        elif _is_treatment(entry):
            done_ns = entry.sent_ns if entry.sent_ns is not None else entry.time_ns
            place = next((xy_m for time_ns, xy_m in reversed(positions) if time_ns <= done_ns), None)
            if place is not None:
                near = any(
                    _distance_m(place, region) < keep_away_m for began_ns, region in scanned if began_ns <= done_ns
                )
                places = (*ledger.places, TreatmentPlace(entry.subject, place))
                ledger = replace(ledger, in_keep_away=ledger.in_keep_away + near, places=places)
            ledger = _with_treatment(ledger, entry, values)
    return replace(ledger, feedback_off_s=_off_s(feedback, retracted, end_ns))


def treatments_once(journal: Sequence[JournalEntry]) -> list[JournalEntry]:
    """Return the journal with one entry, the first with the last response, for each treatment that was sent.

    A long treatment has an entry for each repetition of its request, and another for a late answer. Unsent treatments
    with an unknown outcome are left out.
    """
    treatments = {i for i, entry in enumerate(journal) if _is_treatment(entry)}
    last = {_sending(journal[i]): i for i in sorted(treatments)}
    first = {_sending(journal[i]): i for i in sorted(treatments, reverse=True)}
    sent = []
    for i, entry in enumerate(journal):
        if i not in treatments:
            sent.append(entry)
        elif entry.sent_ns is None:
            sent += [entry] if entry.response != ControlResponse.NO_RESPONSE else []
        elif first[_sending(entry)] == i:
            sent.append(replace(entry, response=journal[last[_sending(entry)]].response))
    return sent


def treatment_times(journal: Sequence[JournalEntry]) -> list[int]:
    """Return the time of each treatment that was carried out, or may have been, in ns."""
    return [entry.time_ns for entry in treatments_once(journal) if _is_treatment(entry) and entry.response in _COUNTS]


def _is_treatment(entry: JournalEntry) -> bool:
    return entry.request == ControlRequest.ACTION and entry.subject in names.TREATMENTS


def _sending(entry: JournalEntry) -> tuple[str, str, int | None]:
    return entry.who, entry.subject, entry.sent_ns


def _keep_value(values: dict[str, float], entry: JournalEntry) -> None:
    try:
        value = float(entry.value)
        values[entry.subject] = convert(value, entry.unit, si_unit(entry.unit)) if entry.unit else value
    except (ValueError, UnitError):
        values.pop(entry.subject, None)  # a text, or a unit of another kind: no number of a treatment


def _with_treatment(ledger: TreatmentLedger, entry: JournalEntry, values: dict[str, float]) -> TreatmentLedger:
    ledger = replace(ledger, by={**ledger.by, entry.who: ledger.by.get(entry.who, 0) + 1})
    if entry.subject == names.CRASH:
        depth_m = values.get(names.CRASH_DEPTH)
        unknown, depth_m = depth_m is None, depth_m or 0.0
        total_m = ledger.crash_depth_m + depth_m
        return replace(ledger, crashes=ledger.crashes + 1, crash_depth_m=total_m, unknown=ledger.unknown + unknown)
    voltage_v, duration_s = values.get(names.PULSE_VOLTAGE), values.get(names.PULSE_DURATION)
    known = voltage_v is not None and duration_s is not None
    pulse_v_s = abs(voltage_v or 0.0) * (duration_s or 0.0)
    return replace(
        ledger,
        pulses=ledger.pulses + 1,
        pulse_v_s=ledger.pulse_v_s + pulse_v_s,
        unknown=ledger.unknown + (not known),
    )


def _distance_m(xy_m: XY, region: Region) -> float:
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    dx, dy = xy_m[0] - region.center_m[0], xy_m[1] - region.center_m[1]
    beside = (abs(dx * cos + dy * sin) - region.size_m[0] / 2, abs(dy * cos - dx * sin) - region.size_m[1] / 2)
    return math.hypot(*(max(one, 0.0) for one in beside))


def _off_s(feedback: Sequence[tuple[int, bool]], retracted: Sequence[tuple[int, bool]], end_ns: int) -> float:
    changes = sorted([(at, "on", on) for at, on in feedback] + [(at, "away", away) for at, away in retracted])
    state, total_ns, since_ns = {"on": True, "away": False}, 0, None
    for at_ns, what, value in [*changes, (end_ns, "on", True)]:
        if since_ns is not None and not state["on"] and not state["away"]:
            total_ns += max(0, at_ns - since_ns)
        state[what], since_ns = value, at_ns
    return total_ns / NS_PER_S
