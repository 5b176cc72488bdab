"""The table of a run is read back from its file unchanged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from afspm.basics import FileError
from afspm.model import RegistrationOutcome
from afspm.plugins.drift.track.record import DriftRecord
from afspm.record import drift_at


def record(n: int = 20, seed: int = 1) -> DriftRecord:
    """Return the record of a scan every 15 minutes, followed to a few nm."""
    random = np.random.default_rng(seed)
    drift = np.cumsum(random.normal(10e-9, 5e-9, (n, 2)), axis=0)
    spread = np.array([[4.0, 1.0], [1.0, 9.0]]) * 1e-18
    return DriftRecord(
        keys=tuple(f"scan, {k}" for k in range(n)),
        time_s=900.0 * np.arange(n, dtype=np.float64) + 1.8e9,
        center_m=drift + random.normal(0.0, 3e-9, (n, 2)),
        drift_m=drift,
        covariance_m2=np.tile(spread, (n, 1, 1)),
        rate_m_s=np.gradient(drift, 900.0, axis=0),
        matched=np.arange(n) % 7 != 3,
        reasons=tuple("nothing in common" if k % 7 == 3 else "" for k in range(n)),
        outcomes=tuple(RegistrationOutcome.REFUSED if k % 7 == 3 else RegistrationOutcome.REGISTERED for k in range(n)),
        failures=tuple(k % 2 for k in range(n)),
    )


def test_an_unknown_rate_of_the_first_scan_is_the_rate_of_the_second() -> None:
    known = record(3)
    np.testing.assert_array_equal(known.rate_then_m_s, known.rate_m_s)
    rates = known.rate_m_s.copy()
    rates[0] = 0.0
    begun = replace(known, rate_m_s=rates)
    np.testing.assert_array_equal(begun.rate_then_m_s, rates[[1, 1, 2]])
    np.testing.assert_array_equal(begun[:1].rate_then_m_s, [(0.0, 0.0)])


def test_a_written_record_is_read_back_unchanged(tmp_path: Path) -> None:
    written = record()
    written.write(tmp_path / "drift.csv", ["no"] * len(written))
    read = DriftRecord.read(tmp_path / "drift.csv")
    assert read.keys == written.keys
    assert read.reasons == written.reasons
    np.testing.assert_array_equal(read.matched, written.matched)
    for name in ("time_s", "center_m", "drift_m", "covariance_m2", "rate_m_s"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), rtol=1e-8, err_msg=name)
    assert np.abs(read.time_s - written.time_s).max() < 1e-5


def test_misplacement_is_the_drift_that_was_not_followed() -> None:
    followed = record()
    expected = (followed.drift_m - followed.drift_m[0]) - (followed.center_m - followed.center_m[0])
    np.testing.assert_allclose(followed.misplacement_m, expected)
    np.testing.assert_allclose(followed.sd_m, [[2e-9, 3e-9]] * 20)
    assert len(followed[3:8]) == 5


def test_the_drift_of_a_rotating_mapping_depends_on_the_tip_position() -> None:
    matrix = np.array([[1.0, -0.01, -5e-9], [0.01, 1.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(drift_at(matrix, (0.0, 0.0)), (5e-9, 0.0))
    np.testing.assert_allclose(drift_at(matrix, (0.0, 1e-6)), (15e-9, 0.0), atol=1e-20)


@pytest.mark.parametrize("content", ["", "time,x\n1,2\n", "scan,time_s\na,b\n"])
def test_a_file_without_a_table_of_drift_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "other.csv"
    path.write_text(content, encoding="utf-8")
    if content:
        with pytest.raises(FileError, match="not a table of drift"):
            DriftRecord.read(path)
    else:
        assert len(DriftRecord.read(path)) == 0
    with pytest.raises(FileError, match="can't be read"):
        DriftRecord.read(tmp_path / "missing.csv")
