"""Nanonis spectra (.dat): lines `name<tab>value`, then `[DATA]` and a table with units in the column names."""

from __future__ import annotations

import math
from datetime import tzinfo
from pathlib import Path

import numpy as np

from afspm.basics import FileError
from afspm.driver import FileContent, OtherFormat, local_ns, name_and_unit, text_of
from afspm.model import Spectrum
from afspm.plugins.nanonis.scan_files import CONTROLLER, lock_in

_TABLE = "[DATA]"
_LAYOUT = "%d.%m.%Y %H:%M:%S"


def read_spectrum(path: Path, zone: tzinfo | None) -> FileContent:
    """Read a spectrum with all columns of its table; `kind` is Nanonis' name, e.g. "bias spectroscopy".

    A file truncated between two lines can't be distinguished from a shorter file.

    Raises:
        FileError, ValueError: another format, or damaged.
    """
    text = text_of(path.read_bytes()).removeprefix("\ufeff").replace("\r\n", "\n")
    head, found, table = text.rpartition(f"\n{_TABLE}\n")  # a comment may have such a line, the table has none
    if not found:
        raise OtherFormat("is not a spectrum of Nanonis, or incomplete: it has no [DATA]")
    header: dict[str, str] = {}
    for key, _, rest in (line.partition("\t") for line in head.split("\n")):
        header.setdefault(key, rest.strip())
    if "Experiment" not in header:
        raise OtherFormat("is not a spectrum of Nanonis: its header has no line Experiment")
    if not table.endswith("\n"):  # 1E-1 may be the beginning of 1E-12
        hint = "if an editor has left out the end of the last line, add it"
        raise FileError("may be incomplete: its last line has no end", hint=hint)
    columns, *lines = [line.rstrip("\t").split("\t") for line in table.splitlines() if line.strip()]
    for number, line in enumerate(lines, 1):
        if len(line) != len(columns):
            raise FileError(f"row {number} of its table has {len(line)} columns instead of {len(columns)}")
    if not lines:
        raise FileError("is incomplete: its table is empty")
    names, units = zip(*map(name_and_unit, columns), strict=True)
    values = np.array([[_number(cell, row) for cell in line] for row, line in enumerate(lines, 1)])
    end = _time(header, ("Saved Date", "Date"), zone)
    place_m, in_force = _position_m(header), lock_in(header)
    spectrum = Spectrum(place_m, header["Experiment"], names, units, values, end, str(path), in_force=in_force)
    start = _time(header, ("Start time",), zone)
    if start is not None and end is not None and end < start:  # the hour that the end of summer time repeats
        end = _time(header, ("Saved Date", "Date"), zone, fold=1)
    return FileContent(CONTROLLER, spectra=(spectrum,), header=header, start_ns=start, end_ns=end)


def _position_m(header: dict[str, str]) -> tuple[float, float] | None:
    x, y = (float(header.get(f"{axis} (m)", "nan")) for axis in "XY")
    return (x, y) if math.isfinite(x) and math.isfinite(y) else None


def _number(cell: str, row: int) -> float:
    try:
        return float(cell)
    except ValueError:
        hint = "save it with decimal points" if "," in cell else "a file of numbers is expected"
        raise FileError(f"row {row} of its table has {cell!r}, which is no number", hint=hint) from None


def _time(header: dict[str, str], keys: tuple[str, ...], zone: tzinfo | None, *, fold: int = 0) -> int | None:
    text = next((header[key] for key in keys if header.get(key)), None)
    return None if text is None else local_ns(text, _LAYOUT, zone, fold=fold)
