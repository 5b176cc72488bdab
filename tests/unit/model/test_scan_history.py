"""`ScanHistory`: the start of a measurement and its holder, from each order in which packets may come."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.model import (
    ControlMode,
    ControlState,
    MeasurementConditions,
    Region,
    Scan,
    ScanHistory,
    ScopeState,
    ScopeStatus,
    Spectrum,
)

FREE, SCANNING, SPEC, GONE = ScopeState.FREE, ScopeState.SCANNING, ScopeState.SPEC, ScopeState.UNDEFINED
MOVING, INTERRUPTED = ScopeState.MOVING, ScopeState.INTERRUPTED
PAUSED = ScopeStatus(SCANNING, paused=True)
T0_NS = 1_800_000_000_000_000_000
Step = tuple[float, object]


def ns(time_s: float) -> int:
    return T0_NS + round(time_s * 1e9)


def scan(ended_s: float | None, channel: str = "Height") -> Scan:
    time_ns = None if ended_s is None else ns(ended_s)
    return Scan(Region((0.0, 0.0), (1e-6, 1e-6)), channel, "m", np.zeros((4, 4)), time_ns, f"{ended_s}.sxm")


def curve(ended_s: float) -> Spectrum:
    return Spectrum((0.0, 0.0), "IV", ("V", "I"), ("V", "A"), np.zeros((3, 2)), ns(ended_s))


def told(ended_s: float, began_s: float, holder: str) -> MeasurementConditions:
    return MeasurementConditions(ns(ended_s), "", began_ns=ns(began_s), holder=holder)


def story(*steps: Step) -> list[tuple[float | None, str | None]]:
    history, found = ScanHistory(), []
    for at_s, what in steps:
        thing = what
        if isinstance(what, ScopeState):
            thing = ScopeStatus(what)
        elif isinstance(what, str):
            thing = ControlState(ControlMode.AUTOMATED, what)
        if isinstance(thing, Scan | Spectrum):
            before = history.of(thing, ns(at_s))
            history = history.step(thing, ns(at_s))
            assert history.of(thing, ns(at_s)).began_ns == before.began_ns  # the same after its own arrival
            began_s = None if before.began_ns is None else round((before.began_ns - T0_NS) * 1e-9, 3)
            found.append((began_s, before.holder))
        else:
            history = history.step(thing, ns(at_s))
    return found


BEGIN: tuple[Step, ...] = ((0, FREE), (1, "a"), (2, SCANNING))
SEQUENCES: dict[str, tuple[list[Step], list[tuple[float | None, str | None]]]] = {
    "plain": ([*BEGIN, (5, "b"), (10, scan(10)), (10.1, FREE)], [(2, "a")]),
    "lost in the scan": ([*BEGIN, (4, GONE), (5, "b"), (6, SCANNING), (10, scan(10)), (10.1, FREE)], [(2, "a")]),
    "stays scanning": ([*BEGIN, (10, scan(10)), (11, "b"), (20, scan(20)), (20.1, FREE)], [(2, "a"), (10, "a")]),
    "again": ([*BEGIN, (5, "b"), (6, SCANNING), (10, scan(10)), (10.1, FREE)], [(2, "a")]),
    "free before": ([*BEGIN, (9, FREE), (9.5, "b"), (10, scan(10))], [(2, "a")]),
    "next before": (
        [*BEGIN, (9, FREE), (9.2, "b"), (9.5, SCANNING), (10, scan(9)), (20, scan(20)), (20.1, FREE)],
        [(2, "a"), (9.5, "b")],
    ),
    "without FREE": (
        [*BEGIN, (10, scan(10)), (11, "b"), (12, SCANNING), (20, scan(20)), (20.1, FREE)],
        [(2, "a"), (12, "b")],
    ),
    "moved": ([*BEGIN, (3, MOVING), (4, "b"), (5, SCANNING), (10, scan(10)), (10.1, FREE)], [(5, "b")]),
    "channels": ([*BEGIN, (10, scan(10)), (10.1, scan(10, "Phase")), (10.2, FREE)], [(2, "a")] * 2),
    "channels after FREE": ([*BEGIN, (9, FREE), (9.1, scan(9)), (9.2, scan(9, "Phase"))], [(2, "a")] * 2),
    "channels without a time": ([*BEGIN, (10, scan(None)), (10.1, scan(None, "Phase"))], [(2, "a")] * 2),
    "paused in the second": (
        [*BEGIN, (10, scan(10)), (12, PAUSED), (14, SCANNING), (20, scan(20))],
        [(2, "a"), (10, "a")],
    ),
    "interrupted": ([*BEGIN, (4, INTERRUPTED), (5, FREE), (6, "b"), (7, SCANNING), (9, scan(9))], [(7, "b")]),
    "joined late": ([(3, SCANNING), (3.1, "a"), (9, scan(9))], [(None, None)]),
    "back in a scan": ([(0, FREE), (1, "a"), (2, GONE), (5, SCANNING), (9, scan(9))], [(None, "a")]),
    "unseen": ([*BEGIN, (9, scan(9)), (9.1, FREE), (30, scan(30))], [(2, "a"), (None, None)]),
    "by its translator": ([*BEGIN, (9, told(9, 1.9, "a")), (9, scan(9)), (9.1, FREE)], [(1.9, "a")]),
    "unseen, by its translator": ([(3, SCANNING), (9, told(9, 1.9, "c")), (9, scan(9))], [(1.9, "c")]),
    "joined in it, by its translator": (
        [(2.5, "person"), (3, SCANNING), (9, told(9, 1.9, "series")), (9, scan(9))],
        [(1.9, "series")],
    ),
    "channels without a time, stays scanning": (
        [*BEGIN, *((at_s + k / 10, scan(None, str(k))) for at_s in (10, 20, 30) for k in (0, 1))],
        [(2, "a"), (2, "a"), (10, "a"), (10, "a"), (20, "a"), (20, "a")],
    ),
    "curves": ([(0, FREE), (1, "a"), (2, SPEC), (3, curve(3)), (4, curve(4)), (4.1, FREE)], [(2, "a"), (3, "a")]),
    "a curve after a scan": (
        [*BEGIN, (9, FREE), (10, SPEC), (11, scan(9)), (12, curve(12)), (12.1, FREE)],
        [(2, "a"), (10, "a")],
    ),
}


@pytest.mark.parametrize(("steps", "truth"), SEQUENCES.values(), ids=SEQUENCES)
def test_start_and_holder(steps: list[Step], truth: list[tuple[float | None, str | None]]) -> None:
    assert story(*steps) == truth


@pytest.mark.parametrize("steps", [steps for steps, _ in SEQUENCES.values()], ids=SEQUENCES)
def test_a_repeated_state_changes_nothing(steps: list[Step]) -> None:
    twice = [one for step in steps for one in ([step, step] if isinstance(step[1], ScopeState) else [step])]
    assert story(*twice) == story(*steps)
