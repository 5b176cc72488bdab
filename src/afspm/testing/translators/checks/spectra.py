"""Checks of interrupted and complete spectra."""

from __future__ import annotations

import math

import numpy as np

from afspm.model import ProbePosition, ScopeState, Spectrum, names
from afspm.testing.conformance import Failed, Skipped, expect
from afspm.testing.translators.checks.scans import CLOCK_S, require_broken_off, require_order, stop_by_request
from afspm.testing.translators.client import describe_all, spectra, states
from afspm.testing.translators.measuring import NEAR, CheckMeasurements, in_words
from afspm.testing.translators.translator_suite import check

_NEEDS = (names.START_SPEC,)


@check(
    "spectrum/cancel",
    "stop-spec stops a spectrum: SS_INTERRUPTED, SS_FREE, and no spectrum",
    needs=(names.START_SPEC, names.STOP_SPEC),
)
def cancel(kit: CheckMeasurements) -> None:
    mark, answered_s = kit.begin_spectrum(), math.inf
    try:
        answered_s = stop_by_request(kit, mark, names.STOP_SPEC, ScopeState.SPEC)
        observed = require_broken_off(kit, mark, names.STOP_SPEC, ScopeState.SPEC)
    except Failed:
        if _was_over(kit, mark, answered_s):
            raise Skipped("a spectrum ends before it can be stopped") from None
        raise
    expect(not spectra(observed), "no Spec1d of a spectrum that was stopped", describe_all(observed))


def _was_over(kit: CheckMeasurements, mark: int, answered_s: float) -> bool:
    # a spectrum that ended by itself before the stop was answered could not be stopped
    client = kit.client
    observed = client.settled(mark)
    ended_s = client.observations.at_s(ScopeState.FREE, mark)
    if ended_s is None or ended_s > answered_s:
        return False
    first, *between, last = [str(one) for one in observed if one.state is not None or isinstance(one.thing, Spectrum)]
    return (first, {*between}, last) == ("SS_SPEC", {"Spec1d"}, "SS_FREE")


@check("spectrum/stop-nothing", "stop-spec while nothing runs succeeds, and changes nothing", (names.STOP_SPEC,))
def stop_nothing(kit: CheckMeasurements) -> None:
    kit.client.come_to_rest()
    mark = kit.client.observations.mark()
    kit.act(names.STOP_SPEC)
    observed = kit.client.settled(mark)
    expect(not states(observed), "no state after stopping nothing", describe_all(observed))


@check("spectrum/order", "start-spec: SS_SPEC, the Spec1d, and only then SS_FREE", needs=_NEEDS)
def order(kit: CheckMeasurements) -> None:
    taken = kit.spectrum()
    require_order(taken.observed, ScopeState.SPEC, Spectrum)


@check("spectrum/values", "a spectrum has a kind, variables of different names, and values", needs=_NEEDS)
def values(kit: CheckMeasurements) -> None:
    for spectrum in kit.spectrum().spectra:
        expect(spectrum.kind.strip(), "a spectrum with a type", "an empty type")
        expect(len(set(spectrum.names)) == len(spectrum.names) >= 2, "two variables or more, of different names",
               ", ".join(spectrum.names) or "none")  # fmt: skip
        expect(len(spectrum.values) >= 2, "two points or more", f"{len(spectrum.values)}")
        for name, column in zip(spectrum.names, spectrum.values.T, strict=True):
            expect(bool(np.isfinite(column).any()), f"values of {name!r}", "none that is finite")


@check("spectrum/position", "a spectrum has the position of the probe", needs=(*_NEEDS, names.PROBE_POS_X))
def position(kit: CheckMeasurements) -> None:
    wanted = kit.frames.other.region.center_m
    for spectrum in kit.spectrum().spectra:
        if spectrum.position_m is None:
            raise Failed(f"a spectrum at {in_words(wanted)}", "one without a position")
        apart_m = math.dist(spectrum.position_m, wanted)
        within_m = NEAR * min(kit.frames.whole.size_m)
        expect(apart_m <= within_m, f"a spectrum at {in_words(wanted)}", in_words(spectrum.position_m))
    where = kit.client.observations.newest(ProbePosition)
    expect(where is not None, "a ProbePosition", "none")


@check("spectrum/time", "a spectrum has its time", needs=_NEEDS)
def time(kit: CheckMeasurements) -> None:
    taken = kit.spectrum()
    begin_s, end_s = taken.time_s(ScopeState.SPEC), taken.time_s(ScopeState.FREE)
    for spectrum in taken.spectra:
        if spectrum.time_ns is None:
            raise Skipped("the spectrum has no time")
        at_s = spectrum.time_ns / 1e9
        expect(
            begin_s - CLOCK_S <= at_s <= end_s + CLOCK_S,
            f"a time between the spectrum's beginning and its end {end_s - begin_s:.3g} s later",
            f"{at_s - begin_s:+.6g} s from its beginning",
        )
