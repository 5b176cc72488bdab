"""The pipe between scheduler and worker: a line of JSON, and an array where there is one."""

from __future__ import annotations

import json
import struct
from typing import IO

import numpy as np
from numpy.typing import NDArray

from afspm.drift.registration import DriftScan
from afspm.model import Frame, Region
from afspm.plain_data import Plain
from afspm.scheduler.drift.messages import ScanJob

_LENGTHS = struct.Struct("<IQ")
_NOTHING = b""

Array = NDArray[np.float64]


def write(pipe: IO[bytes], head: Plain, values: Array | None = None) -> None:
    """Send a message. Raises OSError or ValueError if nobody is there."""
    text = json.dumps(head).encode()
    data = _NOTHING if values is None else np.ascontiguousarray(values, "<f8").data.cast("B")
    pipe.write(_LENGTHS.pack(len(text), len(data)))
    pipe.write(text)
    pipe.write(data)
    pipe.flush()


def read(pipe: IO[bytes]) -> tuple[Plain, bytes] | None:
    """The next message; None: the other side has gone."""
    lengths = pipe.read(_LENGTHS.size)
    if len(lengths) < _LENGTHS.size:
        return None
    text_length, data_length = _LENGTHS.unpack(lengths)
    text, data = pipe.read(text_length), pipe.read(data_length)
    if len(text) < text_length or len(data) < data_length:
        return None
    return json.loads(text), data


def job_to_head(job: ScanJob) -> Plain:
    """A scan to be registered, but for its values."""
    return {
        "do": "register",
        "key": job.key,
        "name": job.scan.filename or job.key,
        "start_s": job.start_s,
        "end_s": job.end_s,
        "upwards": job.upwards,
        "shape": job.scan.shape,
        "region": _to_list(job.scan.region),
        "asked": None if job.asked is None else _to_list(job.asked),
    }


def job_from_head(head: Plain, data: bytes) -> tuple[str, DriftScan, Region | None]:
    """Return the key, the scan with its name, and the region that was meant in sample coordinates."""
    values = np.frombuffer(data, "<f8").reshape(head["shape"])
    region = _region(head["region"], Frame.TIP)
    scan = DriftScan(values, region, head["start_s"], head["end_s"], head["upwards"], head["name"])
    return head["key"], scan, None if head["asked"] is None else _region(head["asked"], Frame.SAMPLE)


def _to_list(region: Region) -> list[float]:
    return [*region.center_m, *region.size_m, region.angle_rad]


def _region(numbers: list[float], frame: Frame) -> Region:
    x, y, width, height, angle = numbers
    return Region((x, y), (width, height), angle, frame)
