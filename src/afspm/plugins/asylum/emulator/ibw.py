"""Files as Asylum's software writes them: Igor binary waves of version 5, little endian, with a note. Pure."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Final

import numpy as np

_SINCE_1904_S: Final = 2_082_844_800
_LABEL: Final = 32
_FLOAT32: Final = 2


def moment(time_s: float) -> tuple[datetime, float]:
    """Return the local time of the controller's computer, and Igor's: seconds of local time since 1904."""
    local = datetime.fromtimestamp(time_s, UTC).astimezone()
    offset = local.utcoffset()
    return local, time_s + _SINCE_1904_S + (offset.total_seconds() if offset else 0.0)


def note(entries: Iterable[tuple[str, float | str]]) -> bytes:
    """The note: numbers with five digits, lines that end with CR, and no Unicode."""
    lines = (f"{key}: {value if isinstance(value, str) else _printed(value)}" for key, value in entries)
    return "".join(f"{line}\r" for line in lines).encode("latin-1", "replace")


def wave(
    name: str,
    values: np.ndarray,
    unit: str,
    steps: Sequence[tuple[float, str]],
    labels: Sequence[str],
    note: bytes,
    time_s: float,
) -> bytes:
    """The bytes of a file.

    Args:
        values: all but the last dimension are axes, the last one is of channels.
        steps: of each axis, and its unit.
        labels: of each channel.
        time_s: when it was saved, experiment time.
    """
    body = np.asarray(values, dtype="<f4").tobytes(order="F")
    text = b"".join(label.encode("latin-1", "replace")[: _LABEL - 1].ljust(_LABEL, b"\0") for label in ("", *labels))
    channels = values.ndim - 1
    label_sizes = [len(text) if axis == channels else 0 for axis in range(4)]
    binary = struct.pack("<3i 4x 16x 4i 12x", 320 + len(body), 0, len(note), *label_sizes)
    seconds = round(moment(time_s)[1]) & 0xFFFFFFFF
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
    """Format as Igor does: 5e-06, 3.7407e+05, and whole numbers up to five digits in full."""
    return f"{value:.5g}"
