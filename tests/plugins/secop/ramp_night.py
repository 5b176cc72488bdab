"""Nights with a cryostat in simulated time: a SECoP server, its client and the scheduler's decisions, with faults.

Everything is in one process and on one clock: the server with the true temperature, the process of the instrument, the
scheduler, a translator whose scans take 20 s, and a series that scans whenever it may.
"""

from __future__ import annotations

import json
import random
from dataclasses import dataclass
from typing import Any

from tests.unit.scheduler.logic_lab import as_saved

from afspm import wire
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    InstrumentReadings,
    Packet,
    PacketHeader,
    Parameter,
    ProblemNames,
    RelayedMessage,
    Request,
    Response,
    ScopeState,
    ScopeStatus,
)
from afspm.plugins.secop.channel import ServerUnfit
from afspm.plugins.secop.secop_client import SecopClient
from afspm.scheduler import ExperimentLimits, SchedulerCore, WireCodec, events
from afspm.scheduler.instruments.conditions import AllowedBand, InstrumentSettings, MeasuringCondition
from afspm.scheduler.safety.limits import Limit
from afspm.scheduler.settings import ControlSettings, SchedulerSettings

STEP_S = 0.25
RATE_K_S = 2.0 / 60.0
LOW_K, HIGH_K, FOR_S = 4.15, 4.25, 5.0
COLD = 100
SCAN_S = 20.0
FAULTS = (
    "none", "disturbed", "hung", "frozen module", "partition", "server restart", "unit changed", "nan", "error",
    "lying clock", "instrument killed", "instrument frozen", "scheduler killed", "scheduler frozen", "panel",
)  # fmt: skip
BLIND = ("hung", "frozen module", "partition", "unit changed", "nan", "error", "instrument frozen", "instrument killed")
"""Faults after which the temperature is not known."""


def settings() -> SchedulerSettings:
    problems = ProblemNames({"not-at-temperature": COLD})
    control = ControlSettings()
    cold = MeasuringCondition({"cryo.t": AllowedBand(LOW_K, HIGH_K, None, FOR_S, "K")}, problem="not-at-temperature")
    return SchedulerSettings(
        control=control,
        rules=control.rules(problems),
        watchdog=control.watchdog(),
        limits=ExperimentLimits({"cryo.t": Limit(low=1.0, high=300.0, rate_per_s=RATE_K_S, unit="K")}),
        instruments=InstrumentSettings(("cryo",), {"cold": cold}, {"not-at-temperature": COLD}),
    )


