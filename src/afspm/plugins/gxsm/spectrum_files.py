"""GXSM's vector probe data (.vpdata): text, `# KEY :: name=value …`, then a table."""

from __future__ import annotations

import re
from datetime import tzinfo
from pathlib import Path

import numpy as np

from afspm.basics import FileError, convert
from afspm.driver import FileContent, local_ns, name_and_unit, text_of
from afspm.model import Spectrum
from afspm.plugins.gxsm.scan_files import CONTROLLER

_MISLABELLED = {"LockIn-Mag": "V", "McBSP Ampl": "V", "McBSP Exec": "V", "In 0": "nA"}
"""Unit of the values of signals that GXSM labels with another unit, in which it shows their scans (mV, pA).

All other columns have values in the unit of their label, among them "ADC0-I (pA)" of an SRanger and "Amplitude (mV)" of
a RedPitaya. The rule of scans does not hold here: a label has only the symbol of a unit, and "mV" stands for two units.
"""
_NUMBERED = re.compile(r"^\d\d-")
_BEGIN, _END = "#C Data Table", "#C END."


def read_spectrum(path: Path, zone: tzinfo | None) -> FileContent:
    """Read a spectrum; its kind is the end of the file's name ("VP", "IV" …), by default "VP".

    The position is None: the file has the offset of the scan, not the place of the probe. Columns without a unit (row
    number, block starts) and repeated columns are left out; lengths are converted to m.

    Raises:
        FileError, ValueError: another format, or damaged.
    """
    lines = text_of(path.read_bytes()).splitlines()
    starts = [k for k, line in enumerate(lines) if line.startswith(_BEGIN)]
    ends = [k for k, line in enumerate(lines) if line.startswith(_END)]
    if len(starts) != 1 or not ends or ends[0] < starts[0] + 3:
        raise FileError("is not probe data of GXSM, or incomplete: its table has no end")
    header = _header(lines[: starts[0]])
    columns = lines[starts[0] + 1].removeprefix("#C ").split("\t")
    rows = [line.split("\t") for line in lines[starts[0] + 2 : ends[0]] if line.strip("#C \t")]
    announced = re.search(r"N=(\d+)", header.get("Probe Data Number", ""))
    if announced is None or len(rows) != int(announced[1]):
        raise FileError(f"has {len(rows)} rows in its table instead of the announced {announced and announced[1]}")
    for number, row in enumerate(rows):
        if len(row) != len(columns) or row[0] != str(number):
            raise FileError(f"row {number} of its table is damaged")
    table = np.array([[float(cell) for cell in row] for row in rows])
    end = None
    if "Date" in header:
        end = local_ns(header["Date"].removeprefix("date="), "%a %b %d %H:%M:%S %Y", zone)
    named = re.search(r"-([A-Z]+)\.vpdata$", path.name)
    spectrum = _spectrum(columns, table, named[1] if named else "VP", end, path)
    return FileContent(CONTROLLER, spectra=(spectrum,), header=header, end_ns=end)


def _header(lines: list[str]) -> dict[str, str]:
    pairs = (line.removeprefix("# ").partition("::") for line in lines if line.startswith("# "))
    return {key.strip(): value.strip() for key, found, value in pairs if found}


def _spectrum(columns: list[str], table: np.ndarray, kind: str, end: int | None, path: Path) -> Spectrum:
    names: list[str] = []
    units: list[str] = []
    values: list[np.ndarray] = []
    for column, numbers in zip(columns, table.T, strict=True):
        name, unit = name_and_unit(column.strip().strip('"'))
        if unit in ("mV", "pA"):
            unit = _MISLABELLED.get(_NUMBERED.sub("", name), unit)
        if not unit or name in names:
            continue
        length = unit == "Å"
        names.append(name)
        units.append("m" if length else unit)
        values.append(convert(numbers, "Å", "m") if length else numbers)
    if not names:
        raise FileError("its table has no column with a unit")
    return Spectrum(None, kind, tuple(names), tuple(units), np.column_stack(values), end, str(path))
