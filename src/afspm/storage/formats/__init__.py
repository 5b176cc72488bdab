"""Readers of the controllers' files. Each format is a module; libraries are imported only when needed.

    from afspm.storage.formats import read
    content = read("scan0001.ibw")
    content.scans[0].values      # [y, x], both ascending

A reader is a function from a path and a time zone to a `FileContent`. Packages declare readers by the suffixes of their
files (`afspm.basics.entry_points`).

The readers stand below the record, since the translator reads each scan's file: with the readers in `record` it would
import the journal, the report and the exports for one function. Only the reader of the record's own files is there,
beside its writer, so that a change of that format is made in one room.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import tzinfo
from pathlib import Path

from afspm.basics import entry_points
from afspm.basics.argument_checks import PATH, checked
from afspm.basics.errors import ConfigError, FileError
from afspm.storage.formats.content import FileContent, OtherFormat

__all__ = ["FileContent", "OtherFormat", "read", "suffixes"]


_log = logging.getLogger("afspm.storage")
_GUESSED = re.compile("[\x81\x8d\x8f\x90\x9d\ufffd]")
"""Characters that only a text of another encoding than UTF-8 and cp1252 has, see `text_of`."""
_ANY = "*"
"""The suffix of readers that try the files of all others."""
Reader = Callable[[Path, tzinfo | None], FileContent]


def suffixes() -> tuple[str, ...]:
    """Return the suffixes of readable files, with their dots, except suffixes that only a converter reads."""
    names = (name.partition(".")[0] for name in entry_points.names(entry_points.READERS))
    return tuple(dict.fromkeys(f".{name}" for name in names if name != _ANY))


@checked({"path": PATH})
def read(path: str | Path, *, zone: tzinfo | None = None) -> FileContent:
    """Return the scans and spectra of a file.

    The suffix of the file selects the reader: of a maker's format, of Gwyddion's simple fields (.gsf), or of NeXus
    (.h5, .nxs), be it afspm's record, an exported grid of spectra or the file of another program. `afspm doctor`
    lists the suffixes. Gwyddion's converter, if it is installed (`afspm[formats]`), reads some 170 further formats. If
    two channels have the same name, the second becomes "name #2". What a file has and the reader leaves out is logged
    as a warning, and stands in `left_out`.

    Args:
        zone: time zone of the controller's clock, which most files do not state; None: the zone of this computer.

    Raises:
        FileError: the file is missing, incomplete or in another format, or there is no reader or library for it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError("no such file", where=str(path), hint="a relative path begins in the current folder")
    try:
        found = _with_unique_channels(_first_that_reads(path, zone))
        found = replace(found, left_out=(*found.left_out, *_unreadable_texts(found)))
        for one in found.left_out:
            _log.warning("%s: left out: %s", path, one)
        return found
    except FileError as error:
        if error.where:
            raise
        raise FileError(error.what, where=str(path), hint=error.hint) from error
    except Exception as error:  # on a damaged file a reader may raise errors of any type
        why = f"{type(error).__name__}: {error}"
        raise FileError(f"is not readable as {path.suffix}: {why}", where=str(path)) from error


def _first_that_reads(path: Path, zone: tzinfo | None) -> FileContent:
    # makers share suffixes (.nc, .h5, .tif): the readers take turns, and one that does not know the file raises
    # OtherFormat. A question beforehand ("is it yours?") would open the file twice.
    own = _readers(path.suffix.lower().removeprefix("."))
    refusals: list[OtherFormat] = []
    unusable: list[ConfigError] = []
    for name in (*own, *_readers(_ANY)):
        try:
            reader: Reader = entry_points.load(entry_points.READERS, name)
        except ConfigError as error:  # a broken package, or two with one name: the other readers of the suffix go on
            unusable.append(error)
            continue
        try:
            return reader(path, zone)
        except OtherFormat as error:
            refusals.append(error)
    if unusable:  # the file may be of this reader
        raise FileError(unusable[0].what, hint=unusable[0].hint or "mend or uninstall the package")
    # what the last reader of the suffix says is closer to the truth than what a converter says; but the file may be of
    # a third maker with this suffix, and then the converter's reason is the true one
    nearest, last = refusals[max(len(own) - 1, 0)], refusals[-1]
    if nearest is last or last.hint:  # with a hint the converter is not installed, and has tried nothing
        raise nearest
    raise OtherFormat(f"{nearest.what}; it {last.what}", hint=nearest.hint)


def _readers(suffix: str) -> list[str]:
    return [name for name in entry_points.names(entry_points.READERS) if name.partition(".")[0] == suffix]


def _with_unique_channels(content: FileContent) -> FileContent:
    # users may give two signals of a controller the same name
    names = _unique([scan.channel for scan in content.scans])
    scans = (replace(scan, channel=name) for scan, name in zip(content.scans, names, strict=True))
    spectra = (replace(spectrum, names=_unique(spectrum.names)) for spectrum in content.spectra)
    return replace(content, scans=tuple(scans), spectra=tuple(spectra))


def _unreadable_texts(content: FileContent) -> list[str]:
    texts = {**content.header, **{scan.channel: scan.channel for scan in content.scans}}
    guessed = [str(name) for name, text in texts.items() if isinstance(text, str) and _GUESSED.search(text)]
    return [f"characters of {', '.join(guessed)}: in neither UTF-8 nor cp1252"] if guessed else []


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    taken: dict[str, None] = {}
    for first in names:
        name, number = first, 1
        while name in taken:
            number += 1
            name = f"{first} #{number}"
        taken[name] = None
    return tuple(taken)
