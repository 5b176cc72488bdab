"""Translators that do something wrong, each one thing: what the checks have to find.

They are the simulated microscope, spoiled. What is changed in classes of afspm is changed in the translator's own
process alone.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from afspm.basics.errors import FileError, Refused
from afspm.model import ControlResponse, Region, Scan, ScopeState, ScopeStatus, Spectrum, names
from afspm.simulation.simulator import Simulator
from afspm.translator import commands, parameters, sequence, setting_groups
from afspm.translator.driver_base import Action, action
from afspm.translator.observer import Observer
from afspm.translator.parameters import Value
from afspm.translator.translator import run_translator

REPLACEABLE: Any = commands
"""The module without its types: mypy refuses to replace a name that it imports."""


class Broken(Simulator):
    """A simulated microscope with something in between."""

    def run_process(self, context: Any) -> int:
        self.spoil()
        return run_translator(self, context)

    def spoil(self) -> None:
        """Change what is afspm's own, in this process."""

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        return [
            self.spoiled(one) if isinstance(one, Scan) else self.spoiled_spectrum(one) for one in super().load(result)
        ]

    def spoiled(self, scan: Scan) -> Scan:
        return scan

    def spoiled_spectrum(self, spectrum: Spectrum) -> Spectrum:
        return spectrum


class HalfAFrameOff(Broken):
    """Takes the centre of a frame for its corner."""

    def spoiled(self, scan: Scan) -> Scan:
        (x, y), (width, height) = scan.region.center_m, scan.region.size_m
        return replace(scan, region=scan.region.moved_to((x + width / 2, y + height / 2)))


class SwappedAxes(Broken):
    def spoiled(self, scan: Scan) -> Scan:
        width, height = scan.region.size_m
        return replace(scan, values=scan.values.T.copy(), region=replace(scan.region, size_m=(height, width)))


class MirroredY(Broken):
    """Rows from the top to the bottom, as pictures have them."""

    def spoiled(self, scan: Scan) -> Scan:
        return replace(scan, values=scan.values[::-1].copy())


class OnePixelTooLarge(Broken):
    """From the left side of the first pixel to the right side of the last."""

    def spoiled(self, scan: Scan) -> Scan:
        (width, height), (rows, columns) = scan.region.size_m, scan.shape
        size_m = (width * columns / (columns - 1), height * rows / (rows - 1))
        return replace(scan, region=replace(scan.region, size_m=size_m))


class AngleOfTheWrongSign(Broken):
    def spoiled(self, scan: Scan) -> Scan:
        return replace(scan, region=replace(scan.region, angle_rad=-scan.region.angle_rad))


class TurnedTheWrongWay(AngleOfTheWrongSign):
    """Of the wrong sign wherever it is told: only the sample shows it."""

    def write(self, values: Mapping[str, Value]) -> None:
        super().write(_turned(values))

    def read(self, wanted: Any) -> dict[str, Value]:
        return _turned(super().read(wanted))


class TurnedAsIsKnown(TurnedTheWrongWay):
    @classmethod
    def excused(cls, controller: str) -> Mapping[str, str]:
        return {"scan/picture": f"{controller} is known to turn"}


class LosesScans(Broken):
    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        raise FileError("is lost", where=result)


def _turned(values: Mapping[str, Value]) -> dict[str, Value]:
    return {name: -float(value) if name == names.SCAN_ANGLE else value for name, value in values.items()}


class TimeOfTheStart(Broken):
    @action(names.START_SCAN)
    def start_scan(self) -> None:
        self.memory["began_ns"] = self.clock.now_ns()
        super().start_scan()

    def spoiled(self, scan: Scan) -> Scan:
        return replace(scan, time_ns=self.memory["began_ns"])


class StaleScan(Broken):
    """Reads the newest file before the new one is there."""

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        before = [one for one in self.results() if one < result]
        return super().load(before[-1] if before else result)


class SpectrumElsewhere(Broken):
    """The offset of the frame for the position of the tip."""

    def spoiled_spectrum(self, spectrum: Spectrum) -> Spectrum:
        return replace(spectrum, position_m=(0.0, 0.0))


class CancelIgnored(Broken):
    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        """Nothing comes of it."""


class SpectrumNotStopped(Broken):
    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        """Nothing comes of it, and nothing is said."""

    def spoil(self) -> None:
        sequence.StatusSequence.interrupt = lambda self: []  # type: ignore[method-assign]


class CancelledSpectrumUntold(Broken):
    """A spectrum that is stopped is free at once, as if it had come to its end."""

    def spoil(self) -> None:
        sequence.StatusSequence.interrupt = lambda self: self._publish(ScopeStatus(ScopeState.FREE))  # type: ignore[method-assign]


class WrongUnit(Broken):
    """The speed in another unit than the controller's, there and back."""

    def set(self, values: Mapping[str, Value]) -> None:
        super().set({name: float(v) / 10.0 if name == names.SCAN_SPEED else v for name, v in values.items()})

    def get(self, vendor: str) -> Value:
        value = super().get(vendor)
        return 10.0 * float(value) if vendor == names.SCAN_SPEED else value


