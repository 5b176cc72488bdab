"""Ramps in simulated time with faults: nothing is measured outside the band, and no rate is exceeded.

`AFSPM_RAMPS=1000 pytest tests/plugins/secop/test_secop_ramps.py` runs more of them.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from tests.plugins.secop.ramp_night import FAULTS, RATE_K_S, Cryostat, RampNight

from afspm.model import ControlResponse, InstrumentOrder, Parameter
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


@dataclass
class Bench:
    """A client at a simulated server without a ramp.

    Attributes:
        changes: the targets that the client has set.
        now_s: the time of the last exchange.
    """

    cryostat: Cryostat = field(default_factory=lambda: Cryostat(has_ramp=False, chance=random.Random(1)))
    client: SecopClient = field(default_factory=lambda: SecopClient({"cryo.t": "tt"}))
    changes: list[float] = field(default_factory=list)
    now_s: float = 0.0

    def exchange(self, lines: list[str]) -> None:
        for line in lines:
            self.changes.extend([float(line.split()[2])] if line.startswith("change tt:target ") else [])
            for answer in self.cryostat.answer(line):
                self.exchange(self.client.take(answer, self.now_s))

    def later(self, seconds: float) -> None:
        self.now_s += seconds
        self.exchange(self.client.tick(self.now_s))

    def connect(self) -> None:
        self.exchange(self.client.connected(self.now_s))
        self.later(1.0)

    def order(self, kelvin: str, number: int = 1) -> None:
        order = InstrumentOrder(number, f"series/{number}", Parameter("cryo.t", kelvin, "K"), RATE_K_S, "K")
        self.exchange(self.client.order(order, self.now_s))


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.connect()
    return made


@pytest.mark.parametrize(
    ("target_k", "value_k", "is_busy", "first_k"),
    [
        (4.2, 4.9, True, 4.2),
        (4.21, 4.2, False, 4.21),
        (300.0, 5.0, True, 5.0),
        (4.2, 9.0, False, 9.0),
    ],
    ids=["disturbed", "a near target set at the panel", "on the way to a far target set at the panel", "moved away"],
)
def test_steps_begin_at_the_target_if_it_is_in_force(
    bench: Bench, target_k: float, value_k: float, is_busy: bool, first_k: float
) -> None:
    bench.cryostat.target_k, bench.cryostat.value_k, bench.cryostat.is_busy = target_k, value_k, is_busy
    bench.later(1.0)
    bench.order("5.5")
    assert bench.changes[0] == pytest.approx(first_k, abs=0.01)


def test_steps_begin_at_the_value_while_the_control_loop_is_off(bench: Bench) -> None:
    bench.cryostat.value_k = 9.0
    bench.later(1.0)
    bench.exchange(bench.client.take("update tt:control_active [false, {}]", bench.now_s))
    bench.order("8")
    assert bench.changes[0] == pytest.approx(9.0, abs=0.01)


def test_steps_begin_at_the_target_while_the_value_lags_behind(bench: Bench) -> None:
    bench.order("4.5", 1)
    for _ in range(15):
        bench.later(1.0)
    bench.cryostat.value_k, bench.cryostat.is_busy = 4.25, False  # the sample is slow
    bench.later(1.0)
    bench.order("5", 2)
    assert bench.changes[-1] == pytest.approx(4.5)


def test_steps_begin_at_a_value_that_was_moved_away_from_beside_the_target(bench: Bench) -> None:
    bench.order("4.5", 1)
    for _ in range(15):
        bench.later(1.0)
    for value_k in (4.4, 9.0):  # the sensor reads 0.1 K too little; then the cryostat is warmed up by hand
        bench.cryostat.value_k, bench.cryostat.is_busy = value_k, False
        bench.later(1.0)
    bench.order("8", 2)
    assert bench.changes[-1] == pytest.approx(9.0, abs=0.01)


def test_steps_go_on_at_a_server_that_rounds_a_target_after_its_answer(bench: Bench) -> None:
    bench.cryostat.decimals = 2
    bench.order("4.4123")
    for _ in range(10):
        bench.later(1.0)
    assert bench.changes[-1] == 4.4123
    bench.later(1.0)
    (reading,) = bench.client.readings(bench.now_s)
    assert (reading.target, bench.client.log) == (4.41, [])


def test_order_has_no_outcome_if_the_server_describes_itself_again_before_the_target_was_sent() -> None:
    bench = Bench(Cryostat(has_ramp=True, chance=random.Random(1)))
    bench.connect()
    order = InstrumentOrder(1, "series/1", Parameter("cryo.t", "20", "K"), RATE_K_S, "K")
    (change,) = bench.client.order(order, bench.now_s)
    (answer,) = bench.cryostat.answer(change)
    (without_ramp,) = Cryostat(has_ramp=False, chance=random.Random(1)).answer("describe")
    bench.client.take(without_ramp, bench.now_s)
    assert bench.client.take(answer, bench.now_s) == []
    assert bench.client.outcomes() == ()
    bench.exchange(bench.client.order(order, bench.now_s))
    assert bench.changes


def test_order_to_measure_is_answered_by_a_request_sent_after_it(bench: Bench) -> None:
    (_, *_), before = bench.client.tick(bench.now_s + 1.0), bench.cryostat.answer("read tt:value")
    bench.now_s += 1.5
    (read,) = bench.client.order(InstrumentOrder(1, "series/1", Parameter("cryo.t")), bench.now_s)
    bench.client.take(before[0], bench.now_s)
    assert bench.client.outcomes() == ()
    bench.cryostat.run(1.0)
    bench.exchange([read])
    assert [one.response for one in bench.client.outcomes()] == [ControlResponse.SUCCESS]
    assert bench.client.readings(bench.now_s)[0].age_s == 0.0


def test_order_to_measure_waits_while_the_server_repeats_an_old_value(bench: Bench) -> None:
    bench.later(1.0)
    bench.cryostat.fault = "frozen module"
    bench.now_s += 0.1
    bench.exchange(bench.client.order(InstrumentOrder(1, "series/1", Parameter("cryo.t")), bench.now_s))
    bench.later(1.0)
    assert bench.client.outcomes() == ()
    bench.cryostat.fault = "none"
    bench.later(1.0)
    assert [one.response for one in bench.client.outcomes()] == [ControlResponse.SUCCESS]


@pytest.mark.parametrize("fault", ["error", "nan", "away"])
def test_order_to_measure_is_refused_with_the_reason_of_the_server(bench: Bench, fault: str) -> None:
    bench.later(1.0)
    bench.cryostat.fault = fault
    if fault == "away":
        bench.client.lost("the server restarts")
    bench.exchange(bench.client.order(InstrumentOrder(1, "series/1", Parameter("cryo.t")), bench.now_s))
    (refused,) = bench.client.outcomes()
    assert refused.response == ControlResponse.PARAM_ERROR
    assert "cryo.t is not known: " in refused.reason


def test_error_of_the_server_that_names_no_parameter_ends_no_order(bench: Bench) -> None:
    order = InstrumentOrder(1, "series/1", Parameter("cryo.t", "5", "K"), RATE_K_S, "K")
    bench.client.order(order, bench.now_s)
    bench.client.take('error_change  ["ProtocolError", "what?", {}]', bench.now_s)
    assert bench.client.outcomes() == ()


def test_number_beyond_floats_is_no_number(bench: Bench) -> None:
    bench.exchange(bench.client.take(f"update tt:value [1{'0' * 400}, {{}}]", bench.now_s))
    (reading,) = bench.client.readings(bench.now_s)
    assert reading.value is None


@pytest.mark.parametrize("switch", ["ramp_enable", "use_ramp"])
def test_ramp_of_the_server_is_switched_on_before_the_target_is_set(switch: str) -> None:
    bench = Bench(Cryostat(has_ramp=True, chance=random.Random(1), ramp_switch=switch))
    bench.connect()
    bench.order("20")
    assert bench.changes == [20.0]
    bench.cryostat.run(1.0)
    assert bench.cryostat.setpoint_k == pytest.approx(4.2 + RATE_K_S)


def test_ramp_of_the_server_may_be_slower_than_the_limit() -> None:
    bench = Bench(Cryostat(has_ramp=True, chance=random.Random(1), fastest_k_min=1.0))
    bench.connect()
    bench.order("20")
    assert bench.changes == [20.0]
    assert bench.cryostat.ramp_k_min == 1.0


def test_target_is_moved_in_steps_if_the_ramp_can_not_be_switched_on() -> None:
    chance = random.Random(1)
    bench = Bench(Cryostat(has_ramp=True, chance=chance, ramp_switch="ramp_enable", switch_is_readonly=True))
    bench.connect()
    bench.order("20")
    assert bench.changes == [pytest.approx(4.2, abs=0.01)]


def test_steps_stay_within_the_range_of_the_server() -> None:
    bench = Bench()
    bench.cryostat.range_k, bench.cryostat.value_k = (4.0, 300.0), 3.9
    bench.cryostat.target_k, bench.cryostat.is_busy = 20.0, False
    bench.connect()
    bench.order("301", 1)
    (refused,) = bench.client.outcomes()
    assert "cryo.t = 301 must be between 4 and 300 K" in refused.reason
    bench.order("10", 2)
    assert bench.changes == [4.0]
    bench.order("301", 3)
    assert bench.client.readings(bench.now_s)[0].target == 10.0


def test_steps_wait_for_a_module_that_takes_no_target_while_it_moves(bench: Bench) -> None:
    bench.order("4.3")
    answer = bench.cryostat.answer
    is_busy = 'error_change tt:target ["IsBusy", "it is on its way to 4.2", {}]'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.cryostat, "answer", lambda line: [is_busy] if line.startswith("change") else answer(line))
        for _ in range(5):
            bench.later(1.0)
    (reading,) = bench.client.readings(bench.now_s)
    assert (reading.target, reading.busy) == (4.3, True)
    bench.later(1.0)
    assert bench.cryostat.target_k - 4.2 <= 2.0 * RATE_K_S
    for _ in range(5):
        bench.later(1.0)
    assert bench.cryostat.target_k == 4.3


def _believe_old_readings(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(known_instruments, "OLDEST_S", 60.0)


def _ignore_conditions(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Instruments, "refusal", lambda *_: "")
    patch.setattr(Instruments, "problems", lambda *_: {})


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
