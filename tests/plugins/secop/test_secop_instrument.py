"""The component of a SECoP server over a restart of its process."""

from __future__ import annotations

import json
import logging
import random
import socket
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
from client_lab import FakeClock
from tests.plugins.secop.ramp_night import RATE_K_S, Cryostat

from afspm.basics import TransportError
from afspm.model import InstrumentOrder, InstrumentReadings, Parameter
from afspm.model.instruments import InstrumentOrders
from afspm.plugins.secop import instrument
from afspm.plugins.secop.instrument import GOES_ON_WITHIN_S, Instrument


class Cryo:
    """An experiment of one cryostat, whose component can be killed and started again."""

    def __init__(self) -> None:
        self.cryostat = Cryostat(has_ramp=False, chance=random.Random(1))
        self.clock = FakeClock()
        self.memory: dict[str, Any] = {}
        self.orders: tuple[InstrumentOrder, ...] = ()
        self.answers: list[str] = []
        self.reports: list[InstrumentReadings] = []
        self.start()

    def start(self) -> None:
        self.component = Instrument("secop://cryo-pc", {"cryo.t": "tt"})
        log = logging.getLogger("cryo")
        vars(self.component).update(name="cryo", log=log, clock=self.clock, memory=self.memory, scope=self)
        self.component.on_start()

    def connect(self, host: str, port: int) -> SimpleNamespace:
        self.answers = []
        wait = lambda within_s: bool(self.answers)  # noqa: E731
        return SimpleNamespace(receive=self.receive, send=self.send, wait=wait, close=lambda: None)

    def send(self, lines: list[str]) -> None:
        self.answers += [answer for line in lines for answer in self.cryostat.answer(line)]

    def receive(self) -> list[str]:
        received, self.answers = self.answers, []
        return received

    def report_readings(self, report: InstrumentReadings) -> InstrumentOrders:
        self.reports.append(report)
        orders, self.orders = self.orders, ()
        return InstrumentOrders(1, orders)

    def later(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.25)):
            self.clock.passed_s += 0.25
            self.component.on_tick()


@pytest.fixture
def cryo(monkeypatch: pytest.MonkeyPatch) -> Cryo:
    made = Cryo()
    monkeypatch.setattr(instrument, "LineSocket", made.connect)
    made.later(2.0)
    made.orders = (InstrumentOrder(1, "series/1", Parameter("cryo.t", "4.5", "K"), RATE_K_S, "K"),)
    made.later(4.0)
    assert 4.2 < made.cryostat.target_k < 4.5
    return made


def test_steps_go_on_after_a_kill(cryo: Cryo) -> None:
    cryo.clock.passed_s += GOES_ON_WITHIN_S / 2.0
    before_k = cryo.cryostat.target_k
    cryo.start()
    cryo.later(2.5)
    assert before_k < cryo.cryostat.target_k <= before_k + 2.0 * RATE_K_S
    assert (cryo.reports[-1].readings[0].target, cryo.reports[-1].readings[0].busy) == (4.5, True)
    cryo.later(15.0)
    assert cryo.cryostat.target_k == 4.5
    assert not cryo.memory["steps"]["of"]


def test_steps_do_not_go_on_if_another_target_was_set_meanwhile(cryo: Cryo) -> None:
    cryo.cryostat.target_k = 5.0
    cryo.start()
    cryo.later(5.0)
    assert cryo.cryostat.target_k == 5.0