class NotOnlyWhatWasAsked(Broken):
    """A position sets the size, too."""

    def write(self, values: Mapping[str, Value]) -> None:
        size = {names.SCAN_SIZE_X: 1e-7} if names.SCAN_TOP_LEFT_X in values else {}
        super().write({**size, **values})


class OnlyUpwards(Broken):
    """The bias can't be lowered any more."""

    def write(self, values: Mapping[str, Value]) -> None:
        now, wanted = self.memory["values"][names.TIP_BIAS_VOLTAGE], values.get(names.TIP_BIAS_VOLTAGE, math.inf)
        if float(wanted) < now:
            raise Refused(ControlResponse.PARAM_ERROR, "the bias is stuck")
        super().write(values)


class NeverFreeAgain(Broken):
    """Goes on moving once it has moved."""

    def status(self) -> ScopeStatus:
        status = super().status()  # which is what lets time pass in the simulated controller
        moved = self.memory["values"][names.SCAN_SIZE_X] != self.memory.setdefault(
            "first", self.memory["values"][names.SCAN_SIZE_X]
        )
        return ScopeStatus(ScopeState.MOVING) if moved else status


class FreeBeforeTheScan(Broken):
    def spoil(self) -> None:
        def after_measuring(
            self: sequence.StatusSequence, seen: ScopeStatus, results: bool, now_s: float
        ) -> list[sequence.SequenceStep]:
            return [*self._publish(seen), sequence.PublishResults()] if results else []

        sequence.StatusSequence._after_measuring = after_measuring  # type: ignore[method-assign]


class Clamps(Broken):
    """Takes the nearest value that there is."""

    def spoil(self) -> None:
        def checked(self: parameters.ParameterSpec, value: Value) -> Value:
            if isinstance(value, bool | str) or not math.isfinite(value):
                return plainly(self, value)
            low, high = self.range
            return plainly(self, min(max(value, low), high))

        plainly = parameters.ParameterSpec.checked
        parameters.ParameterSpec.checked = checked  # type: ignore[method-assign]
        REPLACEABLE.apply = lambda driver, values, *_: driver.write(values) or driver.in_force(values)


class AcceptsNaN(Broken):
    """As C's atof has it."""

    def spoil(self) -> None:
        def parse(self: parameters.ParameterSpec, text: str, unit: str | None = None) -> Value:
            return plainly(self, "0" if text in ("nan", "abc") else text, unit)

        plainly = parameters.ParameterSpec.parse
        parameters.ParameterSpec.parse = parse  # type: ignore[method-assign]


class AnyUnit(Broken):
    """A unit that it does not know is its own."""

    def spoil(self) -> None:
        def from_unit(self: parameters.ParameterSpec, number: float, unit: str | None) -> float:
            return plainly(self, number, None if unit == "kg" else unit)

        plainly = parameters.ParameterSpec.from_unit
        parameters.ParameterSpec.from_unit = from_unit  # type: ignore[method-assign]


class BusyNotRefused(Broken):
    def spoil(self) -> None:
        commands.Commands._refuse_if_busy = lambda self, allowed: None  # type: ignore[method-assign]


class SuccessWithoutChange(Broken):
    def spoil(self) -> None:
        REPLACEABLE.apply = lambda driver, values, *_: dict(values)


class KnowsEveryAction(Broken):
    def spoil(self) -> None:
        commands.Commands._find_action = lambda self, name: (  # type: ignore[method-assign]
            self.actions.get(name) or Action(name, lambda: None)
        )


class DiesOfNaN(Broken):
    def spoil(self) -> None:
        def parse(self: parameters.ParameterSpec, text: str, unit: str | None = None) -> Value:
            if text == "nan":
                os._exit(3)
            return plainly(self, text, unit)

        plainly = parameters.ParameterSpec.parse
        parameters.ParameterSpec.parse = parse  # type: ignore[method-assign]


class PublishesTwice(Broken):
    def spoil(self) -> None:
        def publish(self: Observer, thing: setting_groups.Published | ScopeStatus) -> None:
            plainly(self, thing)
            if not isinstance(thing, ScopeStatus):
                plainly(self, thing)

        plainly = Observer.publish
        Observer.publish = publish  # type: ignore[method-assign]


class SaysNothingAtTheStart(Broken):
    """Tells what changes, and not what is there."""

    def spoil(self) -> None:
        Observer.publish_all = lambda self: self.publish(self._state.sequence.published)  # type: ignore[method-assign]


class InOtherCoordinates(Broken):
    """A scan in nm that says it is in m."""

    def spoiled(self, scan: Scan) -> Scan:
        (x, y), (width, height) = scan.region.center_m, scan.region.size_m
        return replace(scan, region=Region((x * 1e9, y * 1e9), (width * 1e9, height * 1e9)))
