"""Checks of interrupted and complete scans."""

from __future__ import annotations

import math

import numpy as np

from afspm.model import Scan, ScanParameters, ScopeState, ScopeStatus, names
from afspm.testing.conformance import Failed, Skipped, expect
from afspm.testing.translators.client import Observation, describe_all, scans, states
from afspm.testing.translators.measuring import SCAN_S, STOPPED_REAL_S, CheckMeasurements, Taken, difference
from afspm.testing.translators.translator_suite import check

_STOPPED_S = 5.0
"""Longest time from the answer to a stop until the controller is free: a line may have to be finished first."""


def stop_by_request(kit: CheckMeasurements, mark: int, stop: str, begun: ScopeState) -> float:
    """Stop the activity; return the time of the answer in experiment seconds."""
    client = kit.client
    expect(client.state is begun, f"SS_{begun.name} until it is stopped", describe_all(client.observations.since(mark)))
    kit.act(stop)
    return client.clock.now_s()


def require_broken_off(kit: CheckMeasurements, mark: int, stop: str, begun: ScopeState) -> list[Observation]:
    """Wait for the stop of the activity, check its states, and return all its publications."""
    client = kit.client
    client.wait_state(ScopeState.INTERRUPTED, mark)
    client.wait_state(ScopeState.FREE, mark, client.real_s(60.0))
    observed = client.settled(mark)
    expect(
        states(observed) == [f"SS_{begun.name}", "SS_INTERRUPTED", "SS_FREE"],
        f"SS_{begun.name}, SS_INTERRUPTED, SS_FREE after {stop}",
        describe_all(observed),
    )
    return observed


@check(
    "scan/cancel",
    "stop-scan stops a scan: SS_INTERRUPTED, SS_FREE, and no scan",
    needs=(names.START_SCAN, names.STOP_SCAN),
)
def cancel(kit: CheckMeasurements) -> None:
    client = kit.client
    mark, lasts_s = kit.begin_long_scan(kit.frames.other, STOPPED_REAL_S)
    answered_s = stop_by_request(kit, mark, names.STOP_SCAN, ScopeState.SCANNING)
    client.wait_state(ScopeState.INTERRUPTED, mark)
    # as long as the scan itself: without a stop it is free at the end of the scan, on a busy computer, too
    client.wait_state(ScopeState.FREE, mark, client.real_s(60.0 + (lasts_s or 0.0)))
    taken = Taken(None, client.observations.since(mark), lasts_s)
    left_s = None if lasts_s is None else taken.time_s(ScopeState.SCANNING) + lasts_s - answered_s
    is_simulated = client.clock.real_s(1.0) < 1.0 or client.patience > 1.0
    most_s = longest_stop_s(left_s, is_simulated=is_simulated)
    stopped_s = taken.time_s(ScopeState.FREE) - answered_s
    whole = "" if lasts_s is None else f", of a scan of {lasts_s:.3g} s"
    expect(stopped_s <= most_s, f"SS_FREE within {most_s:.3g} s of {names.STOP_SCAN}", f"{stopped_s:.3g} s{whole}")
    observed = require_broken_off(kit, mark, names.STOP_SCAN, ScopeState.SCANNING)
    expect(not scans(observed), "no Scan2d of a scan that was stopped", describe_all(observed))


def longest_stop_s(left_s: float | None, *, is_simulated: bool) -> float:
    """Return the longest experiment time from a stop until SS_FREE, in a scan that would go on for `left_s`."""
    half_s = math.inf if left_s is None else left_s / 2.0
    return half_s if is_simulated else min(half_s, _STOPPED_S)  # a busy computer makes the stop of an emulator late


@check("scan/stop-nothing", "stop-scan while nothing runs succeeds, and changes nothing", needs=(names.STOP_SCAN,))
def stop_nothing(kit: CheckMeasurements) -> None:
    kit.client.come_to_rest()
    mark = kit.client.observations.mark()
    kit.act(names.STOP_SCAN)
    observed = kit.client.settled(mark)
    expect(not states(observed), "no state after stopping nothing", describe_all(observed))


_NEEDS = (names.START_SCAN,)
CLOCK_S = 2.0
"""Files have times in whole seconds, and may be written a moment after the end."""
_FASTER, _SLOWER, _EDGES_S = 2.5, 5.0, 30.0
"""Bounds for a fast retrace, turns at the edges, and work of the controller before and after."""


@check("scan/order", "start-scan: SS_SCANNING, the Scan2d of every channel once, and only then SS_FREE", needs=_NEEDS)
def order(kit: CheckMeasurements) -> None:
    require_order(kit.scan("plain").observed, ScopeState.SCANNING, Scan)


def require_order(observed: list, begun: ScopeState, kind: type) -> None:  # type: ignore[type-arg]
    """Raise Failed unless the publications are SS_<begun>, results of a kind, SS_FREE, in this order."""
    results = [i for i, one in enumerate(observed) if isinstance(one.thing, kind)]
    named = "Scan2d" if kind is Scan else "Spec1d"
    right = f"SS_{begun.name}, {named} …, SS_FREE"
    expect(states(observed) == [f"SS_{begun.name}", "SS_FREE"], right, describe_all(observed))
    first = next(i for i, one in enumerate(observed) if one.state is begun)
    last = next(i for i, one in enumerate(observed) if one.state is ScopeState.FREE)
    expect(all(first < i < last for i in results), right, describe_all(observed))
    again = [i for i, one in enumerate(observed) if isinstance(one.thing, ScopeStatus)]
    expect(len(again) == 2, f"each state once: {right}", describe_all(observed))


