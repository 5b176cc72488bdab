"""What users do to files: comments with anything in them, texts in other encodings, tables saved by an editor."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from datetime import UTC
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import h5py
import numpy as np
import pytest
from scipy.io import netcdf_file
from tests.unit.storage.samples import (
    ANGLE_DEG,
    HEIGHT_M,
    NOTE,
    NX,
    NY,
    OTHER,
    REGION,
    dat,
    gsf,
    gxsm3,
    gxsm4,
    nhf,
    nid,
    nsid,
    sxm,
    wave,
)

import afspm
from afspm.basics.errors import FileError
from afspm.storage.formats import FileContent

COMMENT = b"at 4.4 K, 30 \xb0"


def read(path: Path, content: bytes, zone: ZoneInfo | None = None) -> FileContent:
    path.write_bytes(content)
    return afspm.read(path, zone=zone or UTC)


@pytest.mark.parametrize(
    "comment",
    [
        "as before:\n:SCAN_OFFSET:\n 1.0E-7 2.0E-7\n:SCAN_ANGLE:\n 12 of yesterday\n:SCAN_RANGE:\n 5.0E-8 5.0E-8",
        "first\n:tip changed:\nsecond",
        "end of the header:\n:SCANIT_END:\nand more",
        ":DATA_INFO:\n\tChannel\tName\tUnit\tDirection\tCalibration\tOffset\n\t3\tX\tV\tboth\t1\t0\n",
    ],
    ids=["header of another scan", "line between colons", "end of a header", "table of channels"],
)
def test_nanonis_comment_changes_nothing_else(tmp_path: Path, comment: str) -> None:
    content = read(tmp_path / "a.sxm", sxm().replace(COMMENT, comment.encode()))
    assert [scan.channel for scan in content.scans] == ["Z Forward", "Z Backward", "Current Forward"]
    np.testing.assert_allclose(content.scans[0].values, HEIGHT_M, rtol=1e-6)
    for scan in content.scans:
        np.testing.assert_allclose(scan.region.center_m, REGION.center_m)
        np.testing.assert_allclose(scan.region.size_m, REGION.size_m)
        assert np.degrees(scan.region.angle_rad) == pytest.approx(ANGLE_DEG)
    if "DATA_INFO" not in comment:
        assert content.header["COMMENT"] == comment.strip()


def test_first_of_two_lines_of_a_spectrum_header_counts(tmp_path: Path) -> None:
    lines = b"Comment01\tas before:\r\nX (m)\t900E-9\t\r\n[DATA]\r\nof yesterday\t\r\n"
    (spectrum,) = read(tmp_path / "a.dat", dat().replace(b"Start time", lines + b"Start time")).spectra
    assert spectrum.position_m == (300e-9, -200e-9)


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_nanonis_names_and_units_are_read_in_both_encodings(tmp_path: Path, encoding: str) -> None:
    named = sxm().replace(b"\tZ\tm\t", "\tHöhe €\tµm\t".encode(encoding)).replace(COMMENT, b"at night")
    scan = read(tmp_path / "a.sxm", named).scans[0]
    assert (scan.channel, scan.unit) == ("Höhe € Forward", "µm")
    table = dat().replace(b"Current (A)\t", "Strom µ (A)\t".encode(encoding))
    (spectrum,) = read(tmp_path / "a.dat", table).spectra
    assert spectrum.names[1] == "Strom µ"


def _gxsm3(path: Path, comment: bytes) -> None:
    gxsm3(path)
    file: Any
    with netcdf_file(path, "a") as file:
        file.comment = comment


def _gxsm4(path: Path, comment: bytes) -> None:
    gxsm4(path)
    with h5py.File(path, "a") as file:
        file["comment"] = np.frombuffer(comment, dtype="S1")


def _gsf(path: Path, comment: bytes) -> None:
    whole = gsf().partition(b"\0")[0] + b"comment = " + comment + b"\n"
    path.write_bytes(whole + b"\0" * (4 - len(whole) % 4) + HEIGHT_M[::-1].astype("<f4").tobytes())


def _nhf(path: Path, comment: bytes) -> None:
    nhf(path)
    with h5py.File(path, "a") as file:
        file["measurement_0"].attrs.create("comment", comment, dtype=h5py.string_dtype())


def _sxm(path: Path, comment: bytes) -> None:
    path.write_bytes(sxm().replace(COMMENT, comment))


Write = Callable[[Path, bytes], None]
FORMATS: dict[str, tuple[str, Write]] = {
    "GXSM 3": ("nc", _gxsm3),
    "GXSM 4": ("nc", _gxsm4),
    "Gwyddion": ("gsf", _gsf),
    "Nanosurf": ("nhf", _nhf),
    "Nanonis": ("sxm", _sxm),
}


def _comment(path: Path) -> str:
    header = afspm.read(path).header
    return str(header[next(key for key in header if key.casefold() == "comment")])


@pytest.mark.parametrize(("suffix", "write"), FORMATS.values(), ids=FORMATS)
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_comment_is_read_in_both_encodings(tmp_path: Path, suffix: str, write: Write, encoding: str) -> None:
    path = tmp_path / f"a.{suffix}"
    write(path, "30 µm, 4 °C".encode(encoding))
    assert _comment(path) == "30 µm, 4 °C"
    assert afspm.read(path).left_out == ()


@pytest.mark.parametrize(("suffix", "write"), FORMATS.values(), ids=FORMATS)
def test_comment_in_another_encoding_is_named(tmp_path: Path, suffix: str, write: Write) -> None:
    path = tmp_path / f"a.{suffix}"
    write(path, "プローブ".encode("shift-jis"))
    (left_out,) = afspm.read(path).left_out
    assert "comment" in left_out.casefold()
    assert "neither UTF-8 nor cp1252" in left_out


def test_columns_of_one_name_get_a_number(tmp_path: Path) -> None:
    (spectrum,) = read(tmp_path / "a.dat", dat().replace(b"Current (A) [filt]", b"Current (A)")).spectra
    assert spectrum.names == ("Bias calc", "Current", "Current #2")
    np.testing.assert_array_equal(spectrum["Current #2"], [np.nan, 1e-12, 1e-12])


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbf" + dat(),
        dat().replace(b"-1.5E+0\t2E-12\tNaN", b"-1.5E+0\t2E-12\tNaN\t\t"),
    ],
    ids=["byte order mark", "trailing tabs"],
)
def test_spectrum_saved_by_an_editor_is_read(tmp_path: Path, content: bytes) -> None:
    (spectrum,) = read(tmp_path / "a.dat", content).spectra
    assert spectrum.values.shape == (3, 3)
    assert spectrum.values[2, 1] == -2e-12


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (dat().replace(b"Experiment\tbias spectroscopy\t\r\n", b""), "no line Experiment"),
        (dat()[:-5], "its last line has no end"),
        (dat().replace(b"-2E-12\t", b"-2,5E-12\t"), "decimal points"),
    ],
    ids=["no experiment", "cut off", "decimal comma"],
)
def test_refused_spectrum_has_the_true_reason(tmp_path: Path, content: bytes, reason: str) -> None:
    with pytest.raises(FileError, match=reason):
        read(tmp_path / "a.dat", content)


def test_refused_scan_of_one_line_has_the_true_reason(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=f"has {NX} x 1 pixels"):
        read(tmp_path / "a.sxm", sxm().replace(f"{NX}       {NY}".encode(), f"{NX}       1".encode()))


def test_spectrum_over_the_end_of_summer_time_does_not_end_before_it_began(tmp_path: Path) -> None:
    content = dat().replace(b"14.11.2023 22:13:20", b"25.10.2026 02:00:05")
    content = content.replace(b"14.11.2023 22:12:00", b"25.10.2026 02:59:50")
    found = read(tmp_path / "a.dat", content, ZoneInfo("Europe/Berlin"))
    assert found.start_ns is not None
    assert found.end_ns is not None
    assert found.end_ns - found.start_ns == 15 * 10**9


def test_igor_layers_without_a_label_are_numbered(tmp_path: Path) -> None:
    whole = wave(np.stack([HEIGHT_M.T, OTHER.T], axis=2), "m", (10e-9, 10e-9), ["HeightRetrace"], NOTE)
    scans = read(tmp_path / "a.ibw", whole).scans
    assert [scan.channel for scan in scans] == ["HeightRetrace", "Channel 2"]
    np.testing.assert_allclose(scans[1].values, OTHER, rtol=1e-6)


def test_small_igor_wave_of_another_version_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="version 2, not 5"):
        read(tmp_path / "a.ibw", b"\x02\x00" + bytes(200))


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_place_of_an_older_nanosurf_image_is_read(tmp_path: Path, encoding: str) -> None:
    info = "[DataSet-Info]\r\nRotation=-45 °\r\nX-Pos=1.3µm\r\nY-Pos=-166nm\r\n\r\n[DataSet-0:1]"
    scan = read(tmp_path / "a.nid", nid().replace(b"[DataSet-0:1]", info.encode(encoding))).scans[0]
    np.testing.assert_allclose(scan.region.center_m, (1.3e-6, -166e-9))
    assert np.degrees(scan.region.angle_rad) == pytest.approx(-45.0)


def test_file_that_another_program_holds_open_is_read(tmp_path: Path) -> None:
    nsid(path := tmp_path / "a.h5")
    hold = f"import h5py, sys; file = h5py.File({str(path)!r}, 'r+'); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline().strip() == b"open"
        try:
            assert afspm.read(path).scans
        finally:
            other.kill()


def test_nanonis_field_of_another_program_after_the_channels_changes_nothing(tmp_path: Path) -> None:
    # users N7: a published converter of Createc's files writes it; "not enough values to unpack"
    with_field = sxm().replace(b":SCANIT_END:", b":converted by:\nanother program\n:SCANIT_END:")
    for one, other in zip(
        read(tmp_path / "a.sxm", with_field).scans, read(tmp_path / "b.sxm", sxm()).scans, strict=True
    ):
        assert one.channel == other.channel
        np.testing.assert_array_equal(one.values, other.values)
