"""Parameters of other instruments: orders in the answers to reports, and conditions for measuring."""

from __future__ import annotations

from typing import Any

import pytest

from afspm import wire
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    InstrumentReading,
    InstrumentReadings,
    OrderOutcome,
    Parameter,
    ProblemNames,
    RelayedMessage,
    Request,
    Response,
)
from afspm.model.instruments import InstrumentOrders
from afspm.model.parameter_names import START_SCAN
from afspm.scheduler.events import (
    Connected,
    Forward,
    Publish,
    Reply,
    RequestIn,
    Tick,
    TranslatorCaughtUp,
    TranslatorReply,
    TranslatorUp,
)
from afspm.scheduler.instruments.conditions import AllowedBand, InstrumentSettings, MeasuringCondition
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.settings import ControlSettings, SchedulerSettings
from afspm.scheduler.wire_codec import WireCodec

COLD, T = 100, "cryo.t"


class Cryo:
    """A scheduler with one instrument `cryo`, and a series in control."""

    def __init__(self, band: AllowedBand, *, problem: str = "", saved: SavedState | None = None) -> None:
        problems = ProblemNames({"cold": COLD})
        control = ControlSettings()
        limit = Limit(low=1.0, high=300.0, rate_per_s=0.5, only=("series",), unit="K")
        condition = MeasuringCondition({T: band}, problem=problem)
        instruments = InstrumentSettings(("cryo",), {"cold": condition}, {"cold": COLD} if problem else {})
        settings = SchedulerSettings(
            control, control.rules(problems), control.watchdog(), ExperimentLimits({T: limit}), instruments
        )
        self.core = SchedulerCore(settings, WireCodec())
        if saved is not None:
            self.core.restore(saved)
        self.now_s, self.now_ns = 100.0, 1_750_000_000 * 10**9
        self.answers: dict[str, Response] = {}
        self.forwards: list[Forward] = []
        self.published: list[InstrumentReadings] = []
        self.token = self.count = 0
        self.connections: dict[str, int] = {}
        self.core.start(self.now_s, self.now_ns)
        self.step(TranslatorUp())
        self.step(TranslatorCaughtUp())
        question = self.forwards.pop()
        self.step(TranslatorReply(question.number, Response(int(ControlResponse.SUCCESS))))
        self.later(1.0)  # no reading is from before the start

    def step(self, event: Any) -> None:
        for effect in self.core.step(event, self.now_s, self.now_ns):
            if isinstance(effect, Reply):
                self.answers[effect.response.id] = effect.response
            elif isinstance(effect, Forward):
                self.forwards.append(effect)
            elif isinstance(effect, Publish) and effect.packet.envelope == "InstrumentReadings_cryo":
                self.published.append(wire.decode("InstrumentReadings", effect.packet.payload))

    def later(self, seconds: float) -> None:
        self.now_s += seconds
        self.now_ns += round(seconds * 1e9)
        for _ in range(4):
            self.step(Tick())

    def ask(self, kind: int, subject: object, name: str = "series") -> str:
        if name not in self.connections:
            self.connections[name] = len(self.connections) + 1
            self.step(Connected(self.connections[name]))
        self.count += 1
        request_id = f"{name}/1/{self.count}"
        self.step(RequestIn(self.connections[name], name, Request(kind, subject, id=request_id)))
        return request_id

    def answer_to(self, kind: int, subject: object, name: str = "series") -> tuple[int, str]:
        answer = self.answers[self.ask(kind, subject, name)]
        return answer.code, answer.reason

    def send_report(
        self,
        value: float | None = 4.2,
        unit: str = "K",
        *outcomes: OrderOutcome,
        patience_s: float = 0.0,
        **reading: Any,
    ) -> str:
        reading = {"age_s": 0.1, "target": 4.2, **reading}
        readings = (InstrumentReading(T, value, unit, **reading),)
        report = InstrumentReadings(self.now_ns, "cryo", readings, outcomes, self.token, patience_s)
        return self.ask(RELAY_REQUEST, RelayedMessage(*wire.encode(report)), "cryo")

    def report(self, *given: Any, **reading: Any) -> InstrumentOrders:
        return self.orders_of(self.send_report(*given, **reading))

    def orders_of(self, report: str) -> InstrumentOrders:
        orders = wire.decode_instrument_orders(self.answers[report].payload)
        self.token = orders.token
        return orders

    def known(self, value: float = 4.2) -> None:
        """Report twice: only the second report repeats a token."""
        self.report(value)
        self.report(value)

    def in_control(self) -> None:
        assert self.answer_to(ControlRequest.REQUEST_CTRL, 0)[0] == ControlResponse.SUCCESS

    @property
    def is_flagged(self) -> bool:
        return COLD in self.core.control.problems


