"""`read`: any file that a controller wrote."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import tzinfo
from importlib import import_module
from pathlib import Path

from afspm import entry_points
from afspm.errors import FileError
from afspm.files.content import FileContent

Reader = Callable[[Path, tzinfo | None], FileContent]

# By suffix, "module:function" of this package.
FORMATS = {
    ".ibw": "asylum:read_igor",
    ".h5": "nexus:read_hdf5",
    ".hdf5": "nexus:read_hdf5",
    ".sxm": "nanonis:read_scan",
    ".dat": "nanonis_spectrum:read_spectrum",
    ".nc": "gxsm:read_netcdf",
    ".vpdata": "gxsm_spectrum:read_spectrum",
    ".gsf": "gsf:read_field",
    ".nhf": "nanosurf_hdf5:read_nhf",
    ".nid": "nanosurf_nid:read_nid",
    ".tif": "park:read_tiff",
    ".tiff": "park:read_tiff",
}


def read(path: str | Path, *, zone: tzinfo | None = None) -> FileContent:
    """The scans and spectra of a file.

    Asylum (.ibw, NSID .h5), Nanonis (.sxm, .dat), GXSM (.nc, .vpdata), Nanosurf (.nhf, .nid), Park (.tiff),
    Gwyddion's simple fields (.gsf), those of the simulated microscope (.nc), and afspm's own: of the record, and of a
    grid of spectra that was exported (.h5). Of channels of one name, the second is "name #2".

    Args:
        zone: of the clock of the controller, which most write without saying which it was; None: that of this computer.

    Raises:
        FileError: missing, not whole, not what its suffix says, without a reader, or its library is missing.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError("no such file", where=str(path))
    reader = _reader(path.suffix.lower())
    if reader is None:
        raise FileError(
            f"afspm has no reader for {path.suffix or 'a file without a suffix'}",
            where=str(path),
            hint=f"read: {' '.join((*FORMATS, *(f'.{name}' for name in entry_points.names(entry_points.READERS))))}",
        )
    try:
        return _told_apart(reader(path, zone))
    except FileError as error:
        if error.where:
            raise
        raise FileError(error.what, where=str(path), hint=error.hint) from error
    except Exception as error:  # a reader may stumble in any way over a broken file
        why = f"{type(error).__name__}: {error}"
        raise FileError(f"is not readable as {path.suffix}: {why}", where=str(path)) from error


def _reader(suffix: str) -> Reader | None:
    """Return the reader of a suffix, of ours or of an installed package; None if there is none."""
    reader: Reader | None
    if suffix in FORMATS:
        module, _, function = FORMATS[suffix].partition(":")
        reader = getattr(import_module(f"afspm.files.{module}"), function)
    else:
        reader = entry_points.load(entry_points.READERS, suffix.removeprefix("."))
    return reader


def _told_apart(content: FileContent) -> FileContent:
    """With a name of its own for each channel: users may give two signals of a controller the same."""
    taken: set[str] = set()
    scans = []
    for scan in content.scans:
        name, number = scan.channel, 1
        while name in taken:
            number += 1
            name = f"{scan.channel} #{number}"
        taken.add(name)
        scans.append(scan if name == scan.channel else replace(scan, channel=name))
    return replace(content, scans=tuple(scans))
