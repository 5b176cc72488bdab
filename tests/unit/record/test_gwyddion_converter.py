"""Files that only Gwyddion's converter reads: by a program in its place, and by the real one where it is installed."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.unit.storage.samples import HEIGHT_M, REGION, exported_gwy, sxm

import afspm
from afspm.basics.errors import FileError
from afspm.record import gwyddion_converter

CONVERTED = """
import shutil
shutil.copy({gwy!r}, sys.argv[2])
print('{{"module": "createc"}}')
"""


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
    install(tmp_path, monkeypatch, CONVERTED.format(gwy=str(tmp_path / "right.gwy")))
    content = afspm.read(path := file(tmp_path))
    height, _ = content.scans
    np.testing.assert_array_equal(height.values, HEIGHT_M)
    assert (height.channel, height.unit, height.filename) == ("Height", "m", str(path))
    assert (height.region.size_m, height.region.center_m) == (REGION.size_m, (0.0, 0.0))
    assert content.header["read by"] == "Gwyddion, module createc"
    assert "unknown" in content.header["place"]


def test_suffix_that_another_maker_uses_too_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "right.gwy").write_bytes(exported_gwy())
    install(tmp_path, monkeypatch, CONVERTED.format(gwy=str(tmp_path / "right.gwy")))
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


def test_real_converter_keeps_values_and_size(tmp_path: Path) -> None:
    if gwyddion_converter._program() is None:
        pytest.skip("Gwyddion's converter is not installed")
    path = tmp_path / "a.other"
    path.write_bytes(sxm())
    content = afspm.read(path)
    np.testing.assert_allclose(content.scans[0].values, HEIGHT_M, rtol=1e-6)
    np.testing.assert_allclose(content.scans[0].region.size_m, REGION.size_m)
    assert content.header["read by"] == "Gwyddion, module nanonis"
