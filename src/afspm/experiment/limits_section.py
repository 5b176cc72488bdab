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

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, Any, Final

import pydantic
from pydantic import Field

from afspm.errors import AfspmError
from afspm.experiment.document import Document
from afspm.experiment.findings import Findings, nearest
from afspm.experiment.sections import S, Section, parse, report
from afspm.experiment.toml_lines import Path
from afspm.logic.limits import ExperimentLimits, Limit
from afspm.model import Parameter, Region, names
from afspm.units import Angle, Duration, Length, parse_quantity, si

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


LARGEST_REGION_M: Final = 0.01  # no scanner reaches as far
_OWN: Final = (*LimitsSection.model_fields, "actions")


class LimitsReader:
    """Reads the section, given what the microscope has.

    Args:
        parameters: the generic names that exist with their SI units (None: it depends on the operating mode).
        actions: those that exist; None: not known before it runs.
        certain: whether these are all parameters, or only those that any microscope may have.
        sets: by name of an action, the parameters that it sets.
    """

    def __init__(
        self,
        document: Document,
        findings: Findings,
        components: tuple[str, ...],
        parameters: Mapping[str, str | None],
        actions: frozenset[str] | None,
        *,
        certain: bool,
        sets: Mapping[str, tuple[Parameter, ...]],
    ) -> None:
        self._document = document
        self._findings = findings
        self._components = components
        self._parameters = parameters
        self._actions = actions
        self._known_actions = frozenset((*names.BASE_ACTIONS, *names.EXTENSION_ACTIONS)) if actions is None else actions
        self._certain = certain
        self._sets = sets

    def read(self, table: Mapping[str, Any]) -> ExperimentLimits:
        """The limits; what is wrong is reported and left out."""
        whole = parse(
            LimitsSection,
            "limits",
            {k: v for k, v in table.items() if k in LimitsSection.model_fields},
            self._document,
            self._findings,
        )
        parameters = {k: v for k, v in table.items() if k not in _OWN}
        actions = table.get("actions", {})
        if not isinstance(actions, Mapping):
            self._findings.error("[limits] actions is no table", self._document.place("limits", "actions"))
            actions = {}
        limits = ExperimentLimits(
            parameters={name: limit for name, one in parameters.items() if (limit := self._parameter(name, one))},
            actions={name: limit for name, one in actions.items() if (limit := self._action(name, one))},
            region=None if whole.region is None else self._region(whole.region),
            region_source=str(self._document.place("limits", "region")),
            most_pixels=whole.most_pixels,
            sets={name: one for name, one in self._sets.items() if one},
        )
        self._check_sizes(limits)
        return limits

    def _parameter(self, name: str, table: Any) -> Limit | None:
        path: Path = ("limits", name)
        if name not in self._parameters:
            hint = nearest(name, [*self._parameters, *_OWN])
            if name in self._known_actions:
                hint = f"it is an action: [limits.actions.{name}]"
            if self._certain or not name.startswith("x-"):
                self._findings.error(f"[limits] there is no parameter {name!r}", self._document.place(*path), hint)
                return None
        read = self._validated(ParameterLimit, table, path)
        if read is None:
            return None
        self._check_who(read.only, path)
        unit = self._unit(name, read)
        low, high = (self._in(read, key, unit, path) for key in ("min", "max"))
        step, rate = self._in(read, "step", unit, path), self._in(read, "rate", unit, path, per_s=True)
        if low is not None and high is not None and low > high:
            self._findings.error(
                f"[limits.{name}] min = {read.min!r} is above max = {read.max!r}",
                self._document.place(*path, "min"),
                "nothing would be allowed",
            )
        for key, value in (("step", step), ("rate", rate)):
            if value is not None and value <= 0:
                self._findings.error(f"[limits.{name}] {key} is not above zero", self._document.place(*path, key))
        if low is not None and high is not None and step is not None and step > high - low >= 0:
            self._findings.warning(
                f"[limits.{name}] step is larger than the whole range", self._document.place(*path, "step")
            )
        source = str(self._document.place(*path))
        return Limit(low, high, step, rate, read.every, read.only, unit, source)

    def _action(self, name: str, table: Any) -> Limit | None:
        path: Path = ("limits", "actions", name)
        known = self._known_actions
        if name not in known and (self._actions is not None or not name.startswith("x-")):
            hint = nearest(name, known)
            self._findings.error(f"[limits.actions] there is no action {name!r}", self._document.place(*path), hint)
        read = self._validated(ActionLimit, table, path)
        if read is None:
            return None
        self._check_who(read.only, path)
        return Limit(interval_s=read.every, only=read.only, source=str(self._document.place(*path)))

    def _validated(self, model: type[S], table: Any, path: Path) -> S | None:
        try:
            return model.model_validate(table)
        except pydantic.ValidationError as error:
            for one in error.errors(include_url=False):
                report(one, path, self._document, self._findings, known=tuple(model.model_fields))
            return None

    def _check_who(self, only: tuple[str, ...] | None, path: Path) -> None:
        for i, who in enumerate(only or ()):
            if who not in self._components:
                place = self._document.place(*path, "only", i)
                self._findings.error(
                    f"[{'.'.join(map(str, path))}] only: there is no component {who!r}",
                    place,
                    nearest(who, self._components),
                )

    def _unit(self, name: str, read: ParameterLimit) -> str | None:
        """The parameter's SI unit; where that depends on the operating mode, the unit of the first value given."""
        known = self._parameters.get(name)
        if known is not None:
            return known
        for value in (read.min, read.max, read.step):
            if isinstance(value, str):
                try:
                    return parse_quantity(value)[1] or None
                except AfspmError:
                    continue
        return None

    def _in(self, read: ParameterLimit, key: str, unit: str | None, path: Path, *, per_s: bool = False) -> float | None:
        value = getattr(read, key)
        if value is None:
            return None
        where = f"[{'.'.join(map(str, path))}] {key} = {value!r}"
        try:
            number = _rate(value, unit or "") if per_s else si(value, unit or "")
        except AfspmError as error:
            hint = f'a change in a time, as in "1 {unit or ""}/s"' if per_s else error.hint
            self._findings.error(f"{where}: {error.what}", self._document.place(*path, key), hint)
            return None
        if not math.isfinite(number):
            self._findings.error(f"{where} is not a finite number", self._document.place(*path, key))
            return None
        return number

    def _region(self, box: RegionSection) -> Region | None:
        place = self._document.place("limits", "region")
        spans, rectangle = (box.x is not None, box.y is not None), (box.center is not None, box.size is not None)
        if any(spans) == any(rectangle) or not (all(spans) or all(rectangle)):
            self._findings.error("[limits] region needs either x and y, or center and size", place)
            return None
        if box.x is not None and box.y is not None:
            size = (box.x[1] - box.x[0], box.y[1] - box.y[0])
            center = (box.x[0] + size[0] / 2, box.y[0] + size[1] / 2)
        else:
            assert box.center is not None
            assert box.size is not None
            size, center = box.size, box.center
        if size[0] <= 0 or size[1] <= 0:
            self._findings.error("[limits] region is empty", place, "from the smaller to the larger value")
            return None
        if max(size) > LARGEST_REGION_M:
            self._findings.warning(
                f"[limits] region is {size[0]:g} m x {size[1]:g} m: it keeps nothing safe", place,
                'a plain number is in m: write e.g. "3 um"',
            )  # fmt: skip
        return Region(center, size, box.angle)

    def _check_sizes(self, limits: ExperimentLimits) -> None:
        """The smallest scan allowed must fit into the region allowed."""
        region = limits.region
        if region is None:
            return
        longest_m = math.hypot(*region.size_m)
        for name in (names.SCAN_SIZE_X, names.SCAN_SIZE_Y):
            limit = limits.parameters.get(name)
            if limit is not None and limit.low is not None and limit.low > longest_m:
                self._findings.error(
                    f"[limits.{name}] min does not fit into [limits] region",
                    self._document.place("limits", name, "min"),
                    "no scan would be allowed",
                )


def _rate(value: Quantity, unit: str) -> float:
    """A change per second, in `unit` per second: "1 V/s", "0.1 V/min"."""
    if not isinstance(value, str):
        return float(value)
    number, given = parse_quantity(value)
    over, slash, under = given.rpartition("/")
    if not slash:
        return si(f"{number} {given}", f"{unit}/s" if unit else "1/s")
    return si(f"{number} {over}", unit) / si(f"1 {under}", "s")


def to_settings(limits: ExperimentLimits) -> dict[str, Any]:
    """As the scheduler process gets them, in JSON's types; `Limit` and `Region` by their fields."""

    def plain(limit: Limit) -> dict[str, Any]:
        fields = {key: value for key, value in asdict(limit).items() if value is not None}
        return fields | ({"only": sorted(limit.only)} if limit.only is not None else {})

    settings: dict[str, Any] = {
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