@dataclass
class Cryostat:
    """A SECoP server with one module, and the truth of it.

    Attributes:
        has_ramp: the server keeps a ramp; else the set point jumps to each target.
        ramp_switch: the parameter that switches the ramp on, off at first; empty: the ramp is always on.
        setpoint_k: follows the target; value_k: the true temperature.
        fault: of FAULTS, while it lasts.
        fastest_k_min: highest rate of the ramp.
        range_k: lowest and highest target; None: no bounds.
        switch_is_readonly: the ramp can't be switched on.
        decimals: of a target after the answer.
        is_busy: the status; None: busy while the temperature is away from the target.
    """

    has_ramp: bool
    chance: random.Random
    ramp_switch: str = ""
    is_ramp_on: bool = False
    value_k: float = 4.2
    target_k: float = 4.2
    setpoint_k: float = 4.2
    ramp_k_min: float = 0.0
    fault: str = "none"
    fastest_k_min: float = 10.0
    range_k: tuple[float, float] | None = None
    is_busy: bool | None = None
    unit: str = "K"
    disturbance_k: float = 0.0
    clock_s: float = 1e9
    old: str = ""
    switch_is_readonly: bool = False
    decimals: int = 9

    def run(self, dt_s: float) -> None:
        self.clock_s += dt_s
        if self.has_ramp and self.ramp_k_min > 0.0 and (self.is_ramp_on or not self.ramp_switch):
            way, most = self.target_k - self.setpoint_k, self.ramp_k_min / 60.0 * dt_s
            self.setpoint_k += max(-most, min(most, way))
        else:
            self.setpoint_k = self.target_k
        self.value_k += (self.setpoint_k + self.disturbance_k - self.value_k) * min(1.0, dt_s / 2.0)

    def answer(self, line: str) -> list[str]:
        """Return the answers to one line."""
        action, _, rest = line.partition(" ")
        specifier, _, data = rest.partition(" ")
        if action == "*IDN?":
            return ["ISSE&SINE2020,SECoP,V2019-09-16,v1.0"]
        if action == "describe":
            return [f"describing . {json.dumps(self._description())}"]
        if action == "activate":
            return [*(self._report("update", one) for one in ("value", "status", "target")), "active"]
        if action == "read":
            return [self._report("reply", specifier.partition(":")[2])]
        if action == "change":
            return [self._change(specifier, json.loads(data))]
        return [f'error_{action} {specifier} ["ProtocolError", "no such action", {{}}]']

    def _change(self, specifier: str, value: float) -> str:
        if specifier == "tt:ramp":
            if value > self.fastest_k_min:
                why = f"{value} must be between 0 and {self.fastest_k_min}"
                return f'error_change {specifier} ["RangeError", "{why}", {{}}]'
            self.ramp_k_min = value
        elif specifier == f"tt:{self.ramp_switch}":
            self.is_ramp_on = bool(value)
        else:
            self.target_k = round(value, self.decimals)
        return f"changed {specifier} [{json.dumps(value)}, {{}}]"

    def _report(self, action: str, accessible: str) -> str:
        if accessible == "status":
            is_away = abs(self.value_k - self.target_k) > 0.02
            code = 300 if (is_away if self.is_busy is None else self.is_busy) else 100
            return f'{action} tt:status [[{code}, ""], {{}}]'
        if accessible == "target":
            return f"{action} tt:target [{self.target_k * self._factor!r}, {{}}]"
        if self.fault == "error":
            return f'error_{"read" if action == "reply" else "update"} tt:value ["HardwareError", "no sensor", {{}}]'
        if self.fault == "nan":
            return f"{action} tt:value [NaN, {{}}]"
        if self.fault == "frozen module" and self.old:
            return f"{action} {self.old}"
        lies_s = self.chance.uniform(-1e6, 1e6) if self.fault == "lying clock" else 0.0
        value = (self.value_k + self.chance.gauss(0.0, 0.001)) * self._factor
        self.old = f'tt:value [{value!r}, {{"t": {self.clock_s + lies_s}}}]'
        return f"{action} {self.old}"

    @property
    def _factor(self) -> float:
        return 1000.0 if self.unit == "mK" else 1.0

    def _description(self) -> object:
        def number(unit: str, *, readonly: bool) -> dict[str, Any]:
            return {"datainfo": {"type": "double", "unit": unit}, "readonly": readonly}

        accessibles = {
            "value": number(self.unit, readonly=True),
            "target": number(self.unit, readonly=False),
            "status": {"datainfo": {"type": "tuple"}, "readonly": True},
        }
        if self.range_k is not None:
            accessibles["target"]["datainfo"] |= dict(zip(("min", "max"), self.range_k, strict=True))
        if self.has_ramp:
            accessibles["ramp"] = number(f"{self.unit}/min", readonly=False)
            accessibles["ramp"]["datainfo"]["max"] = self.fastest_k_min
        if self.ramp_switch:
            accessibles[self.ramp_switch] = {"datainfo": {"type": "bool"}, "readonly": self.switch_is_readonly}
        return {"modules": {"tt": {"accessibles": accessibles}}}


