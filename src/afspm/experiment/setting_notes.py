"""Notes of `afspm check` on plans that state settings beside each other: no faults, but easily overlooked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import chain, combinations, permutations

from afspm.basics.formatting import duration_text, quantity
from afspm.experiment.findings import Finding, Level
from afspm.experiment.resolved_experiment import ResolvedExperiment
from afspm.model import Parameter, Role, is_of_instrument, names
from afspm.model.planned_work import path_length_m
from afspm.model.positions import PLACES
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limits import Limit

_STATING = ("parameters", "zoom_parameters", "curve", "values")  # the last is the sweep of a `SweepAt`
_BIAS, _SETPOINT = names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT
_SHARE = 0.1
"""The share of a scan or a period above which a wait is worth a note, and of a bias below which another bias is."""


class SettingNotes:
    """The notes on an experiment without errors."""

    def __init__(self, resolved: ResolvedExperiment) -> None:
        self._resolved, self._number = resolved, LimitChecker(resolved.limits).number
        acting = {name for name, one in resolved.processes.items() if one.acts and one.role is Role.COMPONENT}
        self._plans = {name: plan for name, plan in resolved.plans.items() if name in acting}
        self._usual_m_s = next((one.scan_speed_m_s for one in resolved.plans.values() if one.scan_speed_m_s), math.inf)
        has = next((one.capabilities() for one in resolved.with_role(Role.TRANSLATOR)), None)
        self._rows = None if has is None else {name: has.table[name] for name in has.table}

    def all(self) -> list[Finding]:
        found = [self._never_lent(), self._at_base(), self._waits(), self._unbroken()]
        # of a microscope in another language the unit of the setpoint is not known
        if self._rows is None or (_SETPOINT in self._rows and self._rows[_SETPOINT].si_unit == "A"):
            found += [self._closer(), self._through_zero()]
        return [*chain(*found)]

    def _stated(self, name: str) -> list[tuple[str, Parameter]]:
        return [(setting, one) for setting in _STATING for one in self._plans[name].parameters.get(setting, ())]

    def _numbers(self, name: str, parameter: str) -> list[float]:
        return [x for _, one in self._stated(name) if one.name == parameter and (x := self._number(one)) is not None]

    def _may_be_lent(self, parameter: str) -> bool:
        row = (self._rows or {}).get(parameter)
        return parameter in names.MAY_BE_LENT if row is None else row.may_be_lent

    def _is_after(self, name: str, other: str) -> bool:
        before = self._resolved.processes[name].after
        return other in before or any(self._is_after(one, other) for one in before)

    def _beside(self, name: str) -> list[str]:
        # the plans that may measure between two measurements of this one
        others = [one for one in self._plans if one != name]
        return [one for one in others if not self._is_after(name, one) and not self._is_after(one, name)]

    def _note(self, name: str, parameter: str, what: str, hint: str) -> Finding:
        setting = next((setting for setting, one in self._stated(name) if one.name == parameter), parameter)
        return Finding(Level.NOTE, what, self._resolved.document.place(name, setting, parameter), hint)

    def _never_lent(self) -> Iterator[Finding]:
        for name, plan in self._plans.items():
            if plan.sweep and not self._beside(name):  # it sets its parameters back at its end
                continue
            for one in dict.fromkeys(one.name for setting, one in self._stated(name) if setting != "values"):
                if self._may_be_lent(one) or one in PLACES or is_of_instrument(one):
                    continue
                what = f"[{name}] {one} can't be lent: once set, it is in force for the measurements of others, too"
                hint = "set it at the panel" + "; a row of your own may have `lent = true`" * one.startswith("x-")
                yield self._note(name, one, what, f"begin the others `after` [{name}]" if plan.sweep else hint)

    def _at_base(self) -> Iterator[Finding]:
        for name in self._plans:
            own, lent = [one.name for _, one in self._stated(name)], dict[str, str]()
            for other in self._plans if own else ():
                stated = {one.name for _, one in self._stated(other)}.difference(own)
                lent = {one: other for one in stated if self._lends(other, one, name)} | lent
            if lent:
                what = f"[{name}] measures at the base of {', '.join(sorted(lent))}, which is the value at the panel"
                remedy = "state it here, too" if "parameters" in self._plans[name].parameters else "set it at the panel"
                lenders = _listed(sorted({*lent.values()}))
                yield self._note(name, own[0], what, f"if it needs the value in {lenders}, {remedy}")

    def _lends(self, lender: str, parameter: str, name: str) -> bool:
        # settings of curves are set back before curves of their kind alone, those of treatments before no measurement
        plan = self._plans[name]
        if parameter in names.OF_CURVES:
            return names.START_SPEC in plan.needs_actions and plan.kind == self._plans[lender].kind
        if parameter in (names.SCAN_SPEED, names.SCAN_DIRECTION) and names.START_SCAN not in plan.needs_actions:
            return False
        return self._may_be_lent(parameter) and parameter not in names.OF_TREATMENTS

    def _waits(self) -> Iterator[Finding]:
        for parameter, limit in self._resolved.limits.parameters.items():
            stating = [name for name in self._plans if self._numbers(name, parameter)]
            waits = [(self._wait_s(limit, parameter, *pair), pair) for pair in combinations(stating, 2)]
            wait_s, pair = max(waits, default=(0.0, ("", "")))
            if wait_s:
                what = f"between {_listed(pair)} each change of {parameter} waits up to {duration_text(wait_s)}"
                hint = f"allow faster changes ({limit.source}), or begin [{pair[1]}] `after` [{pair[0]}]"
                yield self._note(pair[1], parameter, what, hint)

    def _wait_s(self, limit: Limit, parameter: str, *pair: str) -> float:
        # limits on time count from the last change: of the first step, a scan at the former value is a part
        one, other = (self._numbers(name, parameter) for name in pair)
        way = max(max(one) - min(other), max(other) - min(one))
        if not way or pair[1] not in self._beside(pair[0]):
            return 0.0
        steps = math.ceil(way / (limit.step or way) * (1 - 1e-9))
        way_s = max(way / limit.rate_per_s if limit.rate_per_s else 0.0, steps * (limit.interval_s or 0.0))
        scans_s = [self._scan_s(name) for name in pair]
        wait_s = way_s - min(way_s / steps, *scans_s)
        known_s = filter(None, [*scans_s, *(self._plans[name].period_s for name in pair)])
        return wait_s if wait_s > _SHARE * min(known_s, default=0.0) else 0.0

    def _scan_s(self, name: str) -> float:
        plan = self._plans[name]  # of its scans the shortest counts; 0: unknown
        shortest_m = min((path_length_m(one, plan.shape[0]) for one in plan.regions if plan.shape), default=0.0)
        return shortest_m / (max(self._numbers(name, names.SCAN_SPEED), default=self._usual_m_s) or math.inf)

    def _closer(self) -> Iterator[Finding]:
        biases = {name: [abs(bias) for bias in self._numbers(name, _BIAS)] for name in self._plans}
        for low, high in permutations(filter(biases.get, biases), 2):
            least, most = min(biases[low]), max(biases[high])
            if least < _SHARE * most and {*self._numbers(low, _SETPOINT)} == {*self._numbers(high, _SETPOINT)}:
                volts = quantity(least, "V"), quantity(most, "V")
                what = f"[{low}] measures at {volts[0]}, [{high}] at {volts[1]}: at equal setpoint the tip comes closer"
                yield self._note(low, _BIAS, what, f"state a lower {_SETPOINT} in [{low}] if the distance matters")

    def _through_zero(self) -> Iterator[Finding]:
        if any("bias_through_zero" in one.settings for one in self._resolved.with_role(Role.TRANSLATOR)):
            return
        zero = "passes zero, where a feedback on the current drives the tip to the sample"
        signs = {name: {bias > 0.0 for bias in self._numbers(name, _BIAS) if bias} for name in self._plans}
        above, below = ([name for name, found in signs.items() if found == {sign}] for sign in (True, False))
        hint = 'choose bias_through_zero = "hold" in [microscope] if the bias is ramped there, else "jump"'
        if above and below:
            what = f"{_BIAS} is above zero in {_listed(above)}, below in {_listed(below)}: between them it {zero}"
            yield self._note(below[0], _BIAS, what, hint)
        for name in (name for name, found in signs.items() if len(found) > 1):
            yield self._note(name, _BIAS, f"[{name}] {_BIAS} has both signs: it {zero}", hint)

    def _unbroken(self) -> Iterator[Finding]:
        for name, plan in self._plans.items():
            keeps = self._resolved.processes[name].settings.get("keep_control") is True
            is_of_instruments = plan.sweep is not None and any(is_of_instrument(axis.name) for axis in plan.sweep.axes)
            waiting = _listed(one for one in self._beside(name) if self._plans[one].period_s)
            if waiting and (keeps or is_of_instruments):
                what = f"[{name}] keeps control until its end: rounds of {waiting} wait for it, beyond their `every`"
                hint = "leave keep_control out" if keeps else f"begin it `after` {waiting}"
                yield self._note(name, "keep_control" if keeps else "parameters", what, hint)


def _listed(processes: Iterable[str]) -> str:
    return ", ".join(f"[{name}]" for name in processes)
