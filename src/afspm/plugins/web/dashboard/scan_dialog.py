"""The dialog of *Scan here*, with editable size, pixels and angle of the scan."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace

from nicegui import ui

from afspm.basics import (
    InvalidValue,
    PlainMapping,
    UnitError,
    convert,
    parse_quantity,
    quantity,
    si_or_text,
    typeset_position,
)
from afspm.model import Region
from afspm.plugins.web.dashboard.steering_session import ask_in_dialog

MOST_PIXELS = 8192
Shape = tuple[int, int]


@dataclass(frozen=True)
class ScanChoice:
    """A scan that a person may request.

    Attributes:
        shape: (rows, columns).
    """

    region: Region
    shape: Shape

    def squared(self) -> ScanChoice:
        """Return a square choice with the longer side and the larger number of pixels."""
        side_m, pixels = max(self.region.size_m), max(self.shape)
        return ScanChoice(replace(self.region, size_m=(side_m, side_m)), (pixels, pixels))

    def edited(self, width: str, height: str, pixels: str, angle: str = "") -> ScanChoice:
        """Return the choice with sizes and angle as a person writes them, and `pixels` along the longer side.

        The pixels are square, up to rounding. An empty angle keeps the present angle.

        Raises:
            UnitError, InvalidValue: a text that is no length, no angle, or no number of pixels.
        """
        angle_rad = si_or_text(angle, "rad") if angle.strip() else self.region.angle_rad
        size_m = (_length_m(width), _length_m(height))
        if not pixels.strip().isdigit() or not 1 <= int(pixels) <= MOST_PIXELS:
            raise InvalidValue(f"pixels must be a whole number from 1 to {MOST_PIXELS}")
        region = replace(self.region, size_m=size_m, angle_rad=angle_rad)
        return ScanChoice(region, _shape(int(pixels), size_m))


class ScanDialog:
    """A dialog for the size and pixels of a scan centred on a place."""

    def __init__(self, choice: ScanChoice) -> None:
        self._choice = choice

    @classmethod
    def of_place(cls, place: PlainMapping) -> ScanDialog:
        """Return the dialog for a place from the picture's script: x, y, width, height, angle, rows, columns."""
        x, y, width, height, angle = (float(place[name]) for name in ("x", "y", "width", "height", "angle"))
        pixels = max(int(place["rows"]), int(place["columns"]))
        return cls(ScanChoice(Region((x, y), (width, height), angle), _shape(pixels, (width, height))))

    async def ask(self) -> tuple[Region, Shape] | None:
        """Return the person's choice; None: no scan."""
        wanted = await ask_in_dialog("Scan here?", self._fields, "Scan", may=lambda: self._read() is not None)
        choice = self._read() if wanted else None
        return None if choice is None else (choice.region, choice.shape)

    def _fields(self) -> None:
        ui.label(f"Around {typeset_position(self._choice.region.center_m)}, as drawn in the picture.")
        with ui.element("div").classes("fields"):
            self._width, self._height, self._pixels, self._angle = (
                ui.input(name, on_change=self._read).props("dense outlined")
                for name in ("width", "height", "pixels", "angle")
            )
            self._square = ui.checkbox("square", on_change=self._snap).props("dense")
        self._said = ui.label().classes("quiet").props('role="status"')
        self._fill(self._choice)

    def _fill(self, choice: ScanChoice) -> None:
        for field, side_m in zip((self._width, self._height), choice.region.size_m, strict=True):
            field.set_value(quantity(side_m, "m"))
        self._pixels.set_value(str(max(choice.shape)))
        self._angle.set_value(_degrees(choice.region))

    def _snap(self) -> None:
        if self._square.value and (choice := self._read()) is not None:
            self._fill(choice.squared())

    def _read(self) -> ScanChoice | None:
        # None, with an explanation in the dialog, if the fields describe no scan
        try:
            width = str(self._width.value or "")
            height = width if self._square.value else str(self._height.value or "")
            pixels, angle = str(self._pixels.value or ""), str(self._angle.value or "")
            if angle == _degrees(self._choice.region):  # unedited: as exact as set, not as shown
                angle = ""
            choice = self._choice.edited(width, height, pixels, angle)
        except (UnitError, InvalidValue) as error:
            self._said.set_text(str(error))
            return None
        (x, y), (across, up) = choice.region.center_m, choice.region.size_m
        drawn = {"x": x, "y": y, "width": across, "height": up, "angle": choice.region.angle_rad}
        ui.run_javascript(f"window.afspm?.image?.want({json.dumps(drawn)})")
        rows, columns = choice.shape
        self._said.set_text(f"{columns} × {rows} px of {quantity(choice.region.size_m[0] / columns, 'm', 3)}")
        return choice


def _degrees(region: Region) -> str:
    return f"{math.degrees(region.angle_rad):.4g} deg"


def _length_m(text: str) -> float:
    number, unit = parse_quantity(text)
    if not unit:
        raise UnitError(f"{text!r} has no unit", hint='write a length, for example "400 nm"')
    length_m = convert(number, unit, "m")
    if not 0.0 < length_m < math.inf:
        raise InvalidValue(f"{text!r} is not a size of a scan", hint="it has to be above zero")
    return length_m


def _shape(most: int, size_m: tuple[float, float]) -> Shape:
    # `most` pixels along the longer side; the pixels are square
    longest = max(size_m)
    return max(1, round(most * size_m[1] / longest)), max(1, round(most * size_m[0] / longest))