@pytest.fixture
def cryo() -> Cryo:
    made = Cryo(AllowedBand(4.15, 4.25, unit="K"))
    made.in_control()
    return made


def test_set_request_is_carried_in_the_answer_to_a_report(cryo: Cryo) -> None:
    cryo.known()
    asked = cryo.ask(ControlRequest.PARAM, Parameter(T, "20", "K"))
    assert asked not in cryo.answers
    assert cryo.forwards == []
    (order,) = cryo.report().orders
    assert (order.id, order.parameter, order.rate_per_s, order.rate_unit) == (asked, Parameter(T, "20", "K"), 0.5, "K")
    assert cryo.report().orders == (order,)  # until its outcome is reported
    done = cryo.report(4.2, "K", OrderOutcome(order.number, 0), target=20.0)
    assert done.orders == ()
    assert cryo.answers[asked].ok
    assert wire.decode_parameter(cryo.answers[asked].payload) == Parameter(T, "20.0", "K")


def test_limits_roles_and_control_hold_for_an_instrument(cryo: Cryo) -> None:
    cryo.known()
    for value, why in (
        ("301", "above the highest allowed"),
        ("nan", "not a finite number"),
        ("5 mV", "is not a number"),
    ):
        asked = cryo.ask(ControlRequest.PARAM, Parameter(T, value, "K"))
        cryo.report()
        assert why in cryo.answers[asked].reason
    assert cryo.answer_to(ControlRequest.PARAM, Parameter(T, "5", "K"), "other")[0] == ControlResponse.NOT_IN_CONTROL
    # a large step after a long pause is no breach of the rate: the instrument keeps it on the way
    cryo.later(1.0)
    cryo.known()
    asked = cryo.ask(ControlRequest.PARAM, Parameter(T, "290", "K"))
    assert len(cryo.report().orders) == 1
    assert asked not in cryo.answers


def test_order_is_refused_if_control_was_lost_before_it_is_handed_out(cryo: Cryo) -> None:
    cryo.known()
    asked = cryo.ask(ControlRequest.PARAM, Parameter(T, "20", "K"))
    cryo.ask(ControlRequest.RELEASE_CTRL, None)
    assert cryo.report().orders == ()
    assert cryo.answers[asked].code == ControlResponse.NOT_IN_CONTROL


def test_nothing_is_set_while_the_value_is_unknown(cryo: Cryo) -> None:
    cryo.report()
    asked = cryo.ask(ControlRequest.PARAM, Parameter(T, "20", "K"))
    cryo.report(None, reason="no sensor")
    assert "can't be set while its value is not known: no sensor" in cryo.answers[asked].reason


def test_silent_instrument_answers_not_sent_or_unknown(cryo: Cryo) -> None:
    cryo.known()
    first = cryo.ask(ControlRequest.PARAM, Parameter(T, "20", "K"))
    cryo.later(5.1)
    assert cryo.answers[first].reason.startswith("not sent: cryo has not reported")
    cryo.known()
    second = cryo.ask(ControlRequest.PARAM, Parameter(T, "20", "K"))
    (order,) = cryo.report().orders
    cryo.later(5.1)
    assert cryo.answers[second].reason.startswith("outcome unknown")
    assert cryo.report(4.2, "K", OrderOutcome(order.number, 0)).orders == ()  # too late: nothing is answered twice


def test_values_are_read_from_the_last_report(cryo: Cryo) -> None:
    assert "cryo has not reported it" in cryo.answer_to(ControlRequest.PARAM, Parameter(T))[1]
    cryo.report()  # a first report repeats no token: how long it was on its way is unknown
    assert "older than 4 s" in cryo.answer_to(ControlRequest.PARAM, Parameter(T))[1]
    cryo.report(busy=True)
    found = [wire.decode_parameter(cryo.answers[cryo.ask(ControlRequest.PARAM, Parameter(name))].payload)
             for name in (T, f"{T}.target", f"{T}.busy")]  # fmt: skip
    assert found == [Parameter(T, "4.2", "K"), Parameter(f"{T}.target", "4.2", "K"), Parameter(f"{T}.busy", "true")]
    cryo.later(4.1)
    assert "older than 4 s" in cryo.answer_to(ControlRequest.PARAM, Parameter(T))[1]


