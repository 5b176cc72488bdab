"""The checks of files that Gwyddion's converter has read, and their times.

The converter keeps neither the angle of a frame nor the sign of y: regions have the size alone, about (0, 0), and what
the metadata state of the place is kept as `stated_place`. Times are read for the modules whose metadata were compared
with files of the maker. Some cut files are converted without an error: the sizes of TIFF and WSxM files are compared
with their headers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import timedelta, timezone, tzinfo
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics.errors import FileError
from afspm.storage.formats.content import FileContent, local_ns


@dataclass(frozen=True)
class _Keys:
    """Names of a module's metadata, in small letters.

    Attributes:
        layout: the form of times, as for `strptime`; the name of a time zone may follow.
        end: end of the scan; without `start` it is the only time, and the maker does not say of what.
        place: all that the frame's place depends on.
    """

    layout: str = ""
    start: str = ""
    end: str = ""
    place: tuple[str, ...] = ()
    direction: str = ""


_KEYS: Final = {
    # the angle is in JPK's files and not in Gwyddion's metadata: turned frames show it by failing to register
    "jpkscan": _Keys("%Y-%m-%d %H:%M:%S.%f", "time start", "time end", ("origin x", "origin y")),
    "mifile": _Keys(
        "%a %b %d %H:%M:%S %Y", "", "date acquired", ("xoffset", "yoffset", "scanangle"), "scanning direction"
    ),
    "nanoscope": _Keys(
        "%I:%M:%S %p %a %b %d %Y", "", "date", ("x offset", "y offset", "rotate ang."), "capture direction"
    ),
    "wsxmfile": _Keys(
        "%d/%m/%Y, %H:%M:%S.%f",
        "",
        "general info::acquisition time",
        ("control::x offset", "control::y offset", "control::angle"),
        "general info::y scanning direction",
    ),
}
_UPWARDS: Final = {"up": True, "bottom to top": True, "down": False, "top to bottom": False}
_ZONE: Final = re.compile(r"(.*\d) ([A-Z]{3,5})")
_HOURS: Final = {"GMT": 0, "UTC": 0, "WET": 0, "CET": 1, "CEST": 2, "EET": 2, "EEST": 3}
"""Hours of time zones ahead of UTC. Other names are left out, since many are ambiguous (BST, CST)."""
_STRIPS, _STRIP_SIZES = 273, 279
_WSXM: Final = re.compile(rb"WSxM file .*\s+.*\s+Image header size: (\d+)\s")
_WSXM_TYPE: Final = "general info::image data type"
_WSXM_BYTES: Final = {"short": 2, "float": 4, "double": 8}
_FORCE_LIST: Final = rb"\*Ciao force image list"
_MOST_EQUAL: Final = 0.1
"""Largest part of an image at its lowest or highest value: all of 60 real channels have less than 0.01; voids 0.89."""


def checked(content: FileContent, module: str, path: Path, zone: tzinfo | None) -> FileContent:
    """Return what the converter made of a file, with its times and its stated place, and more in `left_out`.

    Args:
        module: Gwyddion's name for the module that read the file.
        path: the file before its conversion.

    Raises:
        FileError: the file is cut off.
    """
    meta, keys = {key.casefold(): value.strip() for key, value in content.header.items()}, _KEYS.get(module, _Keys())
    _refuse_cut_off(path, content, meta.get(_WSXM_TYPE, ""))
    left_out = [*content.left_out, *_unmarked(content)]
    if module == "nanoscope" and not content.spectra and _FORCE_LIST in path.read_bytes():
        left_out.append("force curves: Gwyddion's converter does not read them from this file")
    times: list[int | None] = []
    for name in (keys.start, keys.end):
        try:
            times.append(_time_ns(meta[name], keys.layout, zone) if meta.get(name) else None)
        except ValueError as error:
            times.append(None)
            left_out.append(f"{name!r}: {error}")
    is_stated = keys.place and all(name in meta for name in keys.place)
    return replace(
        content,
        start_ns=times[0],
        end_ns=times[1],
        upwards=_UPWARDS.get(meta.get(keys.direction, "").casefold()),
        left_out=tuple(left_out),
        stated_place=", ".join(f"{name} {meta[name]}" for name in keys.place) if is_stated else "",
    )


def _time_ns(text: str, layout: str, zone: tzinfo | None) -> int:
    if (named := _ZONE.fullmatch(text)) is not None:
        if named[2] not in _HOURS:
            raise ValueError(f"the time zone {named[2]} of {text!r} is ambiguous")
        text, zone = named[1], timezone(timedelta(hours=_HOURS[named[2]]))
    return local_ns(text, layout, zone)


def _unmarked(content: FileContent) -> Iterator[str]:
    # Gwyddion gives the lowest value to the voids of some formats, and does not mask them
    for scan in content.scans:
        known = scan.values[np.isfinite(scan.values)]
        if not scan.unit or known.size == 0 or known.min() == known.max():
            continue
        for name, value in (("lowest", known.min()), ("highest", known.max())):
            if (count := int((known == value).sum())) > _MOST_EQUAL * known.size:
                yield f"{scan.channel}: {count} of {known.size} points have its {name} value, and may not be measured"


def _refuse_cut_off(path: Path, content: FileContent, wsxm_type: str) -> None:
    with path.open("rb") as file:
        head = file.read(200)
    size, needed = path.stat().st_size, 0
    if head[:4] in (b"II*\0", b"MM\0*"):
        needed = _end_of_tiff(path)
    elif (wsxm := _WSXM.match(head)) is not None:
        needed = int(wsxm[1]) + _WSXM_BYTES.get(wsxm_type, 0) * sum(scan.values.size for scan in content.scans)
    if size < needed:
        raise FileError(f"is incomplete: it has {size} of {needed} bytes")


def _end_of_tiff(path: Path) -> int:
    # the directories alone: Pillow refuses pictures of modes that Gwyddion knows
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    end, read = 0, set[int]()
    with path.open("rb") as file:
        directory = ImageFileDirectory_v2(file.read(8))
        while directory.next and directory.next not in read:
            read.add(directory.next)
            file.seek(directory.next)
            directory.load(file)
            strips = zip(directory.get(_STRIPS, ()), directory.get(_STRIP_SIZES, ()), strict=True)
            end = max([end, *(at + count for at, count in strips)])
    return end
