"""Files of Gwyddion in which a part can't be read, and files by its converter, which believes any bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import afspm
from afspm.basics.errors import FileError
from afspm.model import Region, Scan
from afspm.report.export import gwyddion
from afspm.storage.formats.gwyddion_reader import read_gwyddion

REGION = Region((0.0, 0.0), (1e-6, 0.5e-6), 0.0)


def scan(channel: str, unit: str = "m", values: np.ndarray | None = None) -> Scan:
    return Scan(REGION, channel, unit, np.arange(12.0).reshape(3, 4) * 1e-9 if values is None else values)


def written(path: Path, *scans: Scan) -> Path:
    """Write a file without the exact region that afspm's own files have."""
    path.write_bytes(gwyddion.scan_file(scans, {}))
    return path


def with_side_in_volts(path: Path, channel: int) -> None:
    """Let a channel have sides in V, as a field of frequencies has its own unit there."""
    data = path.read_bytes()
    at = data.index(b"unitstr\0sm\0", data.index(b"si_unit_xy", data.index(b"/%d/data" % channel)))
    path.write_bytes(data[:at] + b"unitstr\0sV\0" + data[at + len(b"unitstr\0sm\0") :])


def test_one_bad_field_is_named_and_the_others_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    # users N4: a .gwy with one FFT image was refused whole
    file = written(tmp_path / "a.gwy", scan("Height"), scan("FFT"), scan("Phase", "deg"))
    with_side_in_volts(file, 1)
    content = afspm.read(file)
    assert [one.channel for one in content.scans] == ["Height", "Phase"]
    (named,) = content.left_out
    assert named.startswith("FFT: ")
    assert "can't be converted to m" in named
    assert f"{file}: left out: FFT" in caplog.text


def test_file_whose_only_field_is_bad_is_refused_with_the_reason(tmp_path: Path) -> None:
    file = written(tmp_path / "a.gwy", scan("FFT"))
    with_side_in_volts(file, 0)
    with pytest.raises(FileError, match=r"no image and no graph that can be read: FFT: .* converted to m"):
        afspm.read(file)


def test_title_of_one_letter_is_a_text(tmp_path: Path) -> None:
    # users N10: other writers store it as a character
    file = written(tmp_path / "a.gwy", scan("H"))
    data = file.read_bytes().replace(b"/0/data/title\0sH\0", b"/0/data/title\0cH")
    at = len(b"GWYPGwyContainer\0")
    file.write_bytes(
        data[:at] + (int.from_bytes(data[at : at + 4], "little") - 1).to_bytes(4, "little") + data[at + 4 :]
    )
    (found,) = afspm.read(file).scans
    assert found.channel == "H"


@pytest.mark.parametrize("is_converted", [True, False])
def test_mask_means_not_measured_in_a_file_by_the_converter(tmp_path: Path, is_converted: bool) -> None:
    # users N2: bad pixels came as values; in a person's own file a mask is a selection
    values = np.arange(12.0).reshape(3, 4) * 1e-9
    values[1, 2] = np.nan
    file = written(tmp_path / "a.gwy", scan("Height", values=values))
    (found,) = read_gwyddion(file, None, is_converted=is_converted).scans
    assert np.isnan(found.values[1, 2]) == is_converted
    assert np.isfinite(np.delete(found.values.ravel(), 6)).all()


@pytest.mark.parametrize(("unit", "most"), [("m", 1.8e299), ("N", 1.2), ("", 1e300)])
def test_values_that_no_measurement_has_are_left_out_of_a_converted_file(
    tmp_path: Path, unit: str, most: float
) -> None:
    # users N2: half a file was read as values up to 1e299 m, and a deflection as newtons
    wrong = np.full((3, 4), most)
    file = written(tmp_path / "a.gwy", scan("Height"), scan("Wrong", unit, wrong))
    content = read_gwyddion(file, None, is_converted=True)
    assert [one.channel for one in content.scans] == ["Height"]
    assert "which no measurement has" in content.left_out[0]
    assert len(read_gwyddion(file, None).scans) == 2
