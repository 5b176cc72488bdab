"""A recorded run in other file formats: `afspm export`.

An exporter is a module that a package declares by its format. `write(run, row)` yields (suffix, content) of each file
of a scan or spectrum; a module with `PICTURES` has a third argument, the channels to draw. Two functions are optional:
`tables(run, scans, spectra)` yields (name, content) of files about the whole run, and `grid_file(stack, metadata)`
returns the spectra of a grid as one file.
A format with one file for many measurements has `archive(run, scans, spectra, folder)` instead of `write`: it
writes such files, which may be larger than memory, and yields their paths. Measurements whose file can't be opened are
not among `scans` and `spectra`.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from afspm.basics import entry_points
from afspm.basics.errors import FileError, InvalidValue
from afspm.model import Spectrum
from afspm.night.run import Run
from afspm.night.spectrum_stack import SpectrumStack, stacked
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.record import measured_file
from afspm.record.measured_files import write_synced

__all__ = ["chosen", "export"]


_log = logging.getLogger("afspm.record")
_LEAST_POSITIONS = 4
"""The positions of the smallest grid."""
Writer = Callable[[Run, ScanRow | SpectrumRow], Iterator[tuple[str, bytes]]]


def export(
    run: Run,
    to: str,
    folder: Path,
    scans: str | None = None,
    tell: Callable[[str], None] = _log.warning,
    channels: Sequence[str] = (),
) -> Iterator[Path]:
    """Write a run in another format, and yield the path of each written file.

    Args:
        to: a format that a package declares an exporter for.
        folder: created if it is missing.
        scans: numbers of scans, as for `chosen`, without spectra; None: all scans and spectra.
        tell: called with a message for each omitted measurement; by default it is logged as a warning.
        channels: channels of scans to draw, by role or by the maker's names, for a format of pictures; none: all.

    Raises:
        InvalidValue: there is no such format, or no such scan, or the format has all channels in one file.
        FileError: a file can't be written.
    """
    module = entry_points.load(entry_points.EXPORTERS, to)
    if module is None:
        hint = f"one of {', '.join(entry_points.names(entry_points.EXPORTERS))}"
        raise InvalidValue(f"there is no format {to!r}", hint=hint)
    if channels and not hasattr(module, "PICTURES"):
        raise InvalidValue(f"{to} has all channels of a scan in one file", hint="--channel is for pictures: png, pdf")
    wanted = list(run.scans) if scans is None else chosen(list(run.scans), scans)
    for row in wanted:
        if not row.file:
            tell(f"scan {row.number} was interrupted before anything of it was seen")
    spectra = list(run.spectra) if scans is None else []
    wanted = [row for row in wanted if row.file]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if hasattr(module, "archive"):
            there = [*_with_files(run, wanted, tell)], [*_with_files(run, spectra, tell)]
            yield from module.archive(run, *there, folder)
            return
        for name, content in module.tables(run, wanted, spectra) if hasattr(module, "tables") else ():
            yield _written(folder / name, content)
        write = partial(module.write, channels=channels) if channels else module.write
        yield from _write_each(write, run, [*wanted, *spectra], folder, tell)
        for name, stack in grids(run, spectra, tell) if hasattr(module, "grid_file") else ():
            yield _written(folder / f"{name}.{to}", module.grid_file(stack, run.metadata))
    except OSError as error:
        raise FileError(f"can't be written: {error}", where=str(folder)) from error


def unreadable(run: Run, row: ScanRow | SpectrumRow) -> FileError | None:
    """Return the reason why the file of a measurement can't be opened; None if it can be opened."""
    try:
        with measured_file(run.folder, row.file).open("rb"):
            return None
    except FileError as error:
        return error
    except OSError as error:
        return FileError(f"can't be read: {error.strerror or error}", where=str(run.folder / row.file))


Row = TypeVar("Row", ScanRow, SpectrumRow)


def _with_files(run: Run, rows: Sequence[Row], tell: Callable[[str], None]) -> Iterator[Row]:
    for row in rows:
        error = unreadable(run, row)
        if error is None:
            yield row
        else:
            tell(str(error))


def _write_each(
    write: Writer, run: Run, rows: Sequence[ScanRow | SpectrumRow], folder: Path, tell: Callable[[str], None]
) -> Iterator[Path]:
    # a damaged file costs its own measurement, not all others
    for row in rows:
        try:
            for end, content in write(run, row):
                yield _written(folder / f"{_stem(row)}{end}", content)
        except FileError as error:
            tell(str(error))


def file_word(channel: str) -> str:
    """Return the name of a channel as a part of a file name."""
    return re.sub(r"[^\w.-]+", "_", channel).strip("_") or "channel"


def _stem(row: ScanRow | SpectrumRow) -> str:
    kind = "spectrum-" if isinstance(row, SpectrumRow) else ""
    key = re.sub(r"[^\w.-]+", "-", row.key).strip("-.")
    return f"{kind}{row.number:04}" + (f"-{key}" if key else "")


def _written(path: Path, content: bytes) -> Path:
    write_synced(path, content)
    return path


def chosen(rows: list[ScanRow], numbers: str) -> list[ScanRow]:
    """Return the scans selected by "3", "1-5,8" or "7-" (from 7 on).

    Raises:
        InvalidValue: the text is not a list of numbers, or a scan does not exist.
    """
    by_number = {row.number: row for row in rows}
    last = max(by_number, default=0)
    wanted: list[int] = []
    for part in numbers.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(-\s*(\d*))?\s*", part)
        if match is None:
            raise InvalidValue(f"{part!r} is not a number of a scan", hint="e.g. 3, 1-5,8 or 7-")
        first = int(match[1])
        until = int(match[3] or last) if match[2] else first
        if first not in by_number or until not in by_number or until < first:
            raise InvalidValue(f"there is no scan {part.strip()}", hint=f"there are 1 to {last}")
        wanted += range(first, until + 1)
    if missing := [number for number in wanted if number not in by_number]:
        raise InvalidValue(f"there is no scan {missing[0]}", hint=f"there are 1 to {last}")
    return [by_number[number] for number in dict.fromkeys(wanted)]


def grids(
    run: Run, rows: Sequence[SpectrumRow], tell: Callable[[str], None] | None = None
) -> Iterator[tuple[str, SpectrumStack]]:
    """Yield each grid of at least two by two spectra of one kind, with the name of its file.

    Different sweeps are interpolated to common values. A spectrum with a damaged file counts as unmeasured.

    Args:
        tell: called with a message for spectra at several positions that form no grid, as with one spectrum beside it.
    """
    spectra: dict[tuple[str, tuple[str, ...]], list[Spectrum]] = {}
    for row in rows:
        with suppress(FileError):
            spectrum = run.spectrum(row)
            spectra.setdefault((spectrum.kind, spectrum.names), []).append(spectrum)
    for number, ((kind, _), alike) in enumerate(spectra.items(), 1):
        try:
            stack = stacked(alike, interpolate=True)
        except InvalidValue as error:
            if tell is not None and len({one.position_m for one in alike}) >= _LEAST_POSITIONS:
                tell(f"{len(alike)} spectra of kind {kind or '(none)'} are in no file of a grid: {error.what}")
            continue
        if min(len(stack.points.x_m), len(stack.points.y_m)) > 1:
            name = re.sub(r"[^\w-]+", "-", kind).strip("-") or "spectra"
            yield f"grid-{number:02}-{name}", stack
