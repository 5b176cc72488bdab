"""[conditions]: values of other instruments that are required for measurements.

The conditions are enforced by `scheduler.instruments`.

[conditions.cold]
"cryo.temperature" = { from = "4.15 K", to = "4.25 K", for = "60 s" }
while = ["start-scan", "start-spec"]
problem = "not-at-temperature"
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Final

from afspm.basics.errors import AfspmError
from afspm.basics.units import parse_quantity, si
from afspm.experiment.document import Document
from afspm.experiment.findings import nearest
from afspm.experiment.toml_lines import Table
from afspm.model import ProblemNames
from afspm.model.instruments import instrument_of
from afspm.model.parameter_names import BASE_ACTIONS
from afspm.scheduler.instruments.conditions import AllowedBand, InstrumentSettings, MeasuringCondition

_WHILE, _PROBLEM = "while", "problem"
_BOUNDS: Final = ("from", "to", "within")
_OF_BAND: Final = (*_BOUNDS, "for")


@dataclass(frozen=True)
class ConditionsReader:
    """A reader of the section [conditions].

    Args:
        instruments: parameters of each component that is an instrument.
        actions: known actions; None if they can't be known before the microscope runs.
    """

    document: Document
    instruments: Mapping[str, Collection[str]]
    actions: frozenset[str] | None
    problems: ProblemNames

    def read(self, table: Table) -> InstrumentSettings:
        """Return the settings; after errors, which are reported, entries may be missing."""
        for instrument, parameters in self.instruments.items():
            for parameter in parameters:
                if instrument_of(parameter) != instrument:
                    what = f"[{instrument}] parameters: {parameter!r} does not begin with {instrument!r} and a dot"
                    hint = f'"{instrument}.{parameter.rpartition(".")[2]}"'
                    self.document.error(what, instrument, "parameters", parameter, hint=hint)
        conditions = {name: condition for name, bands in table.items() if (condition := self._condition(name, bands))}
        flagged = {condition.problem for condition in conditions.values() if condition.problem}
        numbers = {name: self.problems.number(name) for name in sorted(flagged)}
        return InstrumentSettings(tuple(self.instruments), conditions, numbers)

    def _condition(self, name: str, table: object) -> MeasuringCondition | None:
        path = ("conditions", name)
        if not isinstance(table, Mapping):
            self.document.error(f"[conditions] {name} is not a table of keys and values", *path)
            return None
        bands = {}
        for key, value in table.items():
            if key not in (_WHILE, _PROBLEM) and (band := self._band(name, key, value)) is not None:
                bands[key] = band
        actions, problem = self._actions(name, table), self._problem(name, table)
        if not any(key not in (_WHILE, _PROBLEM) for key in table):
            what = f"[conditions.{name}] names no parameter of an instrument"
            self.document.error(what, *path, hint='e.g. "cryo.temperature" = { from = "4.15 K", to = "4.25 K" }')
        if not bands or actions is None or problem is None:
            return None
        return MeasuringCondition(bands, actions, problem, str(self.document.place(*path)))

    def _band(self, name: str, parameter: str, table: object) -> AllowedBand | None:
        path = ("conditions", name, parameter)
        known = [name for parameters in self.instruments.values() for name in parameters]
        if parameter not in known:
            what = f"[conditions.{name}] no instrument has the parameter {parameter!r}"
            self.document.error(what, *path, hint=nearest(parameter, known) or "see `parameters` of the instrument")
            return None
        if not isinstance(table, Mapping):
            self.document.error(f"[conditions.{name}] {parameter} is not a table", *path, hint="{ from = …, to = … }")
            return None
        if unknown := [key for key in table if key not in _OF_BAND]:
            what = f"[conditions.{name}] {parameter}: {unknown[0]!r} is not a setting"
            self.document.error(what, *path, unknown[0], hint=nearest(unknown[0], _OF_BAND))
            return None
        if not any(key in table for key in _BOUNDS):
            self.document.error(f"[conditions.{name}] {parameter} has none of: {', '.join(_BOUNDS)}", *path)
            return None
        return self._numbers(name, parameter, table)

    def _numbers(self, name: str, parameter: str, table: Table) -> AllowedBand | None:
        path = ("conditions", name, parameter)
        unit = _unit_of(table)
        read = dict[str, float]()
        for key, value in table.items():
            wanted = "s" if key == "for" else unit
            try:
                if isinstance(value, bool) or not isinstance(value, str | float | int):
                    raise AfspmError("not a quantity")
                if key == "for" and not isinstance(value, str):
                    raise AfspmError("a time without a unit", hint='e.g. "60 s"')
                if isinstance(value, str) and not parse_quantity(value)[1]:
                    raise AfspmError("a text without a unit", hint=f'e.g. "{value} K"; a number has no unit')
                read[key] = si(value, wanted)
                if not math.isfinite(read[key]):
                    raise AfspmError("not a finite number")
                if key in ("for", "within") and read[key] < 0:
                    raise AfspmError("below zero")
            except AfspmError as error:
                what = f"[conditions.{name}] {parameter}: {key} = {value!r}: {error.what}"
                self.document.error(what, *path, key, hint=error.hint)
                return None
        low, high = read.get("from"), read.get("to")
        if low is not None and high is not None and low >= high:
            self.document.error(f"[conditions.{name}] {parameter}: from must be less than to", *path, "from")
            return None
        return AllowedBand(low, high, read.get("within"), read.get("for", 0.0), unit)

    def _actions(self, name: str, table: Table) -> tuple[str, ...] | None:
        path, actions = ("conditions", name, _WHILE), table.get(_WHILE, list(MeasuringCondition().actions))
        if not isinstance(actions, list) or not actions or not all(isinstance(action, str) for action in actions):
            self.document.error(f"[conditions.{name}] while is not a list of actions", *path)
            return None
        known = BASE_ACTIONS if self.actions is None else self.actions
        for i, action in enumerate(actions):
            if action not in known and (self.actions is not None or not action.startswith("x-")):
                what = f"[conditions.{name}] while: there is no action {action!r}"
                self.document.error(what, *path, i, hint=nearest(action, known))
                return None
        return tuple(actions)

    def _problem(self, name: str, table: Table) -> str | None:
        problem = table.get(_PROBLEM, "")
        if problem == "" or (isinstance(problem, str) and problem in self.problems):
            return str(problem)
        what = f"[conditions.{name}] the experiment knows no problem {problem!r}"
        hint = f"name it, with a number of its own: [problems] {problem} = 100"
        self.document.error(what, "conditions", name, _PROBLEM, hint=hint)
        return None


def _unit_of(table: Table) -> str:
    for key in _BOUNDS:
        if isinstance(value := table.get(key), str):
            with contextlib.suppress(AfspmError):  # reported when the value is read
                return parse_quantity(value)[1]
    return ""
