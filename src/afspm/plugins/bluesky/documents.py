"""A run as documents of Bluesky's event model: start, descriptors with events, stop.

Each group of measurements with equal arrays has one descriptor. Values stay in the files of the record;
StreamResource and StreamDatum point to them. Identifiers follow from the run, so that the same run always gives the
same documents.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from uuid import NAMESPACE_URL, uuid5

from afspm import Run
from afspm.basics import NS_PER_S, FileError
from afspm.driver import hdf5_reading
from afspm.night import ScanRow, SpectrumRow
from afspm.record import field_names, measured_file

Document = tuple[str, dict[str, object]]
"""A document: its name and content."""
DOCUMENTS_FILE = "documents.jsonl"
_REGION = {"center_x": "m", "center_y": "m", "size_x": "m", "size_y": "m", "angle": "rad"}
_POSITION = {"x": "m", "y": "m"}
_KEY, _INTERRUPTED = "key", "interrupted"


def tables(run: Run, scans: Sequence[ScanRow], spectra: Sequence[SpectrumRow]) -> Iterator[tuple[str, bytes]]:
    """Yield the file of all documents, one JSON line [name, document] each."""
    lines = (json.dumps(document, ensure_ascii=False) for document in documents(run, scans, spectra))
    yield DOCUMENTS_FILE, "".join(f"{line}\n" for line in lines).encode()


def write(run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
    """Yield nothing: the documents point to the files of the record. Raises FileError: such a file can't be read."""
    run.about(row)
    yield from ()


def documents(run: Run, scans: Iterable[ScanRow], spectra: Iterable[SpectrumRow]) -> Iterator[Document]:
    """Yield the documents of a run in the order of time."""
    rows: list[ScanRow | SpectrumRow] = sorted([*scans, *spectra], key=lambda row: row.time_ns)
    began_ns = rows[0].began_ns or rows[0].time_ns if rows else run.newest_ns
    start = _uid(run, "start")
    yield "start", _start(run, start, began_ns)
    streams: dict[tuple[object, ...], _Stream] = {}
    for row in rows:
        types = _types(run, row)
        stream = streams.get((*_alike(row), types))
        if stream is None:
            count = sum(type(row) is type(one.first) for one in streams.values())
            name = ("scans" if isinstance(row, ScanRow) else "spectra") + (f"_{count + 1}" if count else "")
            stream = streams[*_alike(row), types] = _Stream(run, start, name, row, types)
            yield "descriptor", stream.descriptor()
        yield from stream.event(row)
    counts = {stream.name: stream.count for stream in streams.values()}
    yield "stop", _stop(run, start, counts)


def _start(run: Run, uid: str, began_ns: int) -> dict[str, object]:
    metadata = run.metadata
    known = {"sample": metadata.get("sample"), "project": metadata.get("project"), "owner": metadata.get("person")}
    return {
        "uid": uid,
        "time": began_ns / NS_PER_S,
        "plan_name": run.name,
        "afspm": {"run": run.folder.name, "simulated": run.simulated, **metadata},
        **{name: value for name, value in known.items() if value},
    }


def _stop(run: Run, start: str, counts: Mapping[str, int]) -> dict[str, object]:
    ended = run.facts.get("how") == "experiment_ended"
    return {
        "uid": _uid(run, "stop"),
        "time": run.newest_ns / NS_PER_S,
        "run_start": start,
        "exit_status": "success" if ended else "abort",
        "reason": str(run.facts.get("ended") or ""),
        "num_events": dict(counts),
    }


def _alike(row: ScanRow | SpectrumRow) -> tuple[object, ...]:
    # the arrays of one stream must have the same shape, and the same type
    if isinstance(row, ScanRow):
        return "scan", row.channels, row.shape
    return "spectrum", row.kind, row.names, row.points


def _types(run: Run, row: ScanRow | SpectrumRow) -> tuple[str, ...]:
    # the record keeps the channels of a scan in single precision if that is exact
    if not isinstance(row, ScanRow):
        return ("<f8",) * len(row.names)
    try:
        with hdf5_reading.opened(measured_file(run.folder, row.file)) as file:
            fields = field_names([name for name, _ in row.channels], ("x", "y"))
            return tuple(file["entry"]["data"][one].dtype.str for one in fields)
    except (FileError, OSError, KeyError):  # missing or damaged: the documents point to it all the same
        return ("<f8",) * len(row.channels)


