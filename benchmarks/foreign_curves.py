"""`python -m benchmarks.foreign_curves FOLDER`: the shipped quantities of curves on curves of another program.

FOLDER has `truth.json` and, in `force`, `iv` and `kelvin`, one file `NAME.npz` per curve: columns named "Name (unit)",
and a `header` in JSON. Each curve becomes a `Spectrum` with the roles that a driver would declare, and its quantity is
compared with the truth. A value is silently wrong if it is beside the truth by more than three stated errors and by
more than 10 %; a contact potential by more than three stated errors and 10 mV.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from afspm.basics import ConfigError
from afspm.basics.errors import AfspmError
from afspm.model import Spectrum
from afspm.model.caption import SENSITIVITY, SPRING_CONSTANT, SettingInForce
from afspm.model.parameter_names import LOCK_IN_AMPLITUDE
from afspm.model.variables import VariableRoles
from afspm.plugins.adaptive import quantities
from afspm.plugins.adaptive.band_gap import band_gap
from afspm.plugins.adaptive.pull_off import pull_off

Estimate = tuple[float, float]
"""A value and its stated error."""
SHARE: Final = 0.1
POTENTIAL_V: Final = 0.01
ERRORS: Final = 3.0
_ROLES: Final = VariableRoles.declared(
    {
        "bias": ("Bias", "U_sample_V", "V", "U_bias", "V_sample"),
        "height": ("Z", "height", "Height_Sensor_m_Ex", "Piezo position"),
        "height, retrace": ("Z [bwd]", "Height_Sensor_m_Rt"),
        "force": ("Force",),
        "deflection": ("Deflection", "vDeflection", "Defl_m_Ex"),
        "deflection, retrace": ("Deflection [bwd]", "Defl_m_Rt"),
        "current": ("Current", "I_t_A", "I"),
        "current, retrace": ("Current [bwd]",),
        "conductance": ("LI Demod 1 X", "Lockin_X_V", "dI_dV"),
        "conductance, retrace": ("LI Demod 1 X [bwd]",),
        "frequency shift": ("Frequency Shift", "df", "delta_f"),
        "frequency shift, retrace": ("Frequency Shift [bwd]",),
        "time": ("time",),
    },
    towards=("Height_Sensor_m_Ex", "Height_Sensor_m_Rt", "Piezo position"),
)
_UNITS: Final = {"U_sample_V": "V", "I_t_A": "A", "Lockin_X_V": "V"} | dict.fromkeys(
    ("Height_Sensor_m_Ex", "Height_Sensor_m_Rt", "Defl_m_Ex", "Defl_m_Rt"), "m"
)


@dataclass(frozen=True)
class Quantity:
    """A shipped quantity: the folder of its curves, their kind, the function, and the true value of a curve."""

    family: str
    kind: str
    function: Callable[[Spectrum], Estimate]
    true: Callable[[Mapping[str, Any]], float]
    group: Callable[[Mapping[str, Any], Spectrum], str]
    unit: str

    def is_wrong(self, value: float, error: float, true: float) -> bool:
        """Return whether a value is beside the truth by more than its stated error and the least that counts."""
        least = POTENTIAL_V if self.family == "kelvin" else SHARE * abs(true)
        return abs(value - true) > max(ERRORS * error, least)


def _adhesion(curve: Spectrum) -> Estimate:
    found = pull_off(curve)
    return found.force_n, found.error_n


def _gap(curve: Spectrum) -> Estimate:
    found = band_gap(curve)
    return found.value_ev, found.error_ev


def _potential(curve: Spectrum) -> Estimate:
    fit = quantities.kelvin_parabola(curve)
    return fit.vertex_v, fit.error_v


def _ways(_: Mapping[str, Any], curve: Spectrum) -> str:
    return "both ways" if curve.has("frequency shift, retrace") else "one way, whose drift is not seen"


QUANTITIES: Final = {
    "adhesion": Quantity(
        "force", "force", _adhesion, lambda one: float(one["adhesion_sampled_N"]), lambda one, _: str(one["model"]), "N"
    ),
    "gap": Quantity("iv", "IV", _gap, lambda one: float(one["gap_eV"]), lambda one, _: str(one["kind"]), "eV"),
    "contact_potential": Quantity(
        "kelvin", "IV", _potential, lambda one: float(one["contact_potential_V"]), _ways, "V"
    ),
}


def spectrum(file: Path, kind: str) -> Spectrum:
    """Return a curve with its roles and the calibrations of its header."""
    with np.load(file) as read:
        header = json.loads(str(read["header"]))
        columns = {name: read[name] for name in read.files if name != "header"}
    found = {name: re.fullmatch(r"(.*) \((.*)\)", name) for name in columns}
    names = tuple(one.group(1) if one else name for name, one in found.items())
    units = tuple(one.group(2) if one else _UNITS[name] for name, one in found.items())
    states = {
        SPRING_CONSTANT: ("spring_constant_N_per_m", "N/m"),
        SENSITIVITY: ("inv_OLS_m_per_V", "m/V"),
        LOCK_IN_AMPLITUDE: ("lockin_modulation_peak_V", "V"),
    }
    known = tuple(
        SettingInForce(name, unit, header[key], header[key]) for name, (key, unit) in states.items() if key in header
    )
    values = np.stack(list(columns.values()), axis=1)
    return Spectrum((0.0, 0.0), kind, names, units, values, declared_roles=_ROLES, in_force=known)


@dataclass(frozen=True)
class Result:
    """A curve's name, group and true value, and the estimate or why it is refused."""

    name: str
    group: str
    true: float
    estimate: Estimate | str