def test_value_is_measured_again_after_a_set_of_the_run(cryo: Cryo) -> None:
    # spectra F7: the reading of before a set looked fresh
    cryo.known()
    assert cryo.ask(ControlRequest.PARAM, Parameter(T)) in cryo.answers
    for name, wanted in (("tip-bias-voltage", Parameter("tip-bias-voltage", "1", "V")), (T, Parameter(T, "20", "K"))):
        cryo.ask(ControlRequest.PARAM, wanted)
        if name == T:
            (order,) = cryo.report(4.2).orders
            cryo.report(4.2, "K", OrderOutcome(order.number, 0), target=20.0)
        else:
            cryo.step(TranslatorReply(cryo.forwards.pop().number, Response(int(ControlResponse.SUCCESS))))
        cryo.later(0.05)
        asked = cryo.ask(ControlRequest.PARAM, Parameter(T))
        assert asked not in cryo.answers
        (order,) = cryo.report(4.3).orders
        assert (order.is_reading, order.parameter, order.id) == (True, Parameter(T), asked)
        assert cryo.report(4.4).orders == (order,)
        cryo.report(19.0, "K", OrderOutcome(order.number, 0), age_s=0.0)
        assert wire.decode_parameter(cryo.answers[asked].payload) == Parameter(T, "19.0", "K")
        cryo.later(1.0)
        cryo.known(18.0)
        assert cryo.ask(ControlRequest.PARAM, Parameter(T)) in cryo.answers  # from after the set


def test_part_now_is_measured_and_part_age_is_the_longest_time_since(cryo: Cryo) -> None:
    cryo.known()
    cryo.later(2.0)
    age = wire.decode_parameter(cryo.answers[cryo.ask(ControlRequest.PARAM, Parameter(f"{T}.age"))].payload)
    assert (float(age.value or "nan"), age.unit) == (pytest.approx(2.1), "s")
    now = cryo.ask(ControlRequest.PARAM, Parameter(f"{T}.now"), "watcher")  # needs no control
    (order,) = cryo.report().orders
    cryo.report(None, "K", OrderOutcome(order.number, int(ControlResponse.PARAM_ERROR), "no sensor"), reason="x")
    assert (cryo.answers[now].code, cryo.answers[now].reason) == (ControlResponse.PARAM_ERROR, "no sensor")
    assert "is not known" in cryo.answer_to(ControlRequest.PARAM, Parameter(f"{T}.now"), "watcher")[1]
    asked = cryo.ask(ControlRequest.PARAM, Parameter(f"{T}.now", "5", "K"))
    cryo.report()
    assert "can only be read" in cryo.answers[asked].reason


def test_measuring_ends_without_an_answer_of_the_instrument(cryo: Cryo) -> None:
    cryo.known()
    asked = cryo.ask(ControlRequest.PARAM, Parameter(f"{T}.now"))
    assert len(cryo.report().orders) == 1
    cryo.later(5.1)
    assert "cryo has sent no new value of cryo.t" in cryo.answers[asked].reason
    assert cryo.report().orders == ()


def test_answer_to_a_patient_report_waits_for_an_order(cryo: Cryo) -> None:
    cryo.known()
    for kind in (Parameter(f"{T}.now"), Parameter(T, "20", "K")):
        held = cryo.send_report(patience_s=0.2)
        assert held not in cryo.answers
        asked = cryo.ask(ControlRequest.PARAM, kind)
        (order,) = cryo.orders_of(held).orders
        assert order.id == asked
        cryo.report(4.2, "K", OrderOutcome(order.number, 0), target=20.0)
        assert cryo.answers[asked].ok
    held = cryo.send_report(patience_s=0.2)
    cryo.later(0.1)
    assert held not in cryo.answers
    cryo.later(0.11)
    assert cryo.orders_of(held).orders == ()


def test_report_that_waited_in_a_queue_is_as_old_as_its_token(cryo: Cryo) -> None:
    cryo.known()
    cryo.now_s += 10.0  # the scheduler was frozen: no Tick, and the report is from before
    cryo.report(4.2)
    assert "older than 4 s" in cryo.answer_to(ControlRequest.PARAM, Parameter(T))[1]


def test_report_with_a_token_before_the_last_is_of_unknown_age(cryo: Cryo) -> None:
    cryo.known()
    before_last = cryo.token
    cryo.report(4.2)
    cryo.token = before_last
    cryo.report(4.2)
    assert "older than 4 s" in cryo.answer_to(ControlRequest.PARAM, Parameter(T))[1]


def test_reading_in_another_unit_is_not_believed_also_after_a_restart(cryo: Cryo) -> None:
    cryo.known()
    for scheduler in (cryo, Cryo(AllowedBand(4.15, 4.25, unit="K"), saved=cryo.core.snapshot())):
        scheduler.report(4200.0, "mK")
        scheduler.report(4200.0, "mK")
        assert "unit changed from 'K' to 'mK'" in scheduler.answer_to(ControlRequest.PARAM, Parameter(T))[1]


