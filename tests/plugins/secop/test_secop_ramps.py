"""Ramps in simulated time with faults: nothing is measured outside the band, and no rate is exceeded.

`AFSPM_RAMPS=1000 pytest tests/plugins/secop/test_secop_ramps.py` runs more of them.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import pytest
from tests.plugins.secop.ramp_night import FAULTS, RATE_K_S, Cryostat, RampNight

from afspm.model import InstrumentOrder, Parameter
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


@pytest.mark.parametrize(
    ("target_k", "value_k", "first_k"),
    [(4.2, 4.9, 4.2), (4.21, 4.2, 4.21), (300.0, 5.0, 5.0)],
    ids=["disturbed", "a near target set at the panel", "on the way to a far target set at the panel"],
)
def test_steps_begin_at_the_target_unless_another_client_has_set_it_far_away(
    target_k: float, value_k: float, first_k: float
) -> None:
    cryostat, client = Cryostat(has_ramp=False, chance=random.Random(1)), SecopClient({"cryo.t": "tt"})
    changes: list[str] = []

    def exchange(lines: list[str], now_s: float) -> None:
        for line in lines:
            changes.extend([line] if line.startswith("change ") else [])
            for answer in cryostat.answer(line):
                exchange(client.take(answer, now_s), now_s)

    exchange(client.connected(0.0), 0.0)
    exchange(client.tick(1.0), 1.0)
    cryostat.target_k, cryostat.value_k = target_k, value_k
    exchange(client.tick(2.0), 2.0)
    exchange(client.order(InstrumentOrder(1, "series/1", Parameter("cryo.t", "5.5", "K"), RATE_K_S, "K"), 2.0), 2.0)
    assert float(changes[0].split()[2]) == pytest.approx(first_k, abs=0.01)


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