def results(folder: Path, quantity: Quantity) -> Iterator[Result]:
    """Yield the result of each curve."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))[quantity.family]
    for name, true in sorted(truth.items()):
        curve = spectrum(folder / quantity.family / f"{name}.npz", quantity.kind)
        found: Estimate | str
        try:
            found = quantity.function(curve)
        except AfspmError as refused:
            found = str(refused)
        yield Result(name, quantity.group(true, curve), quantity.true(true), found)


def _row(title: str, quantity: Quantity, found: list[Result]) -> str:
    # the error of curves without the quantity (true: 0) has no share; any value of them is wrong
    measured = [(one.true, one.estimate) for one in found if not isinstance(one.estimate, str)]
    scale = [1.0 if quantity.family == "kelvin" else true for true, _ in measured]
    errors = [abs(one[0] - true) / size for (true, one), size in zip(measured, scale, strict=True) if size]
    wrong = sum(quantity.is_wrong(*one, true) for true, one in measured)
    shown = "1.2g" if quantity.family == "kelvin" else ".2%"
    figures = (np.median(errors), np.percentile(errors, 90), max(errors)) if errors else (np.nan,) * 3
    shares = 1.0 - len(measured) / len(found), wrong / len(found)
    cells = [f"{one:{shown}}" for one in figures] + [f"{one:.1%}" for one in shares]
    return f"| {title} | {len(found)} | {' | '.join(cells)} |"


def main(arguments: list[str]) -> int:
    """Print the table; with `--wrong`, also each curve that is silently wrong, and the reasons of the refused ones."""
    folders = [one for one in arguments if not one.startswith("--")]
    if len(folders) != 1:
        raise ConfigError("one folder is needed", hint="python -m benchmarks.foreign_curves FOLDER")
    print("| quantity | n | median error | 90th percentile | worst | refused | silently wrong |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    details: list[str] = []
    for title, quantity in QUANTITIES.items():
        found = list(results(Path(folders[0]), quantity))
        print(_row(title, quantity, found))
        for group in sorted({one.group for one in found}):
            print(_row(f"… {group}", quantity, [one for one in found if one.group == group]))
        for one in found:
            about = f"{one.name} ({one.group}, true {one.true:.3g} {quantity.unit})"
            if isinstance(one.estimate, str):
                details.append(f"{about}: refused: {one.estimate}")
            elif quantity.is_wrong(*one.estimate, one.true):
                details.append(f"{about}: {one.estimate[0]:.3g} ± {one.estimate[1]:.1g}")
    if "--wrong" in arguments:
        print("\n".join(details))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
