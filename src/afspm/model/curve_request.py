"""What a request for a curve may say of it: from where to where, with how many points, how slowly, and the lock-in."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Final

from afspm.basics.errors import InvalidValue, UnitError
from afspm.basics.formatting import duration_text
from afspm.basics.units import parse_quantity, si
from afspm.model import parameter_names as names
from afspm.model.requests import Parameter

_SWEPT: Final = {"V": names.SPEC_ENDS, "m": names.SPEC_Z_ENDS}
"""The parameters of both ends, by the unit of the swept quantity."""
_QUANTITIES: Final = {
    "point_time": (names.SPEC_POINT_TIME, "s"),
    "z_offset": (names.SPEC_Z_OFFSET, "m"),
}
_LOCK_IN: Final = {"amplitude": (names.LOCK_IN_AMPLITUDE, "V"), "frequency": (names.LOCK_IN_FREQUENCY, "Hz")}
KEYS: Final = ("sweep", "points", *_QUANTITIES, "lock_in")
"""What a request may say."""
CurveSettings = Mapping[str, object]
CurveTable = dict[str, int | float | str | list[str] | dict[str, float | str]]
"""The settings as a table of an experiment file."""


def curve_parameters(given: CurveSettings, kind: str | None = None, where: str = "curve") -> tuple[Parameter, ...]:
    """Return the parameters that a request for curves sets.

    Args:
        given: any of `sweep`, first and last value as texts with a unit: of the bias ("-500 mV", "500 mV"), or of the
            height ("20 nm", "-1 nm"), which is 0 where the feedback was opened and positive away from the sample;
            `points`; `point_time`, time to measure each point; `z_offset`, height at which a bias is swept, as for a
            sweep of the height; `lock_in`, a mapping with `amplitude` (peak, of the bias) and `frequency`. Other
            quantities than `sweep` may be numbers in SI.
        kind: kind of the curves; None: not known.
        where: place of the request, for errors.

    Raises:
        InvalidValue, UnitError: a key or a value is not valid, or does not fit the kind.
    """
    _known(given, KEYS, where)
    made = []
    if (sweep := given.get("sweep")) is not None:
        made += _ends(sweep, f"{where}.sweep")
    if (points := given.get("points")) is not None:
        if isinstance(points, bool) or not isinstance(points, int) or points < 2:
            raise InvalidValue(f"a curve can't have {points!r} points", where=f"{where}.points", hint="2 or more")
        made.append(Parameter(names.SPEC_POINTS, str(points)))
    for key, (name, unit) in _QUANTITIES.items():
        made += _quantity(given.get(key), name, unit, f"{where}.{key}")
    lock_in = given.get("lock_in") or {}
    if not isinstance(lock_in, Mapping):
        raise InvalidValue(f"expected amplitude and frequency, got {lock_in!r}", where=f"{where}.lock_in")
    _known(lock_in, _LOCK_IN, f"{where}.lock_in")
    for key, (name, unit) in _LOCK_IN.items():
        made += _quantity(lock_in.get(key), name, unit, f"{where}.lock_in.{key}")
    other = {
        **dict.fromkeys(names.SWEEPS_BIAS, ("bias", names.SPEC_Z_ENDS)),
        **dict.fromkeys(names.SWEEPS_HEIGHT, ("height", (*names.SPEC_ENDS, names.SPEC_Z_OFFSET))),
    }
    swept, unfit = other.get(kind or "", ("", ()))
    for one in made:
        if one.name in unfit:
            raise InvalidValue(f"a curve {kind} sweeps the {swept}, and has no {one.name}", where=where)
    return tuple(made)


def time_of_curves(given: CurveSettings, count: int) -> str:
    """Return how long a number of curves takes as far as a request says, in words, for `PlannedWork.why`."""
    known = {one.name: one.value for one in curve_parameters(given)}
    points, point_time_s = known.get(names.SPEC_POINTS), known.get(names.SPEC_POINT_TIME)
    if not points or not point_time_s:
        return "the controller sets the duration of a spectrum"
    return f"the points of the curves take {duration_text(count * int(points) * float(point_time_s))}"


def _known(given: Mapping[str, object], known: Collection[str], where: str) -> None:
    for key in given:
        if key not in known:
            raise InvalidValue(f"there is no {key!r}", where=where, hint=f"one of {', '.join(known)}")


def _ends(sweep: object, where: str) -> list[Parameter]:
    hint = 'first and last value with their unit, such as ("-500 mV", "500 mV") or ("20 nm", "-1 nm")'
    if isinstance(sweep, str) or not isinstance(sweep, Sequence) or len(sweep) != 2:
        raise InvalidValue(f"{sweep!r} is no sweep", where=where, hint=hint)
    for unit, ends in _SWEPT.items():
        try:
            values = [si(end, unit) for end in sweep if isinstance(end, str) and parse_quantity(end)[1]]
        except UnitError:
            continue
        if len(values) == 2 and all(map(math.isfinite, values)) and values[0] != values[1]:
            return [Parameter(name, repr(value), unit) for name, value in zip(ends, values, strict=True)]
    raise InvalidValue(f"{sweep!r} is no sweep of a bias or a height", where=where, hint=hint)


def _quantity(value: object, name: str, unit: str, where: str) -> list[Parameter]:
    if value is None:
        return []
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise InvalidValue(f"{value!r} is no quantity in {unit}", where=where)
    number = si(value, unit)
    if not math.isfinite(number):
        raise InvalidValue(f"{value!r} is not finite", where=where)
    return [Parameter(name, repr(number), unit)]
