"""The table of drift: the content of a row, and no duplicate rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from afspm.model import RegistrationOutcome
from afspm.plugins.drift.report.drift_pictures import COLUMNS, DriftTable, drift_row
from afspm.plugins.drift.track.record import DriftRecord
from afspm.wire.generated.drift_pb2 import DriftMapping


def mapping(number: int, *, matched: bool = True) -> DriftMapping:
    message = DriftMapping(
        matrix=[1.0, 0.0, -3e-9, 0.0, 1.0, 2e-9],
        covariance=[4e-20, 1e-20, 1e-20, 9e-20],
        rate=[1e-12, -2e-12],
        matched=matched,
        lost=False,
        reason="" if matched else "nothing, is alike",
        filename=f"{number}.nc",
        center=[1e-6, 2e-6],
        correcting=True,
        outcome=int(RegistrationOutcome.REGISTERED if matched else RegistrationOutcome.FAILED),  # type: ignore[arg-type]
        failures=0 if matched else 2,
    )
    message.timestamp.FromNanoseconds(1_750_000_000_000_000_000 + number * 10**9)
    return message


def test_a_row_has_offset_rate_and_whether_it_was_matched() -> None:
    row = dict(zip(COLUMNS, drift_row(mapping(1)), strict=True))
    assert (row["datetime"], row["filename"]) == ("2025-06-15T15:06:41.000000Z", "1.nc")
    assert [float(row[name]) for name in ("offset_x", "offset_y")] == pytest.approx([-3e-9, 2e-9])
    assert [float(row[name]) for name in ("drift_x_m", "drift_y_m")] == pytest.approx([3e-9, -2e-9])
    assert [float(row[name]) for name in ("var_x_m2", "cov_xy_m2", "var_y_m2")] == pytest.approx([4e-20, 1e-20, 9e-20])
    assert [row[name] for name in ("matched", "lost", "correcting")] == ["yes", "no", "yes"]


def test_no_drift_is_written_as_zero_and_not_minus_zero() -> None:
    message = mapping(0)
    message.matrix[:] = [1.0, 0.0, -0.0, 0.0, 1.0, 0.0]
    message.rate[:] = [-0.0, 0.0]
    assert not {"-0", "-0.0"} & set(drift_row(message))


def test_a_table_is_written_once_over_restarts_and_can_be_read(tmp_path: Path) -> None:
    for _ in range(2):
        table = DriftTable()
        table.run_dir = tmp_path
        table.on_start()
        for number in range(3):
            table.on_drift_mapping(mapping(number, matched=number != 1))
    record = DriftRecord.read(tmp_path / "drift_correction.csv")
    assert record.keys == ("0.nc", "1.nc", "2.nc")
    np.testing.assert_allclose(record.drift_m, [[3e-9, -2e-9]] * 3)
    assert record.matched.tolist() == [True, False, True]
    assert record.reasons[1] == "nothing, is alike"
    assert [outcome.label for outcome in record.outcomes] == ["registered", "failed", "registered"]
    assert record.failures == (0, 2, 0)
    assert record.summary() == "registered 2 of 3 scans, 1 failed"


def test_a_scan_before_anything_was_known_has_a_row_without_variances() -> None:
    message = mapping(1, matched=False)
    del message.covariance[:]
    del message.rate[:]
    row = dict(zip(COLUMNS, drift_row(message), strict=True))
    assert (row["outcome"], row["var_x_m2"], row["rate_x"]) == ("failed", "nan", "nan")
