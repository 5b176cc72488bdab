"""Files of scans and force curves: Igor binary waves of version 5, little endian, with a note."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Final

import numpy as np

from afspm.emulation import ScanActivity, SpectrumActivity
from afspm.plugins.asylum.emulator.values import IgorValues

_SINCE_1904_S: Final = 2_082_844_800
_LABEL: Final = 32
_FLOAT32: Final = 2

Entries = Mapping[str, float | str]
Made = Callable[[str], bytes]
"""A function that encodes a file, given the name of its wave."""


def image(name: str, scan: ScanActivity, values: IgorValues, now_s: float) -> bytes:
    """Encode the file of a scan; lines not scanned are NaN."""
    channels = scan.channels(scan.end_s if scan.stopped_s is not None else None)
    layers, labels = [], []
    for channel, (unit, found) in channels.items():
        quantity, _, back = channel.partition(" ")
        labels.append(f"{quantity.replace(' ', '')}{back or 'Trace'}")
        # real files have amplitudes as lengths
        layers.append((found * values.get("AmpInvOLS") if (quantity, unit) == ("Amplitude", "V") else found).T)
    rows, columns = scan.shape
    width, height = scan.region.size_m
    steps = [(width / (columns - 1), "m"), (height / (rows - 1), "m")]
    return igor_wave(name, np.stack(layers, axis=2), "m", steps, labels, _note(values, now_s), now_s)


def curve(name: str, spectrum: SpectrumActivity, distance_m: float, values: IgorValues, now_s: float) -> bytes:
    """Encode the file of a force curve: approach, then retract, over time.

    Args:
        distance_m: way of the piezo, as set at the start.
    """
    z = spectrum.values[:, 0]
    # the simulated curve has this way from the contact on, beyond its indentation
    swept = np.linspace(z[0], z[0] + distance_m, len(z))
    resampled = [np.interp(swept, z, column) for column in spectrum.values.T]
    table = dict(zip(spectrum.names, resampled, strict=True))
    extension = table["Z"].max() - table["Z"]
    there_and_back: Sequence[np.ndarray] = [
        np.concatenate([extension[::-1], extension]),
        np.concatenate([table["Deflection"][::-1], table["Deflection Retrace"]]),
    ]
    columns = np.column_stack([*there_and_back, there_and_back[0]])
    step_s = (spectrum.end_s - spectrum.start_s) / len(columns)
    noted = _of_curve(spectrum, distance_m, columns.shape[0], values)
    return igor_wave(name, columns, "m", [(step_s, "s")], ["Raw", "Defl", "ZSnsr"], _note(values, now_s, noted), now_s)


def _of_curve(spectrum: SpectrumActivity, distance_m: float, points: int, values: IgorValues) -> Entries:
    duration_s = spectrum.end_s - spectrum.start_s
    velocity_m_s = distance_m / (duration_s / 2)
    place = zip(("XLVDT", "YLVDT"), spectrum.position_m, strict=True)
    return {
        **dict(place),
        "ImagingMode": "Contact",
        "ForceDist": distance_m,
        "ForceScanRate": 1.0 / duration_s,
        "NumPtsPerSec": points / duration_s,
        "InputTime": duration_s,
        "ApproachVelocity": velocity_m_s,
        "RetractVelocity": velocity_m_s,
        "TriggerChannel": "DeflVolts",
        "TriggerPoint": values.get("DeflectionSetpointVolts"),
        "Indexes": f"0,{points // 2},{points - 1}",
        "Direction": "NaN,1,-1,",
    }


def _note(values: IgorValues, now_s: float, more: Entries = MappingProxyType({})) -> bytes:
    local, seconds = igor_moment(now_s)
    texts = {
        # not UTF-8 once encoded: a reader that assumes UTF-8 fails at real notes, too
        "StartHeadTemp": "32.125 °C",
        "Date": f"{local:%Y-%m-%d}",
        "Time": f"{local:%H:%M:%S}",
        "Seconds": f"{seconds:.3f}",
        "SaveImage": values.text("SaveImage"),  # twice, as in real notes: number and text
        "MicroscopeModel": "afspm SIMULATED",
        "Version": "15.09.112",
        "BaseName": values.text("BaseName"),
    }
    numbers = ((name, value) for name, value in values.noted() if name not in more)
    return igor_note([*numbers, *more.items(), *texts.items()])


def igor_moment(time_s: float) -> tuple[datetime, float]:
    """Return local time of the controller's computer, and Igor's time: local seconds since 1904."""
    local = datetime.fromtimestamp(time_s, UTC).astimezone()
    offset = local.utcoffset()
    return local, time_s + _SINCE_1904_S + (offset.total_seconds() if offset else 0.0)


def igor_note(entries: Iterable[tuple[str, float | str]]) -> bytes:
    """Encode a note: numbers with five digits, lines end with CR, Latin-1 instead of Unicode."""
    lines = (f"{key}: {value if isinstance(value, str) else _printed(value)}" for key, value in entries)
    return "".join(f"{line}\r" for line in lines).encode("latin-1", "replace")


def igor_wave(
    name: str,
    values: np.ndarray,
    unit: str,
    steps: Sequence[tuple[float, str]],
    labels: Sequence[str],
    note: bytes,
    time_s: float,
) -> bytes:
    """Encode a wave as an .ibw file.

    Args:
        values: the last dimension is channels, the others are axes.
        steps: increment and unit of each axis.
        labels: names of the channels.
        time_s: time of saving, experiment time.
    """
    body = np.asarray(values, dtype="<f4").tobytes(order="F")
    text = b"".join(label.encode("latin-1", "replace")[: _LABEL - 1].ljust(_LABEL, b"\0") for label in ("", *labels))
    channels = values.ndim - 1
    label_sizes = [len(text) if axis == channels else 0 for axis in range(4)]
    binary = struct.pack("<3i 4x 16x 4i 12x", 320 + len(body), 0, len(note), *label_sizes)
    seconds = round(igor_moment(time_s)[1]) & 0xFFFFFFFF
    units = [unit, *(axis_unit for _, axis_unit in steps)]
    wave_header = struct.pack(
        "<4x 2I i h 8x h 32s 8x 4i 4d 32x",
        seconds, seconds, values.size, _FLOAT32, 1, name.encode("latin-1", "replace")[: _LABEL - 1],
        *[*values.shape, 0, 0, 0][:4], *[*(step for step, _ in steps), 1.0, 1.0, 1.0, 1.0][:4],
    )  # fmt: skip
    wave_header += b"".join(one.encode().ljust(4, b"\0") for one in [*units, "", "", "", ""][:5])
    header = bytearray(struct.pack("<hH", 5, 0) + binary + wave_header.ljust(320, b"\0"))
    struct.pack_into("<H", header, 2, -int(np.frombuffer(header, "<i2").sum(dtype=np.int64)) & 0xFFFF)
    return bytes(header) + body + note + text


def _printed(value: float) -> str:
    # Igor's format: 5e-06, 3.7407e+05, and whole numbers of up to five digits in full.
    return f"{value:.5g}"
