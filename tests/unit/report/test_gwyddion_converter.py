"""Files that only Gwyddion's converter reads: by a program in its place, and by the real one where it is installed."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.unit.storage.samples import HEIGHT_M, REGION, exported_gwy, sxm

import afspm
from afspm.basics.errors import FileError
from afspm.model import Region, Scan
from afspm.model.arrays import Array
from afspm.report.export import gwyddion
from afspm.storage.formats import FileContent, gwyddion_converter

CONVERTED = """
import shutil
shutil.copy({gwy!r}, sys.argv[2])
print('{{"module": "{module}"}}')
"""


def converted(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    meta: Mapping[str, str],
    values: Array | None = None,
    raw: bytes = b"raw",
) -> FileContent:
    """Return a file that the converter turns into one image with metadata, by one of Gwyddion's modules."""
    scan = Scan(Region((0.0, 0.0), REGION.size_m), "Height", "m", HEIGHT_M if values is None else values)
    (folder / "right.gwy").write_bytes(gwyddion.scan_file((scan,), meta))
    install(folder, monkeypatch, CONVERTED.format(gwy=str(folder / "right.gwy"), module=module))
    (path := file(folder)).write_bytes(raw)
    return afspm.read(path, zone=UTC)


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> None:
    """Put a program in the converter's place, on the PATH."""
    if os.name != "posix":
        pytest.skip("a script is no program on Windows")
    program = folder / "bin" / gwyddion_converter.PROGRAM
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nimport sys\n{body}")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=os.pathsep)


def without_converter(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr(gwyddion_converter, "_PACKAGE", "no_such_package")


def file(folder: Path, name: str = "a.sm4") -> Path:
    path = folder / name
    path.write_bytes(b"of a maker whose format afspm does not know")
    return path


def test_file_of_another_maker_is_read_and_says_who_read_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "right.gwy").write_bytes(exported_gwy())
    install(tmp_path, monkeypatch, CONVERTED.format(gwy=str(tmp_path / "right.gwy"), module="createc"))
    content = afspm.read(path := file(tmp_path))
    height, _ = content.scans
    np.testing.assert_array_equal(height.values, HEIGHT_M)
    assert (height.channel, height.unit, height.filename) == ("Height", "m", str(path))
    assert (height.region.size_m, height.region.center_m) == (REGION.size_m, (0.0, 0.0))
    assert content.header["read by"] == "Gwyddion, module createc"
    assert "unknown" in content.header["place"]


def test_suffix_that_another_maker_uses_too_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "right.gwy").write_bytes(exported_gwy())
    install(tmp_path, monkeypatch, CONVERTED.format(gwy=str(tmp_path / "right.gwy"), module="createc"))
    assert len(afspm.read(file(tmp_path, "a.dat")).scans) == 2


def test_file_without_a_converter_is_refused_with_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_converter(monkeypatch, tmp_path)
    with pytest.raises(FileError, match=r"no reader for \.sm4.*afspm\[formats\]"):
        afspm.read(file(tmp_path))
    with pytest.raises(FileError, match=r"it has no \[DATA\]"):
        afspm.read(file(tmp_path, "a.dat"))


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("sys.exit('gwyconvert: cannot load it')", "either: gwyconvert: cannot load it"),
        ("", "either: no reason"),
        ("open(sys.argv[2], 'wb').write(b'GWYPGwy')", "a text does not end"),
        ("bytearray(1 << 40)", "MemoryError"),
        ("import time; time.sleep(3600)", "did not end within"),
    ],
    ids=["unknown format", "nothing written", "half a file", "too much memory", "too long"],
)
def test_converter_that_fails_costs_only_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, reason: str
) -> None:
    install(tmp_path, monkeypatch, body)
    if "sleep" in body:
        monkeypatch.setattr(gwyddion_converter, "LONGEST_S", 0.2)
    with pytest.raises(FileError, match=reason) as refused:
        afspm.read(file(tmp_path))
    assert refused.value.where == str(tmp_path / "a.sm4")


def ns(text: str) -> int:
    return round(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp() * 1000) * 10**6


