"""Tables of measurements: rows by their keys, and spectra as one array."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeVar, overload

from afspm import wire
from afspm.basics import NoSuchItem
from afspm.basics.errors import FileError, WireError
from afspm.basics.plain_data import from_json
from afspm.model import Frame, Parameter, Region, RegistrationOutcome, Spectrum, component_of, names
from afspm.model.caption import value_of
from afspm.model.events import MeasurementSettings
from afspm.night.bad_scans import last_scores
from afspm.night.tables import ScanRow, SpectrumRow, SweptSetting, Table

if TYPE_CHECKING:
    import xarray

    from afspm.model import Scan
    from afspm.night.spectrum_stack import Quantity, SpectrumStack
    from afspm.record import AllowedBands
    from afspm.record.instrument_values import RecordedReadings

_log = logging.getLogger("afspm.record")
R = TypeVar("R", ScanRow, SpectrumRow)
Row = tuple[Any, ...]
"""A row of a table in SQLite."""
Query = Callable[[str], list[Row]]

_PUBLISHED = {
    "scans": "SELECT scan, min(time_ns) FROM packets WHERE message = 'Scan2d' GROUP BY scan",
    "spectra": "SELECT spectrum, min(time_ns) FROM packets WHERE message = 'Spec1d' GROUP BY spectrum",
}
_ACTIONS = {"scans": names.START_SCAN, "spectra": names.START_SPEC}
_HAS_STARTS = "SELECT 1 FROM sqlite_master WHERE name = 'starts'"


class KeyedTable(Table[R]):
    """Rows of measurements; `table["tile-1"]` is the last row with that key."""

    @overload
    def __getitem__(self, index: int | str) -> R: ...
    @overload
    def __getitem__(self, index: slice) -> KeyedTable[R]: ...
    def __getitem__(self, index: int | str | slice) -> R | KeyedTable[R]:
        if isinstance(index, str):
            return self._last_with_key(index)
        return self._with(self._rows[index]) if isinstance(index, slice) else self._rows[index]

    def where(self, wanted: Callable[[R], bool]) -> KeyedTable[R]:
        """Return the rows for which `wanted` returns True."""
        return self._with(row for row in self._rows if wanted(row))

    def _last_with_key(self, key: str) -> R:
        # the last one: earlier attempts of this key were interrupted
        attempts = [row for row in self._rows if row.key == key]
        if not attempts:
            known = dict.fromkeys(row.key for row in self._rows if row.key)
            raise NoSuchItem(f"no key {key!r}; {_describe_keys(list(known))}")
        return attempts[-1]

    def _with(self, rows: Iterable[R]) -> KeyedTable[R]:
        return KeyedTable(rows, self._kind)


class SpectrumTable(KeyedTable[SpectrumRow]):
    """Rows of spectra, with access to their curves."""

    def __init__(self, rows: Iterable[SpectrumRow], read: Callable[[SpectrumRow], Spectrum]) -> None:
        super().__init__(rows, SpectrumRow)
        self._read = read

    def stack(self, *, interpolate: bool = False) -> xarray.Dataset:
        """Return the curves of a grid as arrays over (y, x, repeat, direction, z) (needs the extra `xarray`).

        x and y are along the sides of the grid, in m; `angle_rad` and `frame` are in the attributes. z is the swept
        variable: its name and unit are in the attributes of the coordinate. Variables with a retrace ("Current
        Retrace") have both directions. NaN where nothing was measured, or where a file is missing or damaged.

        Args:
            interpolate: resample curves with different sweeps, such as force curves that begin at the surface, to
                common values (evenly spaced, linear between measured points).

        Raises:
            InvalidValue: these spectra do not form a grid, or were measured differently.
            FileError: no file can be read.
        """
        return self._stacked(interpolate=interpolate).to_xarray()

    def map(
        self,
        quantity: Quantity,
        at: float | None = None,
        *,
        unit: str = "",
        direction: str = "forward",
        name: str = "",
    ) -> Scan:
        """Return a map of a quantity over the grid, as a scan with one channel: the mean over repeats.

            run.spectra.map("current", at=0.5).plot()
            run.spectra.map(lambda spectrum: spectrum["Current"].max(), unit="A", name="largest current")

        Args:
            quantity: what a variable measures, such as "current" or "current, retrace", or its name, read at one value
                of the sweep; or a function of one spectrum that returns a number.
            at: the value of the sweep: in SI for a measured quantity, in the unit of the sweep for a name.
            unit: the unit of the function's result.
            direction: "forward" or "backward" along the sweep.
            name: the channel of the map; by default derived from the variable or the function.

        Raises:
            InvalidValue: these spectra do not form a grid of at least two by two, the quantity was not measured, or
                `at` is missing or outside the sweep.
            FileError: no file can be read.
        """
        from afspm.night.spectrum_stack import map_of

        return map_of(self._readable(), quantity, at, unit, direction, name)

    def _stacked(self, *, interpolate: bool) -> SpectrumStack:
        from afspm.night.spectrum_stack import stacked

        return stacked(self._readable(), interpolate=interpolate)

    def _readable(self) -> list[Spectrum]:
        # a missing or damaged file costs its own point of the grid
        found, failed = list[Spectrum](), None
        for row in self._rows:
            try:
                found.append(self._read(row))
            except FileError as error:
                _log.warning("spectrum %d is left out: %s", row.number, error)
                failed = error
        if failed is not None and not found:
            raise failed
        return found

    def where(self, wanted: Callable[[SpectrumRow], bool]) -> SpectrumTable:
        return self._with(row for row in self._rows if wanted(row))

    @overload
    def __getitem__(self, index: int | str) -> SpectrumRow: ...
    @overload
    def __getitem__(self, index: slice) -> SpectrumTable: ...
    def __getitem__(self, index: int | str | slice) -> SpectrumRow | SpectrumTable:
        return self._with(self._rows[index]) if isinstance(index, slice) else super().__getitem__(index)

    def _with(self, rows: Iterable[SpectrumRow]) -> SpectrumTable:
        return SpectrumTable(rows, self._read)


def read_scans(
    query: Query, verdicts: Iterable[tuple[int, float]], readings: RecordedReadings, bands: AllowedBands
) -> KeyedTable[ScanRow]:
    rows_of_scans = query("SELECT * FROM scans ORDER BY number")
    keys = _keys(query, "scans", rows_of_scans)
    positions = _positions(query)
    scores = last_scores((row[1] for row in rows_of_scans), verdicts)
    rows = []
    for row in rows_of_scans:
        registration, sd_m = positions.get(row[0], (None, None))
        rows.append(scan_row(row, keys.get(row[0], ""), registration, sd_m, scores.get(row[1])))
    rows = _in_force(query, _with_instruments(query, "scans", rows, readings, bands))
    return KeyedTable(_with_settings(query, "scans", rows), ScanRow)


def read_spectra(
    query: Query, read: Callable[[SpectrumRow], Spectrum], readings: RecordedReadings, bands: AllowedBands
) -> SpectrumTable:
    rows_of_spectra = query("SELECT * FROM spectra ORDER BY number")
    keys = _keys(query, "spectra", rows_of_spectra)
    rows = [spectrum_row(row, keys.get(row[0], "")) for row in rows_of_spectra]
    rows = _in_force(query, _with_instruments(query, "spectra", rows, readings, bands))
    return SpectrumTable(_with_settings(query, "spectra", rows), read)


def _keys(query: Query, table: str, rows: Sequence[Row]) -> dict[int, str]:
    # the log has no link from a request to its measurement: each start belongs to the next published measurement
    starts = query(f"SELECT sent_ns, key FROM starts WHERE action = '{_ACTIONS[table]}'") if query(_HAS_STARTS) else []
    if not any(key for _, key in starts):
        return {}
    published: dict[int, int] = dict(query(_PUBLISHED[table]))
    ends = sorted((published.get(number, time_ns), number) for number, time_ns, *_ in rows)
    keys: dict[int, str] = {}
    waiting = sorted(starts, key=itemgetter(0), reverse=True)
    for end_ns, number in ends:
        while waiting and waiting[-1][0] <= end_ns:
            keys[number] = waiting.pop()[1]  # the last start counts: earlier starts had no result
    return keys


def _positions(query: Query) -> dict[int, tuple[RegistrationOutcome, float | None]]:
    # the mapping of a scan is published just before the scan
    mappings = query("SELECT time_ns, payload FROM packets WHERE message = 'DriftMapping' ORDER BY time_ns DESC")
    if not mappings:
        return {}
    knowledge, after_ns = {}, -1
    from afspm.record import drift_knowledge

    for number, published_ns in sorted(query(_PUBLISHED["scans"]), key=itemgetter(1)):
        payload = None
        while mappings and mappings[-1][0] <= published_ns:
            time_ns, newest = mappings.pop()
            payload = newest if time_ns > after_ns else payload
        after_ns = published_ns
        if number is not None and payload is not None:
            with suppress(WireError):  # another implementation may encode the mapping differently
                knowledge[number] = drift_knowledge(wire.decode("DriftMapping", payload))
    return knowledge


def _with_settings(query: Query, table: str, rows: list[R]) -> list[R]:
    # the settings that the same component published last before the end of each measurement
    published = query(
        "SELECT time_ns, payload FROM packets WHERE message = 'MeasurementSettings' ORDER BY time_ns DESC"
    )
    if not published:
        return rows
    ends: dict[int, int] = dict(query(_PUBLISHED[table]))
    by_hand = _changed_by_hand(query)
    newest: dict[str, tuple[int, MeasurementSettings]] = {}
    made: dict[int, R] = {}
    for end_ns, row in sorted(((ends.get(row.number, row.time_ns), row) for row in rows), key=itemgetter(0)):
        while published and published[-1][0] <= end_ns:
            with suppress(WireError):  # of a newer version
                set_ns, payload = published.pop()
                settings = wire.decode("MeasurementSettings", payload)
                newest[settings.who] = set_ns, settings
        set_ns, settings = newest.get(component_of(row.holder or ""), (0, None))
        if settings is not None and settings.key in ("", row.key):
            changed = {name for at_ns, name in by_hand if set_ns < at_ns <= end_ns}
            swept = tuple(_swept(one) for one in settings.parameters if one.name not in changed)
            made[row.number] = replace(row, settings=swept, point=settings.point)
    return [made.get(row.number, row) for row in rows]


def _in_force(query: Query, rows: list[R]) -> list[R]:
    from afspm.record.provenance import setpoint_in_force

    conditions = [one for _, one in _messages(query, "MeasurementConditions")]
    by_time = {one.time_ns: one for one in conditions}
    by_file = {one.filename: one for one in conditions if one.filename}
    feedback, units = _messages(query, "ZCtrlParameters"), _messages(query, "ZCtrlUnits")
    made = []
    for row in rows:
        of_it = by_time.get(row.time_ns) or by_file.get(row.filename)
        found = () if of_it is None else of_it.in_force
        if not found and row.began_ns is not None:
            found = setpoint_in_force(_latest(feedback, row.began_ns), _latest(units, row.began_ns))
        made.append(replace(row, in_force=found))
    return made


def _messages(query: Query, message: str) -> list[tuple[int, Any]]:
    found = []
    for time_ns, payload in query(f"SELECT time_ns, payload FROM packets WHERE message = '{message}' ORDER BY time_ns"):
        with suppress(WireError):  # of a newer version
            found.append((time_ns, wire.decode(message, payload)))
    return found


def _latest(messages: list[tuple[int, Any]], time_ns: int) -> object:
    at = bisect_right(messages, time_ns, key=itemgetter(0))
    return messages[at - 1][1] if at else None


def _changed_by_hand(query: Query) -> list[tuple[int, str]]:
    acts = []
    for time_ns, payload in query("SELECT time_ns, payload FROM packets WHERE message = 'ActByHand'"):
        with suppress(WireError):
            acts.append((time_ns, wire.decode("ActByHand", payload)))
    changed = [(time_ns, change.parameter) for time_ns, act in acts for change in act.changes]
    of_bias = (names.TIP_BIAS_VOLTAGE, names.SAMPLE_BIAS)
    return changed + [(time_ns, names.BIAS_OF_SAMPLE) for time_ns, name in changed if name in of_bias]


def _with_instruments(
    query: Query, table: str, rows: list[R], readings: RecordedReadings, bands: AllowedBands
) -> list[R]:
    readings.read_on(query)
    if not readings.of:
        return rows
    # by the time of publication, as in the files: it has the clock of the readings
    published: dict[int, int] = dict(query(_PUBLISHED[table]))
    made = []
    for row in rows:
        end_ns = published.get(row.number, row.time_ns)
        values = readings.values(end_ns, row.began_ns, bands, _ACTIONS[table])
        outside = tuple(dict.fromkeys(name for one in values for name in one.outside))
        made.append(replace(row, instruments=values, outside=outside))
    return made


def _swept(parameter: Parameter) -> SweptSetting:
    return SweptSetting(parameter.name, *value_of(parameter))


def _describe_keys(keys: Sequence[str]) -> str:
    if not keys:
        return "nothing was measured under a key"
    return f"there are {', '.join(keys[:20])}{' …' if len(keys) > 20 else ''}"


@lru_cache(maxsize=64)
def _listed(text: str) -> tuple[Any, ...]:
    # the rows of a night repeat a few texts
    return tuple(tuple(one) if isinstance(one, list) else one for one in from_json(text))


def scan_row(
    row: Row,
    key: str = "",
    registration: RegistrationOutcome | None = None,
    position_sd_m: float | None = None,
    tip_score: float | None = None,
) -> ScanRow:
    (
        number, time_ns, began_ns, filename, file, interrupted, x, y, width, height, angle, frame, rows, columns,
        channels, holder, mode, problems,
    ) = row  # fmt: skip
    region = None if frame is None else Region((x, y), (width, height), angle, Frame(frame))
    return ScanRow(
        number,
        time_ns,
        began_ns,
        _listed(channels),
        region,
        None if rows is None else (rows, columns),
        bool(interrupted),
        holder,
        mode,
        _listed(problems),
        filename,
        file,
        key,
        registration,
        position_sd_m,
        tip_score=tip_score,
    )


def spectrum_row(row: Row, key: str = "") -> SpectrumRow:
    (
        number, time_ns, began_ns, filename, file, kind, x, y, frame, points, names, units, holder, mode, problems,
    ) = row  # fmt: skip
    return SpectrumRow(
        number,
        time_ns,
        began_ns,
        kind,
        None if x is None else (x, y),
        Frame(frame),
        points,
        _listed(names),
        _listed(units),
        holder,
        mode,
        _listed(problems),
        filename,
        file,
        key,
    )
