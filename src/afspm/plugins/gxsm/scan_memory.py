"""GXSM's memory of a scan: lines of the running scan, and the check for completeness.

GXSM keeps the values of the previous scan in rows not yet scanned, and does not mark new rows. A complete scan has
rewritten the first and the last row of each channel; a stopped scan has left at least one of both bit-identical. A scan
of a part of the columns (*SubScan*) has left the first or the last columns of these rows bit-identical.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from typing import TypedDict

import numpy as np

from afspm.driver import FileContent
from afspm.model import Region, ScanLines
from afspm.plugins.gxsm.link import Asking
from afspm.plugins.gxsm.settings import ANGSTROM_M

_CONSTANT = "="
_FIRST_LAYER, _NO_TIME = 0, -1
"""Arguments of `get_slice`. With a time of 0 or more, Gxsm4 copies that picture of a *Movie* over its memory, with its
size and in the caller's thread, and ends with a segmentation fault if a scan of another size runs. Gxsm3 ignores both
arguments."""
_EDGE = 8
"""Compared columns at either end of a row: fewer agree by chance if a signal flickers between two values."""
_MOST = 1 << 20


class Rows(TypedDict):
    """Digests of a few rows of GXSM's memory, JSON-able.

    Attributes:
        columns: number of compared columns.
        digests: by channel and row, the digests of the whole row, of its first and of its last columns. The digest of
            constant values, which proves nothing, starts with "=".
    """

    columns: int
    digests: dict[str, dict[str, list[str]]]


def looked_at(ask: Asking, channels: int, rows: Collection[int], columns: int) -> Rows:
    """Return the digests of rows in GXSM's memory; rows and channels that the memory lacks are left out.

    Args:
        channels: number of channels, from 0 on.
        columns: highest number of compared columns; the previous scan may have fewer.
    """
    facts = {channel: (ask.call("get_dimensions", channel), _factor(ask, channel)) for channel in range(channels)}
    there = {channel: (shape, dz) for channel, (shape, dz) in facts.items() if dz and _is_shape(shape)}
    columns = min([columns, *(shape[0] for shape, _ in there.values())])
    return Rows(
        columns=columns,
        digests={
            str(channel): {
                str(row): _digests(values.ravel()[:columns] / dz)
                for row in rows
                if row < shape[1] and isinstance(values := _slice(ask, channel, row, 1), np.ndarray) and values.size
            }
            for channel, (shape, dz) in there.items()
        },
    )


def has_layers(ask: Asking) -> bool:
    """Return whether the first channel has several layers, as *Multi Layer* makes them."""
    shape = ask.call("get_dimensions", 0)
    return isinstance(shape, tuple | list) and _is_shape(shape) and shape[2] > 1


def in_files(files: Mapping[int, FileContent], like: Rows) -> Rows:
    """Return the digests of the rows and channels in `like`, from files by channel number."""
    return Rows(
        columns=like["columns"],
        digests={
            channel: {
                row: _digests(stored(files[int(channel)])[int(row)][: like["columns"]])
                for row in rows
                if int(row) < len(files[int(channel)].scans[0].values)
            }
            for channel, rows in like["digests"].items()
            if int(channel) in files
        },
    )


def stored(file: FileContent) -> np.ndarray:
    """Return the values of a file as in GXSM's memory: rows from the top, without its factor `dz`."""
    scan, dz = file.scans[0], float(str(file.header["dz"]))
    return scan.values[::-1] / (ANGSTROM_M if scan.unit == "m" else 1.0) / dz


def only(rows: Rows, *numbers: int) -> Rows:
    """Return the digests of some rows, by their numbers."""
    digests = {
        channel: {str(row): there[str(row)] for row in numbers if str(row) in there}
        for channel, there in rows["digests"].items()
    }
    return Rows(columns=rows["columns"], digests=digests)


def has_new_row(before: Rows, after: Rows) -> bool:
    """Return True if any of these rows was scanned, in any channel."""
    return any(
        row in (now := after["digests"].get(channel, {})) and now[row][0] != digests[0]
        for channel, rows in before["digests"].items()
        for row, digests in rows.items()
    )