class RampNight:
    """One ramp with one fault; `run` raises AssertionError where an invariant breaks."""

    def __init__(self, seed: int) -> None:
        self.chance = chance = random.Random(seed)
        self.fault = chance.choice(FAULTS)
        self.cryostat = Cryostat(chance.random() < 0.5, chance)
        self.now_s, self.now_ns = 100.0, 1_750_000_000 * 10**9
        self.settings, self.codec = settings(), WireCodec()
        self.core = SchedulerCore(self.settings, self.codec)
        self.alive = {"scheduler": True, "instrument": True}
        self.connection = 0
        self.requests = 0
        self.inbox: list[str] = []
        self.delayed: list[str] = []
        self.scan_until_s: float | None = None
        self.outside_since_s: float | None = None
        self.inside_since_s = self.now_s
        self.scans = self.flags = self.refused = 0
        self.budget_k = 0.0
        self.blind_since_s: float | None = None
        self.panel_k: float | None = None
        self.panel_s = self.moved_k = 0.0
        self._new_instrument()
        self._new_scheduler(self.core.start(self.now_s, self.now_ns))

    # --- the processes ---

    def _new_instrument(self) -> None:
        self.client, self.token, self.is_connected = SecopClient({"cryo.t": "tt"}), 0, False

    def _new_scheduler(self, effects: list[events.Effect]) -> None:
        self._carry_out(effects)
        self.connections: dict[str, int] = {}
        self._step(events.TranslatorUp())
        self._step(events.TranslatorCaughtUp())
        self._publish(ScopeState.FREE if self.scan_until_s is None else ScopeState.SCANNING)

    def _step(self, event: events.Input) -> None:
        self._carry_out(self.core.step(event, self.now_s, self.now_ns))

    def _carry_out(self, effects: list[events.Effect]) -> None:
        for effect in effects:
            if isinstance(effect, events.Reply) and effect.name == "cryo" and effect.response.ok:
                self._orders(effect.response)
            if isinstance(effect, events.Reply) and effect.response.code == ControlResponse.NOT_FREE:
                self.refused += 1
            if isinstance(effect, events.Forward):
                self._forwarded(effect)

    def _forwarded(self, forward: events.Forward) -> None:
        action = forward.request.subject if forward.request.kind == ControlRequest.ACTION else None
        if action == "start-scan":
            self._check_band("a scan starts")
            self.scan_until_s, self.scans = self.now_s + SCAN_S, self.scans + 1
        elif action == "stop-scan":
            self.scan_until_s = None
        self._step(events.TranslatorReply(forward.number, Response(int(ControlResponse.SUCCESS))))
        if action in ("start-scan", "stop-scan"):
            self._publish(ScopeState.SCANNING if action == "start-scan" else ScopeState.FREE)

    def _publish(self, state: ScopeState) -> None:
        self.now_ns += 10_000
        name, payload = wire.encode(ScopeStatus(state))
        self._step(events.PacketIn(Packet(name, payload, self.now_ns), PacketHeader(name)))

    def _ask(self, name: str, kind: int, subject: object) -> None:
        if name not in self.connections:
            self.connection += 1
            self.connections[name] = self.connection
            self._step(events.Connected(self.connection))
        self.requests += 1
        request = Request(kind, subject, id=f"{name}/{name}/{self.requests}")
        self._step(events.RequestIn(self.connections[name], name, request))

    # --- the instrument ---

    def _send(self, lines: list[str]) -> None:
        if self.fault_now == "hung":
            return
        if self.fault_now == "partition":
            self.delayed += lines  # the network keeps them, and delivers them later
            return
        for line in lines:
            self.inbox += self.cryostat.answer(line)

    @property
    def fault_now(self) -> str:
        return self.cryostat.fault

    def _instrument(self) -> None:
        client, now_s = self.client, self.now_s
        try:
            if not self.is_connected:
                self.is_connected, self.inbox = True, []
                self._send(client.connected(now_s))
            inbox, self.inbox = self.inbox, []
            for line in inbox:
                self._send(client.take(line, now_s))
            if client.is_silent(now_s):
                raise ConnectionError("silent")
            self._send(client.tick(now_s))
        except (ConnectionError, ServerUnfit) as error:
            client.lost(str(error))
            self.is_connected, self.delayed = False, []
        if self.alive["scheduler"]:
            outcomes = client.outcomes()
            report = InstrumentReadings(self.now_ns, "cryo", client.readings(now_s), outcomes, self.token)
            self._ask("cryo", RELAY_REQUEST, RelayedMessage(*wire.encode(report)))
            client.delivered(outcomes)

    def _orders(self, response: Response) -> None:
        told = wire.decode_instrument_orders(response.payload)
        self.token = told.token
        for order in told.orders:
            self._send(self.client.order(order, self.now_s))

    # --- the night ---

    def run(self) -> None:
        """Settle, scan, meet the fault, change the temperature, and come back."""
        begins_s, lasts_s = self.now_s + self.chance.uniform(12.0, 40.0), self.chance.uniform(0.5, 30.0)
        ramp_s = self.now_s + self.chance.uniform(10.0, 60.0)
        end_s = self.now_s + 110.0
        target_k = self.chance.choice((4.2, 5.0, 3.6, 4.23))
        has_begun = has_ended = has_set = False
        while self.now_s < end_s:
            if not has_begun and self.now_s >= begins_s:
                has_begun = True
                self._begin_fault()
            if has_begun and not has_ended and self.now_s >= begins_s + lasts_s:
                has_ended = True
                self._end_fault()
            if not has_set and self.now_s >= ramp_s and self.alive["scheduler"]:
                has_set, self.panel_k = True, None
                self.budget_k = 2.5 * RATE_K_S
                self._ask("series", ControlRequest.PARAM, Parameter("cryo.t", repr(target_k), "K"))
            self._moment()

    def _moment(self) -> None:
        before_k, panel = self.cryostat.setpoint_k, self.panel_k
        self.now_s += STEP_S
        self.now_ns += round(STEP_S * 1e9)
        self.cryostat.run(STEP_S)
        self._check_rate(before_k)
        self._check_known()
        value_k = self.cryostat.value_k
        is_inside = LOW_K <= value_k <= HIGH_K
        self.outside_since_s = (
            None if is_inside else self.now_s if self.outside_since_s is None else self.outside_since_s
        )
        if self.alive["instrument"]:
            self._instrument()
        if self.alive["scheduler"]:
            self._scheduler()
        if self.scan_until_s is not None:
            self._check_band("a scan runs")
            if self.now_s >= self.scan_until_s:
                self.scan_until_s = None
                self._publish(ScopeState.FREE)
        if panel is not None and self.cryostat.target_k != panel:
            # a step may be on its way at the moment of the change
            assert self.now_s - self.panel_s <= 2 * STEP_S, "a target set at the panel was undone"
            self.panel_k = None

    def _scheduler(self) -> None:
        while (due_s := self.core.deadline_s()) is not None and due_s <= self.now_s:
            self._step(events.Tick())
        if COLD in self.core.control.problems:
            self.flags += 1
        holder = self.core.control.holder
        if holder is None and not self.core.control.problems:
            self._ask("series", ControlRequest.REQUEST_CTRL, 0)
        elif holder == "series" and self.scan_until_s is None:
            self._ask("series", ControlRequest.ACTION, "start-scan")

    def _begin_fault(self) -> None:
        fault = self.fault
        self.blind_since_s = self.now_s if fault in BLIND else None
        match fault:
            case "disturbed":
                self.cryostat.disturbance_k = self.chance.choice((-1.0, 0.3, 2.0))
            case "server restart" | "unit changed":
                self.client.lost("the server restarts")
                self.is_connected = False
                self.cryostat.unit = "mK" if fault == "unit changed" else "K"
            case "instrument killed" | "instrument frozen":
                self.alive["instrument"] = False
            case "scheduler killed" | "scheduler frozen":
                self.alive["scheduler"] = False
            case "panel":
                self.panel_s, self.budget_k = self.now_s, 2.5 * RATE_K_S
                target_k = 4.2 + self.chance.choice((0.0, 0.5))
                # no client can see a change to the same target
                self.panel_k = target_k if target_k != self.cryostat.target_k else None
                self.cryostat.target_k = target_k
            case _:
                self.cryostat.fault = fault

    def _end_fault(self) -> None:
        fault, self.blind_since_s = self.fault, None
        self.cryostat.fault, self.cryostat.disturbance_k = "none", 0.0
        if fault == "unit changed":
            self.client.lost("the server restarts")
            self.is_connected, self.cryostat.unit = False, "K"
        if fault == "partition":
            delayed, self.delayed = self.delayed, []
            for line in delayed:
                self.inbox += self.cryostat.answer(line)
        if fault == "instrument killed":
            unfinished = self.client.unfinished()
            self._new_instrument()
            self.client.go_on_with(unfinished)
            self.connections.pop("cryo", None)
        if fault == "scheduler killed":
            saved = as_saved(self.core.snapshot())
            self.core = SchedulerCore(self.settings, self.codec)
            self.core.restore(saved)
            self.alive["scheduler"] = True
            self._new_scheduler(self.core.start(self.now_s, self.now_ns))
        self.alive = dict.fromkeys(self.alive, True)

    # --- the invariants ---

    def _check_band(self, what: str) -> None:
        if self.outside_since_s is None or not self.alive["scheduler"]:
            return
        outside_s = self.now_s - self.outside_since_s
        limit_s = 5.0 if self.fault not in ("none", "disturbed", "lying clock") else 2.0
        if self.fault in ("scheduler killed", "scheduler frozen"):
            limit_s = 35.0  # it can stop nothing while it is away; the first moment after it decides
        assert outside_s <= limit_s, f"{what} {outside_s:.2f} s after the temperature left the band ({self.fault})"

    def _check_known(self) -> None:
        if self.blind_since_s is None or self.now_s - self.blind_since_s <= 5.0:
            return
        assert COLD in self.core.control.problems, f"not flagged 5 s after the fault {self.fault}"

    def _check_rate(self, before_k: float) -> None:
        if self.panel_k is not None or 0.0 < self.panel_s > self.now_s - 15.0:
            self.budget_k = 2.5 * RATE_K_S
            return  # the set point of a person jumps, and an order begins at the temperature on its way to it
        # a target in steps may move by two steps at once; over any longer time the mean rate counts
        self.budget_k = min(self.budget_k + RATE_K_S * STEP_S, 2.5 * RATE_K_S)
        change_k = abs(self.cryostat.setpoint_k - before_k)
        self.moved_k += change_k
        self.budget_k -= change_k if change_k > 0.02 * RATE_K_S else 0.0
        assert self.budget_k > -1e-6, f"the set point moved too fast ({self.fault}, ramp {self.cryostat.has_ramp})"
