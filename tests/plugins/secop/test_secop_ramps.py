"""Ramps in simulated time with faults: nothing is measured outside the band, and no rate is exceeded.

`AFSPM_RAMPS=1000 pytest tests/plugins/secop/test_secop_ramps.py` runs more of them.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest
from tests.plugins.secop.ramp_night import FAULTS, RampNight

from afspm.model import InstrumentOrder
from afspm.plugins.secop.lines import SecopLine
from afspm.plugins.secop.secop_client import SecopClient
from afspm.scheduler.instruments import known_instruments
from afspm.scheduler.instruments.known_instruments import Instruments

RAMPS = int(os.environ.get("AFSPM_RAMPS", "45"))
Patch = Callable[[pytest.MonkeyPatch], None]


@pytest.mark.parametrize("share", range(3))
def test_nothing_is_measured_outside_the_band_over_faults(share: int) -> None:
    nights = [RampNight(seed) for seed in range(share, RAMPS, 3)]
    for night in nights:
        night.run()
    assert sum(night.scans for night in nights) > len(nights)
    assert sum(night.moved_k > 0.1 for night in nights) > len(nights) / 4
    assert all(night.flags for night in nights if night.fault == "hung")


def _believe_old_readings(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(known_instruments, "OLDEST_S", 60.0)


def _ignore_conditions(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Instruments, "refusal", lambda *_: "")
    patch.setattr(Instruments, "problems", lambda _: {})


def _ignore_rates(patch: pytest.MonkeyPatch) -> None:
    order = SecopClient.order
    without = lambda self, one, now_s: order(self, _unrated(one), now_s)  # noqa: E731
    patch.setattr(SecopClient, "order", without)


def _believe_repeated_answers(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(SecopLine, "time", None)


def _unrated(order: InstrumentOrder) -> InstrumentOrder:
    return InstrumentOrder(order.number, order.id, order.parameter)


@pytest.mark.parametrize(
    ("broken", "fault"),
    [
        (_believe_old_readings, "instrument killed"),
        (_ignore_conditions, "disturbed"),
        (_ignore_rates, "none"),
        (_believe_repeated_answers, "frozen module"),
    ],
)
def test_ramps_find_a_decision_broken_on_purpose(broken: Patch, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert fault in FAULTS
    broken(monkeypatch)
    found = False
    for night in filter(lambda one: one.fault == fault, map(RampNight, range(200))):
        try:
            night.run()
        except AssertionError:
            found = True
            break
    assert found
