"""Readers of the controllers' files. Each format is a module; libraries are imported only when needed.

    from afspm.storage.formats import read
    content = read("scan0001.ibw")
    content.scans[0].values      # [y, x], both ascending

A reader is a function from a path and a time zone to a `FileContent`. Packages declare readers by the suffixes of their
files (`afspm.basics.entry_points`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import tzinfo
from pathlib import Path

from afspm.basics import entry_points
from afspm.basics.errors import FileError
from afspm.storage.formats.content import FileContent, OtherFormat

__all__ = ["FileContent", "OtherFormat", "read", "suffixes"]


Reader = Callable[[Path, tzinfo | None], FileContent]


def suffixes() -> tuple[str, ...]:
    """Return the suffixes of readable files, with their dots."""
    return tuple(dict.fromkeys(f".{name.partition('.')[0]}" for name in entry_points.names(entry_points.READERS)))


def read(path: str | Path, *, zone: tzinfo | None = None) -> FileContent:
    """Return the scans and spectra of a file.

    The suffix of the file selects the reader: of a maker's format, of Gwyddion's simple fields (.gsf), or of NeXus
    (.h5, .nxs), be it afspm's record, an exported grid of spectra or the file of another program. `afspm doctor`
    lists the suffixes. If two channels have the same name, the second becomes "name #2".

    Args:
        zone: time zone of the controller's clock, which most files do not state; None: the zone of this computer.

    Raises:
        FileError: the file is missing, incomplete or in another format, or there is no reader or library for it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError("no such file", where=str(path))
    readers = _readers(path.suffix.lower())
    if not readers:
        raise FileError(
            f"afspm has no reader for {path.suffix or 'a file without a suffix'}",
            where=str(path),
            hint=f"read: {' '.join(suffixes())}",
        )
    try:
        return _with_unique_channels(_first_that_reads(readers, path, zone))
    except FileError as error:
        if error.where:
            raise
        raise FileError(error.what, where=str(path), hint=error.hint) from error
    except Exception as error:  # on a damaged file a reader may raise errors of any type
        why = f"{type(error).__name__}: {error}"
        raise FileError(f"is not readable as {path.suffix}: {why}", where=str(path)) from error


def _readers(suffix: str) -> list[str]:
    return [name for name in entry_points.names(entry_points.READERS) if f".{name.partition('.')[0]}" == suffix]


def _first_that_reads(readers: Sequence[str], path: Path, zone: tzinfo | None) -> FileContent:
    for name in readers[:-1]:
        with suppress(OtherFormat):
            return _read(name, path, zone)
    return _read(readers[-1], path, zone)


def _read(name: str, path: Path, zone: tzinfo | None) -> FileContent:
    reader: Reader = entry_points.load(entry_points.READERS, name)
    return reader(path, zone)


def _with_unique_channels(content: FileContent) -> FileContent:
    # users may give two signals of a controller the same name
    names = _unique([scan.channel for scan in content.scans])
    scans = (replace(scan, channel=name) for scan, name in zip(content.scans, names, strict=True))
    spectra = (replace(spectrum, names=_unique(spectrum.names)) for spectrum in content.spectra)
    return replace(content, scans=tuple(scans), spectra=tuple(spectra))


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    taken: dict[str, None] = {}
    for first in names:
        name, number = first, 1
        while name in taken:
            number += 1
            name = f"{first} #{number}"
        taken[name] = None
    return tuple(taken)
