"""Asylum Research: Igor binary waves (.ibw) and the meaning of their notes.

Real files show: XOffset and YOffset are the centre of the scan; images are [x, y, channel] with both axes ascending for
either scan direction; FastScanSize is the distance from the first to the last pixel; `Seconds` is the local time of
saving, since 1904; the unit of a wave applies to its first channel or column only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime, timedelta, tzinfo
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from afspm.basics import NS_PER_S, FileError, PlainMapping
from afspm.driver import SENSITIVITY, SPRING_CONSTANT, FileContent, SettingInForce, clock_ns, igor, stated_settings
from afspm.model import Region, Scan, Spectrum

Note = PlainMapping

CONTROLLER = "Asylum"
_IGOR_EPOCH = datetime(1904, 1, 1)  # noqa: DTZ001  (local time of the controller)
# Units by the beginning of a channel's name, without the "Nap" of a second pass: a wave has only one unit.
_UNITS = {
    "Height": "m", "ZSensor": "m", "RawZSensor": "m", "Amplitude": "m", "Deflection": "m", "Phase": "deg",
    "Frequency": "Hz", "Current": "A", "UserIn": "V", "BackPackIn": "V", "Lateral": "V", "Potential": "V",
}  # fmt: skip
# Units of a curve's columns, by the beginning of their names. The file has only the unit of the first column.
_CURVE_UNITS = {
    "Raw": "m", "DeflV": "V", "Defl": "m", "ZSnsr": "m", "Amp": "m", "Phas": "deg", "Freq": "Hz", "Cur": "A",
    "Bias": "V", "Pot": "V", "Lat": "V", "User": "V",
}  # fmt: skip


def read_igor(path: Path, zone: tzinfo | None) -> FileContent:
    """Read an image with its channels, or a force curve. Raises FileError: the file has neither, or is damaged."""
    wave = igor.read_wave(path.read_bytes())
    note = parsed_note(wave.note)
    first = wave.dimension_units[0]
    if wave.values.ndim in (2, 3) and first == wave.dimension_units[1] == "m":
        return _image(wave, note, path, zone)
    if wave.values.ndim == 2 and first == "s":
        return _curve(wave, note, path, zone)
    raise FileError(
        f"an Igor wave that is neither an image over lengths nor a curve over time (shape {wave.values.shape})"
    )


def parsed_note(text: str) -> dict[str, str]:
    """Return the lines `key: value` of a wave's note; the first of duplicate keys counts."""
    note: dict[str, str] = {}
    for line in text.replace("\n", "\r").split("\r"):
        key, colon, value = line.partition(":")
        if colon:
            note.setdefault(key.strip(), value.strip())
    return note


def center_and_angle(note: Note) -> tuple[tuple[float, float], float]:
    """Return the scan's centre (x, y) in m and its angle in radians. Raises FileError: the note lacks the position."""
    center = (number(note, "XOffset"), number(note, "YOffset"))
    if center[0] is None or center[1] is None:
        raise FileError("its note lacks the position of the scan (XOffset, YOffset)")
    return (center[0], center[1]), counter_clockwise(number(note, "ScanAngle") or 0.0)


def counter_clockwise(scan_angle_deg: float) -> float:
    """Convert ScanAngle (degrees, clockwise) to radians counter-clockwise.

    Asylum's code for scans and lithography turns the fast axis to (cos, -sin) of the angle, about the unrotated centre.
    """
    return 0.0 - math.radians(scan_angle_deg)


def clockwise(angle_rad: float) -> float:
    """Convert radians counter-clockwise to degrees clockwise, as ScanAngle counts."""
    return 0.0 - math.degrees(angle_rad)


def number(note: Note, key: str) -> float | None:
    """Return a number of a note; None if the number is missing or not finite."""
    try:
        value = float(note[key])
    except (KeyError, TypeError, ValueError):
        return None
    return value if math.isfinite(value) else None