@pytest.mark.parametrize("is_stopped", [True, False], ids=["stopped", "away for long"])
def test_steps_halt_if_the_component_is_stopped_or_away_for_long(
    cryo: Cryo, is_stopped: bool, caplog: pytest.LogCaptureFixture
) -> None:
    before_k = cryo.cryostat.target_k
    if is_stopped:
        cryo.component.on_end()
    else:
        cryo.clock.passed_s += GOES_ON_WITHIN_S + 1.0
    cryo.start()
    cryo.later(5.0)
    assert cryo.cryostat.target_k == before_k
    assert "the steps of cryo.t" in caplog.text


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (b"", "no SECoP server answers: no description within 0.2 s, and nothing last"),
        (
            b"SSH-2.0-OpenSSH_9.2\r\n",
            "no SECoP server answers: no description within 0.2 s, and 'SSH-2.0-OpenSSH_9.2' last",
        ),
    ],
    ids=["silent", "another program"],
)
def test_trial_of_the_connection_names_what_answers_instead_of_a_server(
    sent: bytes, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(instrument, "DESCRIBED_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as other:
        address = "{}:{}".format(*server.getsockname())

        def answer() -> None:
            peer, _ = server.accept()
            with peer:
                peer.sendall(sent)
                while peer.recv(1 << 10):
                    pass

        done = other.submit(answer)
        with pytest.raises(TransportError, match=reason) as error:
            Instrument(f"secop://{address}", {"cryo.t": "tt"}).try_connection()
        done.result(10.0)
    assert error.value.where == address


def test_server_of_ten_thousand_modules_is_described() -> None:
    value = {"datainfo": {"type": "double", "unit": "K", "min": 0.0, "max": 300.0}}
    target = {**value, "readonly": False, "description": "the target"}
    modules = {f"m{number}": {"accessibles": {"value": value, "target": target}} for number in range(10_000)}
    sent = f"ISSE,SECoP,V2021-02-22,v1.1\ndescribing . {json.dumps({'modules': modules})}\nactive\n".encode()
    assert len(sent) > 1 << 20
    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as other:
        host, port = server.getsockname()

        def answer() -> None:
            peer, _ = server.accept()
            with peer:
                peer.sendall(sent)
                while peer.recv(1 << 10):
                    pass

        done = other.submit(answer)
        Instrument(f"secop://{host}:{port}", {"cryo.t": "m9999"}).try_connection()
        done.result(10.0)


@pytest.mark.parametrize("levels", [200, 50_000])
def test_nested_json_of_a_server_does_not_end_the_component(cryo: Cryo, levels: int) -> None:
    cryo.answers.append("update tt:value " + "[" * levels + "]" * levels)
    cryo.later(0.5)
    assert cryo.reports[-1].readings[0].value is None
    assert "this is no SECoP server" in cryo.reports[-1].readings[0].reason
    cryo.later(10.0)
    assert cryo.reports[-1].readings[0].value == pytest.approx(cryo.cryostat.value_k, abs=0.1)


EVIL = "\x1b[2J" + "x" * 100_000


@pytest.mark.parametrize(
    "lines",
    [
        [f"update tt:value {json.dumps([EVIL, {}])}"],
        [f"error_update tt:value {json.dumps(['Impossible', EVIL, {}])}"],
        [f"update tt:status {json.dumps([[400, EVIL], {}])}"],
        [f"update tt:status {json.dumps([[EVIL, EVIL], {}])}"],
        [f"describing . {json.dumps({'modules': {EVIL: {}}})}"],
    ],
)
def test_texts_of_a_server_are_cut_and_escaped(cryo: Cryo, lines: list[str], caplog: pytest.LogCaptureFixture) -> None:
    cryo.later(1.0)
    cryo.answers += lines
    del cryo.reports[:]
    cryo.component.on_tick()
    reason = cryo.reports[-1].readings[0].reason
    for text in (reason, *caplog.messages):
        assert "\x1b" not in text
        assert len(text) < 500
    assert "xxx" in reason


def test_unit_of_a_server_is_cut_and_a_changing_one_is_logged_once(
    cryo: Cryo, caplog: pytest.LogCaptureFixture
) -> None:
    cryo.later(1.0)
    for number in range(5):
        cryo.cryostat.unit = f"{EVIL}{number}"
        cryo.answers += cryo.cryostat.answer("describe")
        cryo.later(1.0)
    assert len(cryo.reports[-1].readings[0].unit) < 250
    assert sum("its unit changed" in one for one in caplog.messages) == 1
