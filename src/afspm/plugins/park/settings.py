"""Frame, speed, gains and tip position: conversion between SmartScan's values and generic parameters.

SmartScan has the centre of a frame in µm, its angle in degrees, and lines per second; a line is forward and backward
(! offset-is-centre, line-both-ways). A mark (! ID) names a row of claims.toml.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from afspm.basics import InvalidValue
from afspm.driver import (
    FRAME,
    POSITION,
    KeptSettings,
    LongCall,
    SettingsGroup,
    Value,
    check_speed,
    frame,
    frame_values,
)
from afspm.model import XY, ControlResponse, Region, names
from afspm.plugins.park.session import Session

MICROMETRE: Final = 1e-6
MOVE: Final = "move"
_RATE: Final = "scan.rate"
_GAIN: Final = "zservo.gain"
_GAINS: Final = {names.ZCTRL_PGAIN: f"{_GAIN}.p", names.ZCTRL_IGAIN: f"{_GAIN}.i"}
_SPEED_PATH: Final = 2.0
"""Path of the tip in a line, in widths of the frame: forward and backward (! line-both-ways)."""


class FrameSettings(SettingsGroup):
    """Frame and speed, set together since the speed depends on the width and the line rate.

    Args:
        on_read: receives each frame that was read, its number of lines, and the lines per second.
    """

    names = frozenset({*FRAME, names.SCAN_SPEED})

    def __init__(self, session: Callable[[], Session], on_read: Callable[[Region, int, float], None]) -> None:
        self._session = session
        self._on_read = on_read

    def read(self) -> dict[str, Value]:
        found = self._session().geometry()
        width = found["width"] * MICROMETRE
        center = (found["offsetX"] * MICROMETRE, found["offsetY"] * MICROMETRE)
        region = Region(center, (width, found["height"] * MICROMETRE), math.radians(found["rotation"]))
        shape = (round(found["pixelHeight"]), round(found["pixelWidth"]))
        rate = float(self._session().values([_RATE])[_RATE])
        self._on_read(region, shape[0], rate)
        return {**frame_values(region, shape), names.SCAN_SPEED: _SPEED_PATH * width * rate}

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = self.merged(values)
        region, (rows, columns) = frame(wanted)
        speed_m_s = float(wanted[names.SCAN_SPEED])
        if speed_m_s <= 0.0:
            raise InvalidValue(f"the scan speed must be above 0, not {speed_m_s:g} m/s")
        (x, y), (width, height) = region.center_m, region.size_m
        self._session().set_geometry(
            {
                "pixelHeight": rows,
                "pixelWidth": columns,
                "width": width / MICROMETRE,
                "height": height / MICROMETRE,
                "offsetX": x / MICROMETRE,
                "offsetY": y / MICROMETRE,
                "rotation": math.degrees(region.angle_rad),
            }
        )
        # The line rate is not part of the geometry.
        self._session().put({_RATE: speed_m_s / (_SPEED_PATH * width)})
        check_speed(speed_m_s, float(self.read()[names.SCAN_SPEED]))


class Gains(SettingsGroup):
    """The gains of the feedback: two of the four members of an object, which may be write-only (! gains-readable)."""

    names = tuple(_GAINS)

    def __init__(self, session: Callable[[], Session]) -> None:
        self._session = session

    def read(self) -> dict[str, Value]:
        found = self._session().values(list(_GAINS.values()))
        return {name: float(found[path]) for name, path in _GAINS.items()}

    def are_reported(self) -> bool:
        """Return True if SmartScan reports the gains. Raises ControllerLost."""
        return all(map(self._session().is_number, _GAINS.values()))

    def write(self, values: Mapping[str, Value]) -> None:
        self._session().put_members(
            _GAIN, {_GAINS[name].rpartition(".")[2]: float(value) for name, value in values.items()}
        )


class TipPlace(KeptSettings):
    """The target position of the tip, (0, 0) before the first move (! tip-place)."""

    def __init__(self, session: Callable[[], Session], begun: Callable[[LongCall], None]) -> None:
        super().__init__(dict.fromkeys(POSITION, 0.0))
        self._session, self._begun = session, begun

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = self.merged(values)
        way = way_to((float(wanted[POSITION[0]]), float(wanted[POSITION[1]])))
        # after a refused move the tip is still at the position before
        self._begun(self._session().start(MOVE, way, ControlResponse.PARAM_ERROR))
        super().write(values)

    def xy_m(self) -> XY:
        """Return the target position of the tip, (x, y) in m."""
        x, y = map(self.number, POSITION)
        return x, y


def way_to(place_m: XY) -> str:
    """Return the script that moves the tip to a position."""
    x, y = (length / MICROMETRE for length in place_m)
    return f"(spm.xyscanner.moveTo({x!r}, {y!r}), 0)"