@check("scan/channels", "every channel has a name of its own, and values everywhere", needs=_NEEDS)
def channels(kit: CheckMeasurements) -> None:
    taken = kit.scan("plain")
    found = [scan.channel for scan in taken.scans]
    expect(len(set(found)) == len(found), "each channel once", ", ".join(found))
    for scan in taken.scans:
        expect(scan.channel.strip(), "a channel with a name", "one without")
        missing = int(np.size(scan.values) - np.isfinite(scan.values).sum())
        expect(missing == 0, f"values in all pixels of {scan.channel!r}", f"{missing} that are not finite")


@check("scan/frame", "a scan has the frame and the pixels that were set", needs=_NEEDS)
def frame(kit: CheckMeasurements) -> None:
    require_frame(kit.scan("plain"))


def require_frame(taken: Taken) -> None:
    """Raise Failed unless the scans have the requested frame."""
    assert taken.frame is not None
    for scan in taken.scans:
        wrong = difference(taken.frame.region, scan.region)
        if wrong:
            raise Failed(f"a scan {scan.channel!r} of the frame that was set", wrong)
        (rows, columns), (ny, nx) = taken.frame.shape, scan.shape
        expect((ny, nx) == (rows, columns), f"{scan.channel!r} of {rows} rows and {columns} columns", f"{ny} and {nx}")


@check("scan/in-force", "a scan's parameters are the ScanParameters2d that were in force", needs=_NEEDS)
def as_published(kit: CheckMeasurements) -> None:
    taken = kit.scan("plain")
    before = [one for one in kit.client.observations.all if isinstance(one.thing, ScanParameters)]
    begun = taken.time_s(ScopeState.SCANNING)
    in_force = [one.thing for one in before if one.time_ns is not None and one.time_ns <= begun * 1e9]
    if not in_force:
        raise Skipped("no ScanParameters2d was published before the scan")
    wrong = difference(in_force[-1].region, taken.scans[0].region)
    if wrong:
        raise Failed("the region of the ScanParameters2d before it", wrong)


@check("scan/time", "a scan has the time at which it ended", needs=_NEEDS)
def time(kit: CheckMeasurements) -> None:
    taken = kit.scan("plain")
    for scan in taken.scans:
        require_time(scan.time_ns, taken, ScopeState.SCANNING, f"scan {scan.channel!r}")


def require_time(time_ns: int | None, taken: Taken, begun: ScopeState, what: str) -> None:
    """Raise Failed unless a measurement's time lies between half of its expected duration and its end.

    The tolerance is `CLOCK_S` on both sides.

    Raises:
        Skipped: the measurement has no time.
    """
    if time_ns is None:
        raise Skipped(f"the {what} has no time")
    begin_s, free_s = taken.time_s(begun), taken.time_s(ScopeState.FREE)
    lasted_s, at_s = free_s - begin_s, time_ns / 1e9 - begin_s
    # a controller may take long to save a scan, so SS_FREE does not give the time of its end
    least_s = 0.5 * min(lasted_s, taken.expected_s or lasted_s) - CLOCK_S
    if least_s <= at_s <= lasted_s + CLOCK_S:
        return
    came = f"{at_s:.3g} s from its beginning"
    if not -600.0 < at_s < lasted_s + 600.0:
        came += ": another time zone, or the controller's clock is wrong"
    raise Failed(f"the time at which the {what} ended, {lasted_s:.3g} s from its beginning", came)


@check(
    "scan/duration",
    "the duration of a scan follows from its frame and scan-speed",
    needs=(names.START_SCAN, names.SCAN_SPEED),
)
def duration(kit: CheckMeasurements) -> None:
    taken = kit.scan("plain")
    if taken.expected_s is None or taken.expected_s < SCAN_S / 2:
        raise Skipped("the speed could not be set low enough to measure it")
    lasted_s = taken.time_s(ScopeState.FREE) - taken.time_s(ScopeState.SCANNING)
    least_s, most_s = taken.expected_s / _FASTER, taken.expected_s * _SLOWER + _EDGES_S
    expect(
        least_s <= lasted_s <= most_s,
        f"a duration of about {taken.expected_s:.3g} s, from scan-speed (check its unit)",
        f"{lasted_s:.3g} s",
    )


@check("scan/again", "the same frame again is another scan, later than the first", needs=_NEEDS)
def again(kit: CheckMeasurements) -> None:
    first = kit.scan("plain")
    second = kit.take_scan(kit.frames.plain)
    require_order(second.observed, ScopeState.SCANNING, Scan)
    before, after = ({scan.channel for scan in taken.scans} for taken in (first, second))
    expect(before == after, f"the channels {sorted(before)} again", f"{sorted(after)}")
    for scan in second.scans:
        if scan.time_ns is not None:
            require_time(scan.time_ns, second, ScopeState.SCANNING, f"second scan {scan.channel!r}")
        old = next(one for one in first.scans if one.channel == scan.channel)
        if scan.filename:
            expect(scan.filename != old.filename, f"a new file for {scan.channel!r}", f"{old.filename} again")
        # a detector that is switched off gives constant zeros
        if np.ptp(old.values) > 0:
            alike = old.values.shape == scan.values.shape and np.array_equal(old.values, scan.values)
            same = alike and old.time_ns == scan.time_ns
            expect(not same, f"new values for {scan.channel!r}", "those of the scan before, at the same time")


@check("scan/not-square", "a frame wider than high, with other pixels, is scanned as it was set", needs=_NEEDS)
def not_square(kit: CheckMeasurements) -> None:
    require_frame(kit.scan("wide"))


@check(
    "scan/turned",
    "a rotated frame is scanned as it was set, counter-clockwise",
    needs=(names.START_SCAN, names.SCAN_ANGLE),
)
def turned(kit: CheckMeasurements) -> None:
    require_frame(kit.scan("turned"))
