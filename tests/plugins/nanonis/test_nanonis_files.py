"""Files of the emulated controller, compared with the format of real ones."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from afspm.plugins.nanonis.emulator import files

# of a file that Nanonis wrote, release 7856, less the modules in between
REAL_TAGS = [
    "NANONIS_VERSION",
    "SCANIT_TYPE",
    "REC_DATE",
    "REC_TIME",
    "REC_TEMP",
    "ACQ_TIME",
    "SCAN_PIXELS",
    "SCAN_FILE",
    "SCAN_TIME",
    "SCAN_RANGE",
    "SCAN_OFFSET",
    "SCAN_ANGLE",
    "SCAN_DIR",
    "BIAS",
    "Z-CONTROLLER",
    "COMMENT",
]
REAL_LINES = [
    "              FLOAT            MSBFIRST",
    "       160       160",
    "             1.296E+0             1.296E+0",
    "           1.000000E-8           1.000000E-8",
    "\tName\ton\tSetpoint\tP-gain\tI-gain\tT-const",
    "\tlog Current\t1\t3.000E-11 A\t1.150E-12 m\t1.000E-8 m/s\t1.150E-4 s",
    "\tChannel\tName\tUnit\tDirection\tCalibration\tOffset",
]


def saved(*, upwards: bool) -> files.SxmContent:
    rows = np.arange(160.0 * 160.0).reshape(160, 160)
    return files.SxmContent(
        path="nanonis.sxm",
        start_s=1_700_000_000.0,
        duration_s=415.9,
        center_m=(4.709271e-7, 5.657749e-8),
        range_m=(1e-8, 1e-8),
        angle_deg=0.0,
        upwards=upwards,
        line_s=(1.296, 1.296),
        bias_v=0.2688,
        z_controller=("log Current", True, 3e-11, "A", 1.15e-12, 1e-8),
        comment="4.4K",
        channels=[(14, "Z", "m", rows, rows)],
        settings={"Scan>lines": "160"},
    )


def test_a_header_has_the_tags_and_lines_of_a_real_one() -> None:
    head = files.sxm(saved(upwards=True)).split(b":SCANIT_END:")[0].decode()
    assert re.findall(r"^:(.*):$", head, re.MULTILINE) == [*REAL_TAGS, "Scan>lines", "DATA_INFO"]
    lines = head.splitlines()
    for line in REAL_LINES:
        assert line in lines or line.split() in [one.split() for one in lines], line


@pytest.mark.parametrize("upwards", [True, False])
def test_values_are_in_the_order_in_which_they_were_recorded(upwards: bool) -> None:
    _, _, rest = files.sxm(saved(upwards=upwards)).partition(b":SCANIT_END:\n\n\n\x1a\x04")
    forward, backward = np.frombuffer(rest, ">f4").reshape(2, 160, 160)
    assert forward[0, 0] == (0.0 if upwards else 159 * 160.0)
    np.testing.assert_array_equal(backward, forward[:, ::-1])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (470.927e-9, "470.927E-9"),
        (56.5775e-9, "56.5775E-9"),
        (10e-9, "10.0000E-9"),
        (-0.2, "-200.000E-3"),
        (-1.32523e-10, "-132.523E-12"),
        (1.14384e-9, "1.14384E-9"),
        (0.0, "0.00000E+0"),
        (999.9999999e-9, "1.00000E-6"),
        (math.nan, "NaN"),
        (math.inf, "Inf"),
    ],
)
def test_numbers_are_written_as_in_real_tables(value: float, text: str) -> None:
    assert files.engineering(value) == text


@pytest.mark.parametrize(("value", "text"), [(1.5e-9, "1.500E-9"), (0.0, "0.000E+0"), (20.01, "2.001E+1")])
def test_numbers_are_written_as_in_real_headers(value: float, text: str) -> None:
    assert files.scientific(value, 3) == text