def calibration(note: Note) -> tuple[SettingInForce, ...]:
    """Return the spring constant and the sensitivity of a note, as far as it has them; one of 0 is not calibrated."""
    spring, sensitivity = (number(note, key) or None for key in ("SpringConstant", "InvOLS"))
    return stated_settings({SPRING_CONSTANT: (spring, "N/m"), SENSITIVITY: (sensitivity, "m/V")})


def upwards(note: Note) -> bool | None:
    """Return True if the row of smallest y was scanned first; None: unknown."""
    down = number(note, "ScanDown")
    return None if down is None else down == 0.0


def end_ns(note: Note, zone: tzinfo | None) -> int | None:
    """Return the time of saving in ns since the Unix epoch; None: unknown. `zone` is the zone of the controller."""
    seconds = number(note, "Seconds")
    return None if seconds is None else clock_ns(_IGOR_EPOCH + timedelta(seconds=seconds), zone)


def start_ns(note: Note, rows: int, zone: tzinfo | None) -> int | None:
    """Return the start of the first row in ns since the Unix epoch; None: unknown.

    The start is the time of saving minus the duration of all lines, doubled by a second pass (NapMode).
    """
    rate_hz, end = number(note, "ScanRate"), end_ns(note, zone)
    if end is None or rate_hz is None or rate_hz <= 0.0:
        return None
    passes = 2 if number(note, "NapMode") else 1
    return end - round(passes * rows / rate_hz * NS_PER_S)


def unit_of(channel: str) -> str:
    """Return the unit of an image channel by its name; empty: unknown."""
    return _of_name(channel.removeprefix("Nap"), _UNITS)


def _of_name(name: str, units: Mapping[str, str]) -> str:
    return next((unit for start, unit in units.items() if name.startswith(start)), "")


def _image(wave: igor.Wave, note: Note, path: Path, zone: tzinfo | None) -> FileContent:
    layers = wave.values if wave.values.ndim == 3 else wave.values[:, :, None]
    nx, ny, count = layers.shape
    center_m, angle_rad = center_and_angle(note)
    size_m = (wave.steps[0] * (nx - 1), wave.steps[1] * (ny - 1))
    region = Region(center_m, size_m, angle_rad)
    labels = wave.labels[2] if any(wave.labels[2]) else [wave.name] * count
    labels = [label or f"Channel {k + 1}" for k, label in enumerate(labels)]
    if len(labels) != count:
        raise FileError(f"{count} channels with {len(labels)} names")
    end, in_force = end_ns(note, zone), calibration(note)
    scans = tuple(
        Scan(
            region,
            label,
            unit_of(label) or (wave.unit if k == 0 else ""),
            _float64(layers[:, :, k].T),
            end,
            str(path),
            in_force=in_force,
        )
        for k, label in enumerate(labels)
    )
    return FileContent(
        CONTROLLER, scans=scans, header=note, start_ns=start_ns(note, ny, zone), end_ns=end, upwards=upwards(note)
    )


def _curve(wave: igor.Wave, note: Note, path: Path, zone: tzinfo | None) -> FileContent:
    # The columns (raw z, deflection, z sensor; when tapping also amplitude and phase) are sampled at equal time steps.
    # The time is appended as the last column.
    points, count = wave.values.shape
    if len(wave.labels[1]) != count:
        raise FileError(f"{count} columns with {len(wave.labels[1])} names")
    units = [_of_name(name, _CURVE_UNITS) or (wave.unit if k == 0 else "") for k, name in enumerate(wave.labels[1])]
    time_s = np.arange(points) * wave.steps[0]
    x, y = number(note, "XLVDT"), number(note, "YLVDT")
    end = end_ns(note, zone)
    spectrum = Spectrum(
        None if x is None or y is None else (x, y),
        "force",
        (*wave.labels[1], "Time"),
        (*units, "s"),
        np.column_stack([_float64(wave.values), time_s]),
        end,
        str(path),
        in_force=calibration(note),
    )
    start = None if end is None else end - round(points * wave.steps[0] * NS_PER_S)
    return FileContent(CONTROLLER, spectra=(spectrum,), header=note, start_ns=start, end_ns=end)


def _float64(values: np.ndarray) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, dtype=np.float64)
