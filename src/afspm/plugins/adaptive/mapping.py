"""Measurement of a map: an optimiser suggests positions, and gets the values of the spectra taken there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from typing import Any, Final

from afspm import Scope
from afspm.basics import (
    NS_PER_S,
    ConfigError,
    InvalidValue,
    MeasurementFailed,
    Plain,
    Refused,
    position_text,
    si_or_text,
)
from afspm.model import Region, Spectrum
from afspm.plugins.adaptive.quantities import Evaluation, evaluation
from afspm.plugins.adaptive.refinement import ID, AdaptiveMap, LatticeMap, NestedGrid, Optimizer
from afspm.transport import find_object

MOST_SPECTRA: Final = 1500
"""Largest number of spectra in a map. For this number a fit of the Gaussian process takes about two seconds, and a
position 35 ms; the time of a fit grows with the cube of the number."""
MOST_FAILURES: Final = 10  # in a row, before a person has to look
_LOOKS: Final = 1.08  # factor on the number of spectra after which the expected error is computed again
_log = logging.getLogger("afspm.adaptive")


@dataclass(frozen=True)
class Until:
    """Limits of a map, which is complete when the first limit is reached.

    Attributes:
        error: expected rms error of the map, in the unit of the quantity.
        spectra: number of measured spectra.
        time_s: experiment time since the first spectrum.
    """

    error: float | None = None
    spectra: int | None = None
    time_s: float | None = None

    @classmethod
    def of(cls, given: Mapping[str, float | str], unit: str) -> Until:
        """Return the limits of a table {error = "20 meV", spectra = 400, time = "2 h"}.

        Raises:
            ConfigError: the table has no limit, an unknown limit, or an impossible value.
        """
        if unknown := sorted(given.keys() - {"error", "spectra", "time"}):
            raise ConfigError(f"no limit named {unknown[0]!r}", where="until", hint="error, spectra or time")
        if not given:
            hint = 'for example until = { error = "20 meV", spectra = 400 }'
            raise ConfigError("a map needs an end", where="until", hint=hint)
        error = si_or_text(given["error"], unit) if "error" in given else None
        time_s = si_or_text(given["time"], "s") if "time" in given else None
        spectra = given.get("spectra")
        for name, value in {"error": error, "time": time_s, "spectra": spectra}.items():
            if value is not None and not (isinstance(value, int | float) and value > 0):
                raise ConfigError(f"{value!r} is not above zero", where=f"until.{name}")
        if spectra is not None and (spectra != round(float(spectra)) or float(spectra) > MOST_SPECTRA):
            raise ConfigError(f"{spectra!r} is not a whole number up to {MOST_SPECTRA}", where="until.spectra")
        return cls(error, None if spectra is None else round(float(spectra)), time_s)


@dataclass(frozen=True)
class MeasuredPoint:
    """One measurement of a map.

    Attributes:
        name: `_id` of the optimiser's suggestion.
        time_s: end of the spectrum, experiment time.
        seconds: time since the end of the spectrum before; 0 for the first spectrum.
    """

    name: object
    x_m: float
    y_m: float
    value: float
    time_s: float
    seconds: float


class MapProgress:
    """A map in progress, which grows by one spectrum a step.

    Args:
        optimizer: an optimiser of afspm, or any other with `suggest` and `ingest` of bluesky-adaptive.
        region: region of the map.
        evaluation: quantity of the map.
        until: limits of the map.
        planning: context entered while positions are computed, which may take a second.

    Attributes:
        map: map from the measurements so far.
        measured: measurements so far.
        failures: number of positions that could not be measured or evaluated, since the start of the process.
        error: latest expected rms error; None with fewer measurements than the second lattice has positions.
    """

    def __init__(
        self,
        optimizer: Optimizer,
        region: Region,
        evaluation: Evaluation,
        until: Until,
        planning: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.optimizer, self.evaluation, self.until = optimizer, evaluation, until
        # the optimiser of another package has no map, so its values are mapped by a lattice map
        self.map = optimizer if isinstance(optimizer, LatticeMap) else NestedGrid(region, evaluation.name)
        self.measured: list[MeasuredPoint] = []
        self.failures = 0
        self.error: float | None = None
        self._planning = planning
        self._in_a_row = 0
        self._looked = 0

    def restore(self, measured: list[MeasuredPoint], failures: list[object]) -> None:
        """Restore the measurements before a restart of the component, and the names of failed suggestions."""
        with self._planning():
            for one in measured:
                self._take(one, is_suggested=isinstance(self.optimizer, LatticeMap))
                if len(self.measured) >= len(self.map.lattice.cells(0)):
                    self.map.fit()  # as before the restart, since predictions are judged from fit to fit
            self._fail([{ID: name} for name in failures])
        self._look()

    def finished(self) -> str:
        """Return the reason why the map is complete, for people; empty for an incomplete map."""
        until, count = self.until, len(self.measured)
        if until.spectra is not None and count >= until.spectra:
            return f"{count} spectra are measured"
        if count >= MOST_SPECTRA:
            return f"{count} spectra are measured, the largest number"
        if until.time_s is not None and count and self.measured[-1].time_s - self.measured[0].time_s >= until.time_s:
            return "the time is over"
        if until.error is not None and self.error is not None and self.error <= until.error:
            return "the expected error is small enough"
        stops = getattr(self.optimizer, "should_stop", None)  # optional in the protocol
        if stops is not None and count:
            stop, why = stops()
            return (why or "the optimiser has finished") if stop else ""
        return ""

    def suggestion(self) -> Plain | None:
        """Return the next position, with `_id`, `x` and `y` (m); None if no position is left.

        Raises:
            InvalidValue: the optimiser suggests a position without `x` or `y`.
        """
        # a position of a round that is planned already takes no time
        quick = isinstance(self.optimizer, LatticeMap) and self.optimizer.has_planned
        with nullcontext() if quick else self._planning():
            found = self.optimizer.suggest(1)
        if not found:
            return None
        point = dict(found[0])
        if missing := [name for name in ("x", "y") if name not in point]:
            raise InvalidValue(f"the optimiser suggests no {' and '.join(missing)}: {point}")
        return {ID: point.get(ID), "x": float(point["x"]), "y": float(point["y"])}

    def measure(self, scope: Scope, point: Plain, key: str | None = None) -> MeasuredPoint | None:
        """Take a spectrum at a suggested position; log a failure to measure or evaluate it, and return None.

        Raises:
            MeasurementFailed: the tenth failure in a row. InvalidValue: the spectrum has no time.
        """
        at_m = (point["x"], point["y"])
        try:
            spectrum = scope.spectrum(at_m, kind=self.evaluation.kind, key=key)
            value = self.evaluation.of(spectrum)
        except (Refused, InvalidValue) as error:
            self.failures += 1
            self._in_a_row += 1
            _log.warning("no value at %s: %s", position_text(at_m), error)
            self._fail([point])
            if self._in_a_row >= MOST_FAILURES:
                raise MeasurementFailed(f"{self._in_a_row} positions in a row gave no value: {error}") from error
            return None
        self._in_a_row = 0
        x_m, y_m = spectrum.position_m or at_m
        end_s = None if spectrum.time_ns is None else spectrum.time_ns / NS_PER_S
        before_s = self.measured[-1].time_s if self.measured else end_s
        if end_s is None or before_s is None:
            raise InvalidValue("the controller gives spectra no time", hint="drift and cost follow from times")
        one = MeasuredPoint(point[ID], float(x_m), float(y_m), value, end_s, end_s - before_s)
        self._take(one, is_suggested=True)
        if len(self.measured) >= _LOOKS * self._looked:
            self._look()
        return one

    def _fail(self, points: list[Plain]) -> None:
        register = getattr(self.optimizer, "register_failures", None)  # optional in the protocol
        if register is not None and points:
            register(points)

    def _take(self, one: MeasuredPoint, *, is_suggested: bool) -> None:
        point: Plain = {"x": one.x_m, "y": one.y_m, self.evaluation.name: one.value}
        named: Plain = {ID: one.name, **point} if is_suggested else point
        with_times = {"time_s": one.time_s, **({"seconds": one.seconds} if self.measured else {})}
        if self.map is self.optimizer:
            self.map.ingest([named | with_times])
        else:
            self.optimizer.ingest([named])
            self.map.ingest([point | with_times])
        self.measured.append(one)

    def _look(self) -> None:
        # a feature between the positions of the first lattice is in no expected error
        if len(self.measured) >= len(self.map.lattice.cells(1)):
            self._looked = len(self.measured)
            with self._planning():
                self.map.fit()
                self.error = self.map.expected_error()


def optimizer_of(name: str, region: Region, quantity: str, **settings: Any) -> Optimizer:
    """Return the optimiser "adaptive" or "nested", or the result of a function "module.name" of region and quantity.

    Args:
        settings: settings for "adaptive" and "nested", see `LatticeMap`.

    Raises:
        ConfigError: there is no such optimiser or function, or its result has no `suggest` and `ingest`.
    """
    own: dict[str, type[LatticeMap]] = {"adaptive": AdaptiveMap, "nested": NestedGrid}
    if name in own:
        return own[name](region, quantity, **settings)
    if "." not in name:
        hint = "adaptive, nested, or a function of region and quantity as module.name"
        raise ConfigError(f"no optimiser is named {name!r}", where="optimizer", hint=hint)
    function: Any = find_object(name, "optimizer")
    made = function(region, quantity)
    if not isinstance(made, Optimizer):
        raise ConfigError(f"{name} returned {type(made).__name__}, without suggest and ingest", where="optimizer")
    return made


def measure_map(
    scope: Scope,
    region: Region,
    quantity: str | Callable[[Spectrum], float],
    until: Mapping[str, float | str],
    *,
    unit: str = "",
    kind: str | None = None,
    optimizer: Optimizer | None = None,
) -> Iterator[MapProgress]:
    """Map a quantity from a script; yield the progress after each spectrum.

        for progress in measure_map(scope, Region((0, 0), (1e-6, 1e-6)), "gap", {"spectra": 200}):
            print(len(progress.measured), progress.error)

    Args:
        quantity: "gap", "adhesion", "contact_potential", a function of a spectrum, or its name "module.name".
        until: {"error": …, "spectra": …, "time": …}: the first limit that is reached ends the map.
        unit: unit of the result of your own function.
        kind: kind of the spectra; None: the kind of the quantity, or the present kind.
        optimizer: optimiser; None: `AdaptiveMap`.

    Raises:
        ConfigError: a limit or the quantity is invalid. MeasurementFailed, InvalidValue: as `MapProgress.measure`.
    """
    if callable(quantity):
        evaluated = Evaluation(getattr(quantity, "__name__", "quantity"), unit, kind, quantity)
    else:
        evaluated = evaluation(quantity, unit, kind)
    chosen = optimizer if optimizer is not None else AdaptiveMap(region, evaluated.name)
    progress = MapProgress(chosen, region, evaluated, Until.of(until, evaluated.unit))
    while not progress.finished() and (point := progress.suggestion()) is not None:
        progress.measure(scope, point)
        yield progress


def rows(measured: list[MeasuredPoint]) -> list[Plain]:
    """Return measurements as plain dictionaries, to save as JSON."""
    return [asdict(one) for one in measured]
