"""Checks of probe moves, after all scans: some controllers move the probe within the scan frame only."""

from __future__ import annotations

import math

from afspm.model import ControlRequest, ProbePosition, ScopeState, names
from afspm.testing.conformance import Failed, expect
from afspm.testing.translators.checks.frames import require_published_once
from afspm.testing.translators.measuring import NEAR, CheckMeasurements, in_words, number
from afspm.testing.translators.translator_suite import check
from afspm.wire import messages

_NEEDS = (names.PROBE_POS_X, names.PROBE_POS_Y)


def require_place(kit: CheckMeasurements, xy_m: tuple[float, float]) -> None:
    """Raise Failed unless `xy_m` is the probe's position, as published and by its parameters."""
    within_m = NEAR * min(kit.frames.whole.size_m)
    newest = kit.client.awaited_newest(ProbePosition, lambda position: math.dist(position.xy_m, xy_m) <= within_m)
    if newest is None:
        raise Failed("a ProbePosition", "none")
    expect(math.dist(newest.xy_m, xy_m) <= within_m, f"ProbePosition {in_words(xy_m)}", in_words(newest.xy_m))
    x_m, y_m = (number(kit.client.get(name), "m") for name in _NEEDS)
    expect(math.dist((x_m, y_m), xy_m) <= within_m, f"probe-pos-x, -y {in_words(xy_m)}", in_words((x_m, y_m)))


@check("probe/move", "the probe is moved: SS_MOVING, ProbePosition as set, once, SS_FREE", needs=_NEEDS)
def move(kit: CheckMeasurements) -> None:
    kit.move_probe(kit.frames.plain.region.center_m)
    require_place(kit, kit.frames.plain.region.center_m)
    observed = kit.move_probe(kit.frames.other.region.center_m, awaiting=ScopeState.FREE)
    require_published_once(observed, ProbePosition, "ProbePosition")
    require_place(kit, kit.frames.other.region.center_m)


@check("probe/one-axis", "only the coordinate that is present is set", needs=_NEEDS)
def one_axis(kit: CheckMeasurements) -> None:
    kit.move_probe(kit.frames.other.region.center_m)
    x_m, y_m = kit.frames.other.region.center_m
    y_m += 0.1 * min(kit.frames.whole.size_m)
    message = messages.ProbePosition(units="nm")
    message.point.y = y_m * 1e9
    mark = kit.client.observations.mark()
    kit.client.asked(ControlRequest.SET_PROBE_POS, message, "moving the probe in y, given in nm")
    kit.client.settled(mark, awaiting=ScopeState.FREE)
    require_place(kit, (x_m, y_m))
