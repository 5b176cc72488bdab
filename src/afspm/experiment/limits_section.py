"""[limits]: what of the microscope may be set, how far, how fast, where and by whom. Into the limits of `logic`.

[limits]
region = { x = ["-5 um", "5 um"], y = ["-5 um", "5 um"] }
most_pixels = 4_000_000

[limits.tip-bias-voltage]
min = "-3 V"
max = "3 V"
step = "0.5 V"
rate = "1 V/s"
only = ["tip_corrector"]

[limits.actions.x-crash]
only = ["tip_corrector"]
every = "10 min"
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Final, TypeVar

import pydantic
from pydantic import Field

from afspm.errors import AfspmError
from afspm.experiment.document import Document
from afspm.experiment.findings import nearest
from afspm.experiment.sections import Section, parse
from afspm.experiment.toml_lines import Settings, Table
from afspm.experiment.validation_messages import report
from afspm.logic.limits import ExperimentLimits, Limit
from afspm.model import Parameter, Region, names
from afspm.units import Angle, Duration, Length, parse_quantity, require_unit, si, si_unit

Quantity = str | float
Pair = tuple[Length, Length]


class ActionLimit(Section):
    """[limits.actions.<name>]."""

    only: tuple[str, ...] | None = None
    every: Annotated[Duration, Field(gt=0)] | None = None


class ParameterLimit(ActionLimit):
    """[limits.<parameter>]."""

    min: Quantity | None = None
    max: Quantity | None = None
    step: Quantity | None = None
    rate: Quantity | None = None


class RegionSection(Section):
    """[limits] region: from and to in x and y, or a rectangle by its centre that may be turned."""

    x: Pair | None = None
    y: Pair | None = None
    center: Pair | None = None
    size: Pair | None = None
    angle: Angle = 0.0


class LimitsSection(Section):
    """The keys of [limits] that are not parameters."""

    region: RegionSection | None = None
    most_pixels: Annotated[int, Field(gt=0)] = 8192 * 8192


L = TypeVar("L", bound=ActionLimit)
_OWN: Final = (*LimitsSection.model_fields, "actions")


@dataclass(frozen=True)
class LimitsReader:
    """Reads the section, given what the microscope has.

    Args:
        parameters: the generic names that exist with their SI units (None: it depends on the operating mode).
        actions: those that exist; None: not known before it runs.
        sets: by name of an action, the parameters that it sets.
        certain: whether these are all parameters, or only those that any microscope may have.
    """

    document: Document
    components: Collection[str]
    parameters: Mapping[str, str | None]
    actions: frozenset[str] | None
    sets: Mapping[str, tuple[Parameter, ...]]
    certain: bool

    @property
    def _known_actions(self) -> frozenset[str]:
        return frozenset((*names.BASE_ACTIONS, *names.EXTENSION_ACTIONS)) if self.actions is None else self.actions

    def read(self, table: Table) -> ExperimentLimits:
        """Return the limits; what is wrong is reported and left out."""
        own = {key: value for key, value in table.items() if key in LimitsSection.model_fields}
        whole = parse(LimitsSection, "limits", own, self.document)
        parameters = {key: value for key, value in table.items() if key not in _OWN}
        actions = table.get("actions", {})
        if not isinstance(actions, Mapping):
            self.document.error("[limits] actions is not a table", "limits", "actions")
            actions = {}
        limits = ExperimentLimits(
            parameters={name: limit for name, one in parameters.items() if (limit := self._parameter(name, one))},
            actions={name: limit for name, one in actions.items() if (limit := self._action(name, one))},
            region=None if whole.region is None else self._region(whole.region),
            region_source=str(self.document.place("limits", "region")),
            most_pixels=whole.most_pixels,
            sets={name: one for name, one in self.sets.items() if one},
        )
        self._check_sizes(limits)
        return limits

    def _parameter(self, name: str, table: object) -> Limit | None:
        if name not in self.parameters and (self.certain or not name.startswith("x-")):
            is_action = name in self._known_actions
            near = nearest(name, [*self.parameters, *_OWN])
            hint = f"it is an action: [limits.actions.{name}]" if is_action else near
            self.document.error(f"[limits] there is no parameter {name!r}", "limits", name, hint=hint)
            return None
        path = ("limits", name)
        read = self._validated(ParameterLimit, table, path)
        if read is None:
            return None
        unit = self._unit(name, read, path)
        low, high, step, rate = (self._in(read, key, unit, path) for key in ("min", "max", "step", "rate"))
        for key, value in (("step", step), ("rate", rate)):
            if value is not None and value <= 0:
                self.document.error(f"[limits.{name}] {key} is not above zero", *path, key)
        if low is not None and high is not None:
            if low > high:
                what = f"[limits.{name}] min = {read.min!r} is above max = {read.max!r}"
                self.document.error(what, *path, "min", hint="nothing would be allowed")
            elif step is not None and step > high - low:
                self.document.warning(f"[limits.{name}] step is larger than the whole range", *path, "step")
        return Limit(low, high, step, rate, read.every, read.only, unit, str(self.document.place(*path)))

    def _unit(self, name: str, read: ParameterLimit, path: tuple[str, ...]) -> str | None:
        known = self.parameters.get(name)
        if known is not None or all(value is None for value in (read.min, read.max, read.step, read.rate)):
            return known
        given = _unit_given(read)
        if given is None:
            if name in names.BASE_PARAMETERS:
                what = f"[limits.{name}] has no unit, and the microscope's own unit is not known before it runs"
                self.document.error(what, *path, hint='give one, as in "500 pA"')
            return ""
        what = f"[limits.{name}] counts in {given}, as the microscope's own unit is not known before it runs"
        hint = f"values without a unit are taken to be in {given}: see that the translator means the same"
        self.document.warning(what, *path, hint=hint)
        return given

    def _action(self, name: str, table: object) -> Limit | None:
        path = ("limits", "actions", name)
        if name not in self._known_actions and (self.actions is not None or not name.startswith("x-")):
            hint = nearest(name, self._known_actions)
            self.document.error(f"[limits.actions] there is no action {name!r}", *path, hint=hint)
        read = self._validated(ActionLimit, table, path)
        if read is None:
            return None
        return Limit(interval_s=read.every, only=read.only, source=str(self.document.place(*path)))

    def _validated(self, model: type[L], table: object, path: tuple[str, ...]) -> L | None:
        try:
            read = model.model_validate(table)
        except pydantic.ValidationError as error:
            report(error, table, path, self.document, lambda _: model.model_fields)
            return None
        for i, who in enumerate(read.only or ()):
            if who not in self.components:
                what = f"[{'.'.join(path)}] only: there is no component {who!r}"
                self.document.error(what, *path, "only", i, hint=nearest(who, self.components))
        return read

    def _in(self, read: ParameterLimit, key: str, unit: str | None, path: tuple[str, ...]) -> float | None:
        """Return a quantity of a limit in the unit of its parameter; a rate in that per second."""
        value = getattr(read, key)
        if value is None:
            return None
        where = f"[{'.'.join(path)}] {key} = {value!r}"
        try:
            number = _rate(value, unit or "") if key == "rate" else si(value, unit or "")
        except AfspmError as error:
            hint = f'a change in a time, as in "1 {unit or ""}/s"' if key == "rate" else error.hint
            self.document.error(f"{where}: {error.what}", *path, key, hint=hint)
            return None
        if not math.isfinite(number):
            self.document.error(f"{where} is not a finite number", *path, key)
            return None
        return number

    def _region(self, box: RegionSection) -> Region | None:
        path = ("limits", "region")
        match box.x, box.y, box.center, box.size:
            case (left, right), (low, high), None, None:
                center, size = ((left + right) / 2, (low + high) / 2), (right - left, high - low)
            case None, None, (_, _) as center, (_, _) as size:
                pass
            case _:
                self.document.error("[limits] region needs either x and y, or center and size", *path)
                return None
        if min(size) <= 0:
            self.document.error("[limits] region is empty", *path, hint="from the smaller to the larger value")
            return None
        return Region(center, size, box.angle)

    def _check_sizes(self, limits: ExperimentLimits) -> None:
        """The smallest scan allowed must fit into the region allowed."""
        if limits.region is None:
            return
        longest_m = math.hypot(*limits.region.size_m)
        for name in (names.SCAN_SIZE_X, names.SCAN_SIZE_Y):
            limit = limits.parameters.get(name)
            if limit is not None and limit.low is not None and limit.low > longest_m:
                what = f"[limits.{name}] min does not fit into [limits] region"
                self.document.error(what, "limits", name, "min", hint="no scan would be allowed")


def _unit_given(read: ParameterLimit) -> str | None:
    for key, value in (("min", read.min), ("max", read.max), ("step", read.step), ("rate", read.rate)):
        if isinstance(value, str):
            with contextlib.suppress(AfspmError):  # reported when the value is read
                given = parse_quantity(value)[1]
                over, slash, _ = given.rpartition("/")
                if unit := si_unit(over if key == "rate" and slash else given):
                    return unit
    return None


def _rate(value: Quantity, unit: str) -> float:
    """Return a change per second, in `unit` per second: "1 V/s", "0.1 V/min"."""
    if not isinstance(value, str):
        require_unit(value, unit)
        return float(value)
    number, given = parse_quantity(value)
    over, slash, under = given.rpartition("/")
    if not slash:
        return si(f"{number} {given}", f"{unit}/s" if unit else "1/s")
    return si(f"{number} {over}", unit) / si(f"1 {under}", "s")


def to_settings(limits: ExperimentLimits) -> Settings:
    """Return them as the scheduler gets them, in JSON's types; `Limit` and `Region` by their fields."""

    def plain(limit: Limit) -> Settings:
        fields = {key: value for key, value in asdict(limit).items() if value is not None}
        return fields | ({"only": sorted(limit.only)} if limit.only is not None else {})

    settings: Settings = {
        "parameters": {name: plain(limit) for name, limit in limits.parameters.items()},
        "actions": {name: plain(limit) for name, limit in limits.actions.items()},
        "most_pixels": limits.most_pixels,
        "sets": {name: [[one.name, one.value, one.unit] for one in given] for name, given in limits.sets.items()},
    }
    if limits.region is not None:
        region = limits.region
        settings["region"] = {
            "center_m": list(region.center_m),
            "size_m": list(region.size_m),
            "angle_rad": region.angle_rad,
        }
        settings["region_source"] = limits.region_source
    return settings
