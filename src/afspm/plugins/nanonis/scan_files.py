"""Nanonis scans (.sxm): a text header, then big-endian float32, forward and backward for each channel.

Rows are in recording order (upwards: the lowest first), backward rows from right to left; SCAN_OFFSET is the centre,
SCAN_ANGLE clockwise in degrees, SCAN_RANGE from edge to edge of the pixels; REC_DATE and REC_TIME are the start.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from datetime import tzinfo
from pathlib import Path

import numpy as np

from afspm.basics import NS_PER_S, FileError
from afspm.driver import FileContent, SettingInForce, local_ns, name_and_unit, stated_settings, text_of
from afspm.model import Region, Scan

CONTROLLER = "Nanonis"
_END = re.compile(rb"^:SCANIT_END:\s*\x1a\x04", re.MULTILINE)
_FIELD = re.compile(r":([^\r\n]+):")
_AFTER_COMMENT = re.compile(r".+>.*|[A-Z][A-Z0-9_-]*|Multipass-Config")
"""Names of the fields that may follow the comment, in which a user may have typed a line between colons."""
_DIRECTIONS = {"both": ("Forward", "Backward"), "forward": ("Forward",), "backward": ("Backward",)}


def read_scan(path: Path, zone: tzinfo | None) -> FileContent:
    """Read all channels, named e.g. "Z Forward" and "Z Backward". Raises FileError, KeyError, ValueError: damaged."""
    content = path.read_bytes()
    if (end_of_header := _END.search(content)) is None:
        raise FileError("is not a Nanonis scan, or incomplete: its header does not end")
    header = _header(text_of(content[: end_of_header.start()]))
    if _field(header, "SCANIT_TYPE").split() != ["FLOAT", "MSBFIRST"]:
        raise FileError(f"holds values as {_field(header, 'SCANIT_TYPE')!r} instead of FLOAT MSBFIRST")
    nx, ny = (int(value) for value in _field(header, "SCAN_PIXELS").split())
    images = _images(_field(header, "DATA_INFO"))
    values, size = content[end_of_header.end() :], 4 * len(images) * nx * ny
    if min(nx, ny) < 2:
        raise FileError(f"has {nx} x {ny} pixels: afspm reads scans of two lines and columns or more")
    if len(values) != size:
        raise FileError(f"is incomplete: {len(values)} bytes of values, not the {size} of {len(images)} images")
    direction = _field(header, "SCAN_DIR")
    if direction not in ("up", "down"):
        raise FileError(f"was scanned {direction!r}, neither up nor down")
    begun, end = _times(header, zone)
    region, upwards = _region(header, nx, ny), direction == "up"
    stack = np.frombuffer(values, ">f4").reshape(len(images), ny, nx)
    scans = []
    for (name, way, unit), image in zip(images, stack, strict=True):
        rows = image if upwards else image[::-1]
        # In real files, forward and backward images agree only after mirroring one of them.
        pixels = rows[:, ::-1] if way == "Backward" else rows
        values_of = pixels.astype(np.float64)
        scans.append(Scan(region, f"{name} {way}", unit, values_of, end, str(path), in_force=lock_in(header)))
    return FileContent(CONTROLLER, tuple(scans), header=header, start_ns=begun, end_ns=end, upwards=upwards)


def lock_in(header: Mapping[str, str]) -> tuple[SettingInForce, ...]:
    """Return the modulation of the lock-in as a header states it; empty while the lock-in is off, or not stated."""
    if header.get("Lock-in>Lock-in status", "ON") != "ON":
        return ()
    _, unit = name_and_unit(header.get("Lock-in>Modulated signal", ""))
    given = {
        "x-lock-in-amplitude": (_number(header, "Lock-in>Amplitude"), unit),
        "x-lock-in-frequency": (_number(header, "Lock-in>Frequency (Hz)"), "Hz"),
        "x-lock-in-phase": (_number(header, "Lock-in>Reference phase D1 (deg)"), "deg"),
    }
    return stated_settings(given if unit else {name: one for name, one in given.items() if one[1]})


def _number(header: Mapping[str, str], name: str) -> float | None:
    try:
        value = float(header[name])
    except (KeyError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _header(text: str) -> dict[str, str]:
    # A field is a line `:NAME:` and the lines below it. The header of another scan may stand in the comment: of fields
    # before the comment the first counts, of fields after it the last.
    before: dict[str, list[str]] = {}
    after: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in text.splitlines():
        field = _FIELD.fullmatch(line)
        if field is None or ("COMMENT" in before and not _ends_comment(field[1], before)):
            lines.append(line)
            continue
        lines = []
        if "COMMENT" in before:
            after[field[1]] = lines
        else:
            before.setdefault(field[1], lines)
    return {name: "\n".join(value).strip() for name, value in {**after, **before}.items()}


def _ends_comment(name: str, before: dict[str, list[str]]) -> bool:
    return name not in {*before, "SCANIT_END"} and _AFTER_COMMENT.fullmatch(name) is not None


def _field(header: dict[str, str], name: str) -> str:
    if name not in header:
        raise FileError(f"its header lacks {name}")
    return header[name]


def _images(table: str) -> list[tuple[str, str, str]]:
    # a field that another program has added below may have a name in small letters, which the comment's end has not
    lines = itertools.takewhile(lambda line: not _FIELD.fullmatch(line), table.splitlines())
    rows = [[column.strip() for column in line.strip().split("\t")] for line in lines if line.strip()]
    return [(name, way, unit) for _, name, unit, ways, *_ in rows[1:] for way in _DIRECTIONS[ways]]


def _region(header: dict[str, str], nx: int, ny: int) -> Region:
    width, height = (float(value) for value in _field(header, "SCAN_RANGE").split())
    x, y = (float(value) for value in _field(header, "SCAN_OFFSET").split())
    clockwise_deg = float(_field(header, "SCAN_ANGLE"))
    return Region((x, y), (width * (nx - 1) / nx, height * (ny - 1) / ny), math.radians(0.0 - clockwise_deg))


def _times(header: dict[str, str], zone: tzinfo | None) -> tuple[int, int]:
    begun = local_ns(f"{_field(header, 'REC_DATE')} {_field(header, 'REC_TIME')}", "%d.%m.%Y %H:%M:%S", zone)
    return begun, begun + round(float(_field(header, "ACQ_TIME")) * NS_PER_S)