@pytest.mark.parametrize(
    ("module", "meta", "start", "end", "place", "upwards"),
    [
        (
            "jpkscan",
            {
                "Time Start": "2017-01-16 16:00:32.334 GMT",
                "Time End": "2017-01-16 17:01:36.264 CET",
                "Origin X": "2.584 µm",
                "Origin Y": "1.623 µm",
            },
            "2017-01-16T16:00:32.334",
            "2017-01-16T16:01:36.264",
            "origin x 2.584 µm, origin y 1.623 µm",
            None,
        ),
        (
            "mifile",
            {
                "Date acquired": "Tue Feb 18 15:00:51 2014",
                "xOffset": "0.0",
                "yOffset": "1e-6",
                "scanAngle": "0",
                "Scanning direction": "Bottom to top",
            },
            None,
            "2014-02-18T15:00:51",
            "xoffset 0.0, yoffset 1e-6, scanangle 0",
            True,
        ),
        (
            "nanoscope",
            {
                "Date": "01:33:51 PM Mon Dec 15 2014",
                "X Offset": "0 nm",
                "Y Offset": "0 nm",
                "Rotate Ang.": "1.5708",
                "Capture direction": "Down",
            },
            None,
            "2014-12-15T13:33:51",
            "x offset 0 nm, y offset 0 nm, rotate ang. 1.5708",
            False,
        ),
        (
            "wsxmfile",
            {"General Info::Acquisition time": "18/06/2021, 14:12:26.398", "General Info::Y scanning direction": "Up"},
            None,
            "2021-06-18T14:12:26.398",
            "",
            True,
        ),
        ("createc", {"Date": "01:33:51 PM Mon Dec 15 2014"}, None, None, "", None),
    ],
)
def test_time_place_and_direction_come_from_the_metadata_of_known_modules(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    meta: dict[str, str],
    start: str | None,
    end: str | None,
    place: str,
    upwards: bool | None,
) -> None:
    # users N2 and N3: the headers have the time, and nothing read it; the texts are of real files
    content = converted(tmp_path, monkeypatch, module, meta)
    assert (content.start_ns, content.end_ns) == (start and ns(start), end and ns(end))
    assert (content.stated_place, content.upwards, content.left_out) == (place, upwards, ())
    assert content.scans[0].region.center_m == (0.0, 0.0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [("2017-01-16 16:00:32.334 CST", "the time zone CST"), ("yesterday", "'yesterday' does not match")],
)
def test_time_that_can_not_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, reason: str
) -> None:
    content = converted(tmp_path, monkeypatch, "jpkscan", {"Time Start": text})
    assert content.start_ns is None
    assert reason in content.left_out[0]


def test_voids_that_gwyddion_does_not_mask_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # users N2: 89 % of an image of Digital Surf are voids with the lowest value
    values = HEIGHT_M.copy()
    values[0] = HEIGHT_M.min()
    content = converted(tmp_path, monkeypatch, "surffile", {}, values)
    (named,) = content.left_out
    assert named == f"Height: {values.shape[1]} of {values.size} points have its lowest value, and may not be measured"


def test_curves_that_the_converter_does_not_read_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # users N2: 256 curves of a force volume were left out without a word
    content = converted(
        tmp_path, monkeypatch, "nanoscope", {}, raw=b"\\*Ciao image list\r\n\\*Ciao force image list\r\n"
    )
    assert content.left_out == ("force curves: Gwyddion's converter does not read them from this file",)


def tiff(pictures: int) -> bytes:
    file = BytesIO()
    first, *others = (Image.fromarray(np.full((8, 8), k, np.uint8)) for k in range(pictures))
    first.save(file, "TIFF", save_all=True, append_images=others)
    return file.getvalue()


def wsxm(values: Array) -> bytes:
    head = b"WSxM file copyright UAM\r\nSxM Image file\r\nImage header size: 100\r\n"
    return head.ljust(100) + values.tobytes()


@pytest.mark.parametrize(
    ("module", "raw"), [("jpkscan", tiff(3)), ("wsxmfile", wsxm(HEIGHT_M))], ids=["TIFF of JPK", "WSxM"]
)
def test_file_without_its_last_byte_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, raw: bytes
) -> None:
    # users N2: a .jpk without its last byte lost a channel, and a .stp had numbers of the memory in its place
    meta = {"General Info::Image Data Type": "double"}
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder in (whole, cut):
        folder.mkdir()
    assert len(converted(whole, monkeypatch, module, meta, raw=raw).scans) == 1
    end = raw.rindex(b"\x02" * 64) + 63 if module == "jpkscan" else len(raw) - 1
    with pytest.raises(FileError, match="is incomplete: it has"):
        converted(cut, monkeypatch, module, meta, raw=raw[:end])


def test_file_of_a_third_maker_is_refused_with_the_reasons_of_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # users N7: a .dat of Createc that Gwyddion refuses was "not a spectrum of Nanonis, or incomplete"
    install(tmp_path, monkeypatch, "sys.exit('gwyconvert: File is truncated.')")
    with pytest.raises(FileError, match=r"no \[DATA\]; it can't be read by Gwyddion's converter.*File is truncated"):
        afspm.read(file(tmp_path, "a.dat"))


@pytest.mark.program
def test_real_converter_keeps_values_and_size(tmp_path: Path) -> None:
    if gwyddion_converter._program() is None:
        pytest.skip("Gwyddion's converter is not installed")
    path = tmp_path / "a.other"
    path.write_bytes(sxm())
    content = afspm.read(path)
    np.testing.assert_allclose(content.scans[0].values, HEIGHT_M, rtol=1e-6)
    np.testing.assert_allclose(content.scans[0].region.size_m, REGION.size_m)
    assert content.header["read by"] == "Gwyddion, module nanonis"