def is_unfinished(before: Rows, after: Rows) -> bool:
    """Return True if unchanged rows prove that a scan was stopped or never started.

    A channel without any changed row counts as a constant signal if another channel has changed.
    """
    changed = unchanged = False
    for channel, rows in before["digests"].items():
        now = after["digests"].get(channel, {})
        is_new = any(now.get(row, [""])[0] != digests[0] for row, digests in rows.items())
        is_old = any(
            now.get(row, [""])[0] == digests[0] for row, digests in rows.items() if not digests[0].startswith(_CONSTANT)
        )
        if is_new and is_old:
            return True
        changed, unchanged = changed or is_new, unchanged or is_old
    return unchanged and not changed


def is_partly_whole(before: Rows, after: Rows) -> bool:
    """Return True if a channel has all these rows changed: then the scan has come to its end."""
    return any(
        bool(rows)
        and all(after["digests"].get(channel, {}).get(row, digests)[0] != digests[0] for row, digests in rows.items())
        for channel, rows in before["digests"].items()
    )


def has_old_columns(before: Rows, after: Rows) -> bool:
    """Return True if the first or the last columns of all changed rows hold the previous scan, in each channel."""
    changed = [
        (digests, now[row])
        for channel, rows in before["digests"].items()
        for row, digests in rows.items()
        if row in (now := after["digests"].get(channel, {})) and now[row][0] != digests[0]
    ]
    for edge in (1, 2):
        proofs = [(then[edge], now[edge]) for then, now in changed if not then[edge].startswith(_CONSTANT)]
        if proofs and all(then == now for then, now in proofs):
            return True
    return False


def _slice(ask: Asking, channel: int, row: int, count: int) -> object:
    return ask.call("get_slice", channel, _FIRST_LAYER, _NO_TIME, row, count)


def _digests(stored: np.ndarray) -> list[str]:
    # Of stored values, without dz: GXSM may change dz between two scans.
    values = stored.astype(np.float32)
    edge = min(_EDGE, len(values))
    return [_digest(part) for part in (values, values[:edge], values[-edge:])]


def _digest(values: np.ndarray) -> str:
    kind = _CONSTANT if (values == values[0]).all() else ""
    return kind + hashlib.blake2b(values.tobytes(), digest_size=12).hexdigest()


def _is_shape(found: object) -> bool:
    if not (isinstance(found, tuple | list) and len(found) == 4 and all(isinstance(one, int | float) for one in found)):
        return False
    return bool(0 < found[0] < _MOST)  # without a scan GXSM reports 4294967295


def _factor(ask: Asking, channel: int) -> float:
    found = ask.call("get_differentials", channel)
    return float(found[2]) if isinstance(found, tuple | list) and len(found) == 4 else 0.0


def new_lines(
    ask: Asking,
    endings: Sequence[str],
    known: Mapping[str, Sequence[str]],
    taken: tuple[Region, tuple[int, int]],
    start: int,
    done: int,
) -> list[ScanLines]:
    """Return the lines from `start` up to but not including `done`, counted from the top row, of each known channel.

    GXSM's memory has neither names nor units of channels: names and units come from the files of an earlier scan.

    Args:
        endings: endings of the channels' files, by channel number.
        known: name and unit of a channel, by file ending.
        taken: frame of the running scan, and (rows, columns).
    """
    region, shape = taken
    count = min(done, shape[0]) - start
    if count < 1:
        return []
    images: dict[str, np.ndarray] = {}
    for channel, ending in enumerate(endings):
        if ending in known:
            found = _slice(ask, channel, start, count)
            # another shape: the frame was changed at the panel, and the recorded shape is not this scan's
            if isinstance(found, np.ndarray) and found.shape == (count, shape[1]):
                images[ending] = found.astype(np.float64)
    lines = []
    for ending, image in images.items():
        name, unit = known[ending]
        rows = image[::-1] * (ANGSTROM_M if unit == "m" else 1.0)
        lines.append(ScanLines(region, shape, name, unit, shape[0] - start - count, rows))
    return lines