def test_component_reports_only_its_own_parameters(cryo: Cryo) -> None:
    foreign = InstrumentReadings(cryo.now_ns, "cryo", (InstrumentReading("magnet.b", 1.0, "T", 0.0),))
    told = RelayedMessage(*wire.encode(foreign))
    assert cryo.answer_to(RELAY_REQUEST, told, "cryo")[0] == ControlResponse.FAILURE
    own = InstrumentReadings(cryo.now_ns, "cryo", (InstrumentReading(T, 1.0, "K", 0.0),))
    assert cryo.answer_to(RELAY_REQUEST, RelayedMessage(*wire.encode(own)), "magnet")[0] == ControlResponse.FAILURE


def test_scan_is_refused_outside_the_band(cryo: Cryo) -> None:
    cryo.known(4.3)
    code, why = cryo.answer_to(ControlRequest.ACTION, START_SCAN)
    assert code == ControlResponse.NOT_FREE
    assert "cold does not hold: cryo.t is 4.3 K, above 4.25 K" in why
    cryo.known(4.2)
    cryo.ask(ControlRequest.ACTION, START_SCAN)
    assert [one.request.subject for one in cryo.forwards] == [START_SCAN]


def test_band_around_the_target_and_its_time() -> None:
    cryo = Cryo(AllowedBand(within=0.02, for_s=10.0, unit="K"))
    cryo.in_control()
    cryo.known(4.21)
    assert "has been in its band for" in cryo.answer_to(ControlRequest.ACTION, START_SCAN)[1]
    for _ in range(8):
        cryo.later(1.5)
        cryo.report(4.21)
    cryo.ask(ControlRequest.ACTION, START_SCAN)
    (started,) = cryo.forwards
    cryo.step(TranslatorReply(started.number, Response(int(ControlResponse.SUCCESS))))
    cryo.report(4.25)
    assert "more than 0.02 K from its target 4.2 K" in cryo.answer_to(ControlRequest.ACTION, START_SCAN)[1]


def test_problem_is_flagged_while_the_condition_does_not_hold() -> None:
    cryo = Cryo(AllowedBand(4.15, 4.25, unit="K"), problem="cold")
    cryo.later(0.1)
    cryo.later(4.2)
    assert cryo.is_flagged
    cryo.known()
    cryo.later(0.1)
    assert not cryo.is_flagged
    cryo.in_control()
    for value in (4.3, float("nan"), None):
        cryo.report(value)
        cryo.later(0.01)
        assert cryo.is_flagged
        cryo.known()
        cryo.later(0.01)
        assert not cryo.is_flagged
    cryo.later(4.2)  # no report at all
    assert cryo.is_flagged
    assert cryo.core.control.holder is None


def test_first_reading_is_awaited_before_a_problem_is_flagged_but_not_for_ever() -> None:
    cryo = Cryo(AllowedBand(4.15, 4.25, unit="K"), problem="cold")
    cryo.in_control()
    cryo.report(None, reason="not connected yet")
    cryo.later(0.1)
    cryo.later(3.8)
    assert not cryo.is_flagged
    assert "cold does not hold" in cryo.answer_to(ControlRequest.ACTION, START_SCAN)[1]
    deadline_s = cryo.core.deadline_s()
    assert deadline_s is not None
    assert deadline_s <= cryo.now_s + 0.2
    cryo.later(0.2)
    assert cryo.is_flagged
    again = Cryo(AllowedBand(4.15, 4.25, unit="K"), problem="cold", saved=cryo.core.snapshot())
    again.later(0.1)
    assert again.is_flagged, "a flag of before the restart stays until a reading"
    first = Cryo(AllowedBand(4.15, 4.25, unit="K"), problem="cold")
    first.known(4.3)
    first.later(0.1)
    assert first.is_flagged


def test_flag_of_a_component_is_not_cleared_by_a_condition() -> None:
    cryo = Cryo(AllowedBand(4.15, 4.25, unit="K"), problem="cold")
    cryo.known()
    cryo.later(0.1)
    cryo.ask(ControlRequest.ADD_EXP_PRBLM, COLD, "watch")
    cryo.report(5.0)
    cryo.later(0.1)
    cryo.known()
    cryo.later(0.1)
    assert cryo.core.control.problems == {COLD: "watch"}


def test_readings_are_published_when_they_change_and_every_ten_seconds(cryo: Cryo) -> None:
    for i in range(100):
        cryo.report(4.2 + 0.001 * (i < 20))
        cryo.later(0.25)
    values = [one.readings[0].value for one in cryo.published]
    assert values[-1] == 4.2
    assert 3 <= len(values) <= 7