@dataclass
class _Stream:
    """Measurements of one kind: one descriptor, and an event for each."""

    run: Run
    start: str
    name: str
    first: ScanRow | SpectrumRow
    types: tuple[str, ...]
    count: int = field(default=0)

    @property
    def uid(self) -> str:
        return _uid(self.run, self.name)

    def _arrays(self) -> Iterator[tuple[str, str, str, str, list[int]]]:
        # (data key, field in the file, name, unit, shape)
        row = self.first
        if isinstance(row, ScanRow):
            names, units = [name for name, _ in row.channels], [unit for _, unit in row.channels]
            fields, shape = field_names(names, ("x", "y")), list(row.shape or ())
        else:
            names, units, fields, shape = list(row.names), list(row.units), field_names(row.names), [row.points]
        # a channel may have the name of a number in the event, such as "Angle" or "X"
        keys = field_names(fields, (*self._units(), _KEY, _INTERRUPTED))
        for key, one, name, unit in zip(keys, fields, names, units, strict=True):
            yield key, one, name, unit, shape

    def descriptor(self) -> dict[str, object]:
        source = f"afspm:{self.run.folder.name}"
        keys: dict[str, object] = {
            key: {
                "source": f"{source}/{name}", "dtype": "array", "dtype_numpy": kind, "shape": shape, "units": unit,
                "external": "STREAM:",
            }
            for kind, (key, _, name, unit, shape) in zip(self.types, self._arrays(), strict=True)
        }  # fmt: skip
        keys |= {
            one: {"source": source, "dtype": "number", "shape": [], "units": unit}
            for one, unit in self._units().items()
        }
        keys[_KEY] = {"source": source, "dtype": "string", "shape": []}
        if isinstance(self.first, ScanRow):  # the lines after the interruption are NaN
            keys[_INTERRUPTED] = {"source": source, "dtype": "boolean", "shape": []}
        return {
            "uid": self.uid,
            "time": (self.first.began_ns or self.first.time_ns) / NS_PER_S,
            "run_start": self.start,
            "name": self.name,
            "data_keys": keys,
            "object_keys": {"microscope": list(keys)},
            "configuration": {},
            "hints": {"microscope": {"fields": [one for one, *_ in self._arrays()][:1]}},
        }

    def _units(self) -> dict[str, str]:
        return _REGION if isinstance(self.first, ScanRow) else _POSITION

    def event(self, row: ScanRow | SpectrumRow) -> Iterator[Document]:
        number, self.count = self.count, self.count + 1
        file = measured_file(self.run.folder, row.file)
        for key, one, *_ in self._arrays():
            resource = _uid(self.run, self.name, str(number), key)
            yield (
                "stream_resource",
                {
                    "uid": resource,
                    "data_key": key,
                    "mimetype": "application/x-hdf5",
                    "uri": file.resolve().as_uri().replace("file:///", "file://localhost/"),
                    "parameters": {"dataset": f"/entry/data/{one}", "chunk_shape": []},
                    "run_start": self.start,
                },
            )
            yield (
                "stream_datum",
                {
                    "uid": f"{resource}/0",
                    "stream_resource": resource,
                    "descriptor": self.uid,
                    "indices": {"start": number, "stop": number + 1},
                    "seq_nums": {"start": number + 1, "stop": number + 2},
                },
            )
        data: dict[str, object] = {**_place(row), _KEY: row.key}
        if isinstance(row, ScanRow):
            data[_INTERRUPTED] = row.interrupted
        time_s = row.time_ns / NS_PER_S
        yield (
            "event",
            {
                "uid": _uid(self.run, self.name, str(number)),
                "time": time_s,
                "seq_num": number + 1,
                "descriptor": self.uid,
                "data": data,
                "timestamps": dict.fromkeys(data, time_s),
                "filled": {},
            },
        )


def _place(row: ScanRow | SpectrumRow) -> dict[str, float | None]:
    if isinstance(row, SpectrumRow):
        return dict(zip(_POSITION, row.position_m or (None, None), strict=True))
    if row.region is None:
        return dict.fromkeys(_REGION)
    return dict(zip(_REGION, (*row.region.center_m, *row.region.size_m, row.region.angle_rad), strict=True))


def _uid(run: Run, *of: str) -> str:
    return str(uuid5(NAMESPACE_URL, "/".join(("afspm", str(run.facts.get("run")), run.folder.name, *of))))
