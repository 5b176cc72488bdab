"""Scans and spectra that Nanonis has not saved: fetched over TCP, and written to files by the translator."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics import ConfigError, FileError
from afspm.components import write_atomic
from afspm.driver import FileFacts, encode_scan, encode_spectrum
from afspm.model import Region, Scan, ScanLines, Spectrum
from afspm.plugins.nanonis.parameter_groups import Ask
from afspm.plugins.nanonis.protocol import UnreadableReply
from afspm.plugins.nanonis.session import CurveEnded

ROWS: Final = ("top-first", "recorded")
BACKWARD: Final = ("mirrored", "as-seen")
_FORWARD, _BACKWARD = 1, 0
_UP: Final = 1


@dataclass(frozen=True)
class Grabbing:
    """The layout of images from Nanonis' memory, which the maker's specification does not define.

    Attributes:
        rows: "top-first": the top row first in both scan directions; "recorded": upward scans lowest row first.
        backward: "mirrored": backward lines run from right to left; "as-seen": from left to right.
    """

    rows: str = "top-first"
    backward: str = "mirrored"

    def __post_init__(self) -> None:
        for name, value, choices in (("rows", self.rows, ROWS), ("backward", self.backward, BACKWARD)):
            if value not in choices:
                raise ConfigError(
                    f"unknown value {value!r}", where=f"grabbed_{name}", hint=f"one of {', '.join(choices)}"
                )

    def image(self, raw: np.ndarray, *, upwards: bool, backward: bool) -> np.ndarray:
        """Return the image [y, x] with both axes ascending."""
        # (! grabbed-rows, grabbed-backward)
        rows = raw if self.rows == "recorded" and upwards else raw[::-1]
        pixels = rows[:, ::-1] if backward and self.backward == "mirrored" else rows
        return np.ascontiguousarray(pixels, dtype=np.float64)


@dataclass(frozen=True)
class Image:
    """One channel of the scan in Nanonis' memory.

    Attributes:
        name: channel and direction as in Nanonis' files, e.g. "Z Forward".
        values: [y, x], both ascending; lines not scanned are NaN.
        upwards: True if the lowest row was scanned first.
    """

    name: str
    unit: str
    values: np.ndarray
    upwards: bool


def images(ask: Ask, how: Grabbing, leave_out: Callable[[str, UnreadableReply], None]) -> list[Image]:
    """Fetch all channels of the scan in Nanonis' memory, forward and backward.

    Args:
        leave_out: called with the name of each channel that is chosen and not recorded, whose answer has another
            layout. (! unrecorded-channel)

    Raises:
        UnreadableReply: no channel can be read.
    """
    signals = ask("Signals.NamesGet")[0]
    found, left_out = list[Image](), dict[str, UnreadableReply]()
    for channel in ask("Scan.BufferGet")[0]:
        name, unit = name_and_unit(signals[channel] if 0 <= channel < len(signals) else f"channel {channel}")
        try:
            grabbed = [ask("Scan.FrameDataGrab", channel, number) for number in (_FORWARD, _BACKWARD)]
        except UnreadableReply as error:
            left_out[name] = error
            continue
        for way, (_, raw, direction) in zip(("Forward", "Backward"), grabbed, strict=True):
            upwards = direction == _UP
            values = how.image(raw, upwards=upwards, backward=way == "Backward")
            found.append(Image(f"{name.replace(' ', '_')} {way}", unit, values, upwards))
    for name, why in left_out.items():
        if not found:  # of a scan that is wholly unreadable, no single channel is the cause
            raise why
        leave_out(name, why)
    return unscanned_as_nan(found)


def unscanned_as_nan(found: list[Image]) -> list[Image]:
    """Return images in which rows not yet scanned are NaN: of real instruments both NaN and zeros are reported.

    Zeros in all channels and both directions are not scanned where they reach the end of the scan. No controller
    measures an exact zero in every pixel of every channel, so a frame of zeros alone was stopped within its first line.
    """
    if not found or len({(image.values.shape, image.upwards) for image in found}) > 1:
        return found  # the channels are fetched one after the other, and a person may have changed the frame
    upwards = found[0].upwards
    stack = np.stack([image.values if upwards else image.values[::-1] for image in found])  # rows in scanning order
    empty = (np.nan_to_num(stack) == 0.0).all(axis=(0, 2))
    if empty.all():
        return [replace(image, values=np.full_like(image.values, np.nan)) for image in found]
    last = int(np.flatnonzero(~empty)[-1])
    stack[:, last + 1 :] = np.nan
    for way in ("Forward", "Backward"):  # of the row that is being scanned, the rest is zero too
        of_way = [k for k, image in enumerate(found) if image.name.endswith(way)]
        rest = (stack[of_way, last] == 0.0).all(axis=0) & (last + 1 < len(empty))
        stack[of_way, last] = np.where(rest, np.nan, stack[of_way, last])
    stack = stack if upwards else stack[:, ::-1]
    return [replace(image, values=values) for image, values in zip(found, stack, strict=True)]


def new_lines(found: Sequence[Image], region: Region, start: int) -> list[ScanLines]:
    """Return the complete lines of each channel after the first `start` lines, counted in scanning order."""
    lines = []
    # Lines not yet scanned are NaN; the channels, fetched one after the other, may differ by the present line.
    done = min((int(np.isfinite(image.values).all(axis=1).sum()) for image in found), default=0)
    if not any(image.values.any() for image in found):
        return []  # zeros alone: no line is scanned yet
    for image in found if done > start else ():
        shape = (image.values.shape[0], image.values.shape[1])
        first = start if image.upwards else shape[0] - done
        rows = image.values[first : first + done - start]
        lines.append(ScanLines(region, shape, image.name, image.unit, first, rows))
    return lines


def spectrum(curve: CurveEnded, kind: str, position_m: tuple[float, float]) -> Spectrum:
    """Convert the data of an ended spectrum. Raises FileError: names and values don't fit together."""
    if not curve.names or curve.values.shape[0] != len(curve.names):
        raise FileError(f"a spectrum of {len(curve.names)} channels with {curve.values.shape[0]} rows of values")
    values = np.array(curve.values.T, dtype=np.float64)
    # (! curve-backward) points of the way back are taken as they come
    columns, units = zip(*map(name_and_unit, curve.names), strict=True)
    return Spectrum(position_m, kind, columns, units, values)


def name_and_unit(text: str) -> tuple[str, str]:
    """Split "Current (A)" into name and unit; without parentheses, the unit is empty."""
    unit = re.search(r" ?\(([^()]*)\)", text)
    return (text, "") if unit is None else ((text[: unit.start()] + text[unit.end() :]).strip(), unit[1])


def write(path: Path, content: Sequence[Scan | Spectrum], end_ns: int) -> None:
    """Write all channels of one scan, or one spectrum, to a file for `afspm.storage.formats.read`."""
    facts = FileFacts(end_ns, {})
    one = content[0]
    if isinstance(one, Spectrum):
        encoded = encode_spectrum(one, facts)
    else:
        scans = [scan for scan in content if isinstance(scan, Scan)]
        names = [scan.channel for scan in scans]
        unique = (name if name not in names[:k] else f"{name} #{k + 1}" for k, name in enumerate(names))
        by_name = dict(zip(unique, scans, strict=True))
        channels = {name: (scan.unit, scan.values) for name, scan in by_name.items()}
        encoded = encode_scan(one.region, channels, facts, {name: scan.roles for name, scan in by_name.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, [encoded])
