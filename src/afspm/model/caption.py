"""Settings as they were in force for a measurement, and the caption of a figure made from them.

A translator reads them right before a measurement and at its end; calibrations are stated by the maker's own file. A
value that neither of them knows is None, never guessed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from afspm.basics.errors import UnitError
from afspm.basics.formatting import quantity
from afspm.basics.units import convert, si_unit
from afspm.model import parameter_names as names
from afspm.model.requests import Parameter

SPRING_CONSTANT: Final = "x-spring-constant"
"""Of the cantilever, in N/m."""
SENSITIVITY: Final = "x-sensitivity"
"""Deflection of the cantilever over the voltage of its detector, in m/V."""
BIAS_REFERENCE: Final = "bias-reference"
"""Whether `tip-bias-voltage` is the bias of the "sample" or of the "tip"; no parameter, but a fact beside its value."""
_LOCK_IN, _SPECTROSCOPY = "x-lock-in-", "x-spec-"
_OF_ANY: Final = (
    names.TIP_BIAS_VOLTAGE, BIAS_REFERENCE, names.SAMPLE_BIAS, names.ZCTRL_SETPOINT, names.SCAN_SPEED,
    names.FEEDBACK_ON, SPRING_CONSTANT, SENSITIVITY,
)  # fmt: skip
_GAINS: Final = (names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)  # known where the run has set them; no part of a caption
_COMPARED: Final = (names.TIP_BIAS_VOLTAGE, names.SAMPLE_BIAS, names.ZCTRL_SETPOINT, names.SCAN_SPEED, *_GAINS)
_ALIKE: Final = 0.02  # relative: what a picture does not show
_SYMBOLS: Final = {names.TIP_BIAS_VOLTAGE: "V", names.SAMPLE_BIAS: "V(sample)", SPRING_CONSTANT: "k"}
_OF_SETPOINT: Final = {"A": "I", "N": "F", "Hz": "Δf"}
Value = float | str | bool
"""A number, a switch, or text."""


def captioned(known: Iterable[str], *, of_scan: bool) -> list[str]:
    """Return the parameters to read for the caption of a scan, or else of a spectrum.

    Those of curves and of the lock-in are not read: the run has set them, or the maker's file states them, and at a
    controller that answers one question at a time they would double the dead time of a curve.
    """
    return [name for name in known if name in _OF_ANY and (of_scan or name != names.SCAN_SPEED)]


def _is_captioned(name: str) -> bool:
    return name in (*_OF_ANY, *_GAINS) or (name.startswith((_LOCK_IN, _SPECTROSCOPY)) and name != names.SPEC_KIND)


@dataclass(frozen=True, slots=True)
class SettingInForce:
    """A setting as it was in force for a measurement.

    Attributes:
        unit: an SI unit, or the microscope's own unit; empty without a unit.
        begin, end: None where it is not known.
    """

    name: str
    unit: str
    begin: Value | None
    end: Value | None

    @property
    def columns(self) -> dict[str, Value | None]:
        """Return the setting by column: "tip-bias-voltage [V]", and "tip-bias-voltage.end [V]" where that differs."""
        unit = f" [{self.unit}]" if self.unit else ""
        found = {f"{self.name}{unit}": self.begin}
        return found | ({} if self.end in (self.begin, None) else {f"{self.name}.end{unit}": self.end})

    @property
    def text(self) -> str:
        """Return the value for a person: "100 mV", or "100 mV → 50 mV"; empty if it is not known."""
        ends = (_text(value, self.unit) for value in (self.begin, self.end) if value is not None)
        return " → ".join(dict.fromkeys(ends))

    @property
    def constant(self) -> float | None:
        """Return a number that did not change; None if it did, or is not known."""
        is_number = isinstance(self.begin, int | float) and not isinstance(self.begin, bool)
        return float(self.begin) if is_number and self.end in (self.begin, None) else None  # type: ignore[arg-type]


def in_force(begin: Sequence[Parameter], end: Sequence[Parameter]) -> tuple[SettingInForce, ...]:
    """Return the settings of a caption among those read at the begin and at the end of a measurement."""
    ends = ({one.name: value_of(one) for one in given if _is_captioned(one.name)} for given in (begin, end))
    first, last = ends
    found = []
    for name in sorted({**first, **last}, key=_rank):
        (value, unit), (value_then, unit_then) = (one.get(name, (None, "")) for one in (first, last))
        if value is not None and value_then is not None and unit != unit_then:  # the setpoint of another mode
            found += [SettingInForce(name, unit, value, None), SettingInForce(name, unit_then, None, value_then)]
        else:
            found.append(SettingInForce(name, unit or unit_then, value, value_then))
    return tuple(found)


def stated_settings(given: Mapping[str, tuple[float | None, str]]) -> tuple[SettingInForce, ...]:
    """Return the settings that a file states for its whole measurement, from numbers with units; None: not stated."""
    return tuple(SettingInForce(name, unit, value, value) for name, (value, unit) in given.items() if value is not None)


def as_parameters(settings: Iterable[SettingInForce]) -> tuple[Parameter, ...]:
    """Return the settings that a file states as they are published."""
    return tuple(Parameter(one.name, f"{one.begin:.15g}", one.unit) for one in settings)


def bias_of(settings: Iterable[SettingInForce]) -> str:
    """Return the electrode whose bias the panel shows, "sample" or "tip"; empty if it is not known."""
    return next((str(one.begin) for one in settings if one.name == BIAS_REFERENCE and one.begin is not None), "")


def caption(settings: Sequence[SettingInForce]) -> str:
    """Return the settings as the caption of a figure: "V = 100 mV, I = 20 pA, 5 nm/s".

    Where the electrode with the bias is known, the bias is "V(sample)" or "V(tip)".
    """
    feedback = next((one for one in settings if one.name == names.FEEDBACK_ON), None)
    symbols = {**_SYMBOLS, names.TIP_BIAS_VOLTAGE: f"V({of})"} if (of := bias_of(settings)) else _SYMBOLS
    is_off = feedback is not None and feedback.begin is False
    parts = [
        f"{symbol} = {one.text}" if (symbol := _symbol(one, symbols)) else one.text
        for one in settings
        if one.text
        and one is not feedback
        and one.name not in (BIAS_REFERENCE, *_GAINS)
        and not (is_off and one.name == names.ZCTRL_SETPOINT)
    ]
    return ", ".join(parts + (["feedback off"] if is_off else []))


def picture_settings(settings: Iterable[SettingInForce]) -> dict[str, float]:
    """Return the settings on which a picture of one place depends: bias, setpoint, speed, and gains of the run."""
    return {one.name: one.constant for one in settings if one.name in _COMPARED and one.constant is not None}


def settings_to_lend(settings: Iterable[SettingInForce]) -> dict[str, str]:
    """Return the settings of `picture_settings` as texts, with which a further scan shows the same."""
    known = {one.name: one for one in settings}
    return {name: f"{value:.9g} {known[name].unit}".strip() for name, value in picture_settings(known.values()).items()}


def are_alike(one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Return whether pictures with these settings can be compared; a gain that one of them states makes them differ."""
    if any((gain in one) is not (gain in other) for gain in _GAINS):
        return False
    return all(math.isclose(one[name], other[name], rel_tol=_ALIKE) for name in one.keys() & other.keys())


def _rank(name: str) -> tuple[int, str]:
    return (_OF_ANY.index(name) if name in _OF_ANY else len(_OF_ANY), name)


def _symbol(one: SettingInForce, symbols: Mapping[str, str]) -> str:
    if one.name == names.SCAN_SPEED:
        return ""
    if one.name == names.ZCTRL_SETPOINT:
        return _OF_SETPOINT.get(one.unit, "setpoint")
    return symbols.get(one.name, one.name.removeprefix("x-").replace("-", " ").replace("lock in", "lock-in"))


def _text(value: Value, unit: str) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return value if isinstance(value, str) else quantity(value, unit)


def value_of(parameter: Parameter) -> tuple[Value, str]:
    """Return a published value with its unit: in SI, except in a unit of the maker's own."""
    text, unit = parameter.value or "", parameter.unit or ""
    if text.lower() in ("true", "false"):
        return text.lower() == "true", ""
    try:
        number = float(text)
    except ValueError:
        return text, ""
    with suppress(UnitError):
        plain = si_unit(unit) if unit else ""
        return float(f"{convert(number, unit, plain):.9g}"), plain
    return number, unit
