"""The files that Nanonis saves: scans (.sxm) and spectra (.dat), with the headers of real files."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np


@dataclass(frozen=True)
class SxmContent:
    """The content of a scan's file.

    Attributes:
        center_m, range_m: frame, from edge to edge of its outer pixels.
        angle_deg: angle, clockwise.
        line_s: duration of a line forward, backward.
        z_controller: name, True if on, setpoint, its unit, proportional and integral gain.
        channels: index, name, unit, and images forward and backward, both [y, x] with both axes ascending.
        settings: header lines `module>name`, in order.
    """

    path: str
    start_s: float
    duration_s: float
    center_m: tuple[float, float]
    range_m: tuple[float, float]
    angle_deg: float
    upwards: bool
    line_s: tuple[float, float]
    bias_v: float
    z_controller: tuple[str, bool, float, str, float, float]
    comment: str
    channels: Sequence[tuple[int, str, str, np.ndarray, np.ndarray]]
    settings: Mapping[str, str]


def sxm(scan: SxmContent) -> bytes:
    """Encode a scan's file."""
    rows, columns = scan.channels[0][3].shape
    start = _local(scan.start_s)
    name, on, setpoint, unit, proportional, integral = scan.z_controller
    fields = {
        "NANONIS_VERSION": "2",
        "SCANIT_TYPE": "              FLOAT            MSBFIRST",
        "REC_DATE": f" {start:%d.%m.%Y}",
        "REC_TIME": f"{start:%H:%M:%S}",
        "REC_TEMP": "      290.0000000000",
        "ACQ_TIME": f"{scan.duration_s:12.1f}",
        "SCAN_PIXELS": f"{columns:10d}{rows:10d}",
        "SCAN_FILE": scan.path,
        "SCAN_TIME": "".join(f"{scientific(value, 3):>21}" for value in scan.line_s),
        "SCAN_RANGE": "".join(f"{scientific(value, 6):>21}" for value in scan.range_m),
        "SCAN_OFFSET": "".join(f"{scientific(value, 6):>21}" for value in scan.center_m),
        "SCAN_ANGLE": f"{scientific(scan.angle_deg, 3):>21}",
        "SCAN_DIR": "up" if scan.upwards else "down",
        "BIAS": f"{scientific(scan.bias_v, 3):>21}",
        "Z-CONTROLLER": "\tName\ton\tSetpoint\tP-gain\tI-gain\tT-const\n"
        f"\t{name}\t{int(on)}\t{scientific(setpoint, 3)} {unit}\t{scientific(proportional, 3)} m"
        f"\t{scientific(integral, 3)} m/s\t{scientific(proportional / integral if integral else 0.0, 3)} s",
        "COMMENT": scan.comment,
        **scan.settings,
        "DATA_INFO": "\tChannel\tName\tUnit\tDirection\tCalibration\tOffset\n"
        + "".join(
            f"\t{i}\t{name.replace(' ', '_')}\t{unit}\tboth\t1.000E+0\t0.000E+0\n"
            for i, name, unit, *_ in scan.channels
        ),
    }
    header = "".join(f":{key}:\n{value}\n" for key, value in fields.items()) + ":SCANIT_END:\n\n\n"
    # As in real files: backward lines from right to left, rows in recording order.
    images = (image for *_, forward, backward in scan.channels for image in (forward, backward[:, ::-1]))
    recorded = (image if scan.upwards else image[::-1] for image in images)
    values = b"".join(np.asarray(image, dtype=">f4").tobytes() for image in recorded)
    return header.encode("latin-1", "replace") + b"\x1a\x04" + values


def dat(header: Mapping[str, str], columns: Sequence[str], values: np.ndarray) -> bytes:
    """Encode a spectrum's file: values [points, columns]."""
    lines = [f"{key}\t{value}\t" for key, value in header.items()]
    table = ["\t".join(columns), *("\t".join(engineering(value) for value in row) for row in values.tolist())]
    return "".join(f"{line}\r\n" for line in [*lines, "", "[DATA]", *table]).encode("latin-1", "replace")


@dataclass(frozen=True)
class DatContent:
    """The content of a spectrum's file: header lines split at tabs, and values [points, columns]."""

    header: Sequence[Sequence[str]]
    columns: Sequence[str]
    values: np.ndarray


def read_dat(content: bytes) -> DatContent:
    """Parse the result of `dat`. Raises ValueError: there is no table, or a value is not a number."""
    head, found, table = content.decode("latin-1").partition("[DATA]")
    names, *rows = table.strip().splitlines() or [""]
    if not found or not names:
        raise ValueError("no [DATA] in it")
    header = [line.rstrip("\t").split("\t") for line in head.splitlines() if line]
    values = np.array([[float(value) for value in row.split("\t")] for row in rows])
    return DatContent(header, names.split("\t"), values.reshape(len(rows), -1))


def moment(time_s: float) -> str:
    """Format a time (seconds since the Unix epoch) as local time, "31.12.2025 23:59:59"."""
    return f"{_local(time_s):%d.%m.%Y %H:%M:%S}"


def scientific(value: float, digits: int) -> str:
    """Format as "1.500E-9": the exponent has no leading zeros."""
    return re.sub(r"E([+-])0+(?=\d)", r"E\1", f"{value:.{digits}E}")


def engineering(value: float) -> str:
    """Format as "15.0000E-9": six digits, and an exponent divisible by three."""
    if not math.isfinite(value):
        return str(value).replace("nan", "NaN").replace("inf", "Inf")
    decade = int(f"{value:.5E}".partition("E")[2])
    exponent = 3 * (decade // 3)
    return f"{value / 10.0**exponent:.{5 - decade + exponent}f}E{exponent:+d}"


def _local(time_s: float) -> datetime:
    return datetime.fromtimestamp(time_s, UTC).astimezone()
