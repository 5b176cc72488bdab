"""The tables of a run: rows by their keys, spectra as one array, tables in a notebook and for pandas."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from record_lab import REGION, Given, Night

import afspm
from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model import (
    ActByHand,
    ControlResponse,
    JournalEntries,
    JournalEntry,
    MeasurementConditions,
    PanelAct,
    Parameter,
    Scan,
    ScopeState,
    names,
)
from afspm.model.events import MeasurementSettings
from afspm.model.panel import ChangedValue
from afspm.model.state import FeedbackUnits
from afspm.night.tables import SweptSetting
from afspm.record.store import RecordStore
from afspm.report.export import export


def start(night: Night, key: str, action: str = names.START_SCAN, response: int = ControlResponse.SUCCESS) -> Given:
    """Return an entry in the scheduler's form: the answer comes later than the request."""
    night.now_ns += 1_000_000
    entry = JournalEntry(night.now_ns, "request", "survey", action, int(response), sent_ns=night.now_ns, key=key)
    return night.packet(JournalEntries((entry,)))


def test_scan_is_found_by_its_key(night: Night, store: RecordStore, tmp_path: Path) -> None:
    first, tile = start(night, "tile-1"), night.whole_scan(1)
    store.take([*tile, first])  # entries are published some at a time: perhaps after the scan
    store.take(night.whole_scan(2))  # begun at the controller, by hand
    refused = start(night, "tile-2", response=ControlResponse.NOT_FREE)
    store.take([refused, start(night, ""), *night.whole_scan(3)])
    store.take([start(night, "tile-2"), *night.whole_scan(4), start(night, "iv", names.START_SPEC), night.spectrum()])
    run = afspm.open_run(tmp_path)
    assert [row.key for row in run.scans] == ["tile-1", "", "", "tile-2"]
    assert run.scans["tile-2"].number == 4
    assert run.scan("tile-1").first.filename == "scan-0001.nc"
    assert run.spectra["iv"].number == 1
    assert run.spectrum("iv").kind == "IV"
    assert run.about(run.scans["tile-1"])["key"] == "tile-1"
    assert run.scans[1:]["tile-2"] is not None
    with pytest.raises(KeyError, match="no key 'tile-9'; there are tile-1, tile-2"):
        run.scan("tile-9")


def test_key_leads_to_the_whole_scan_after_a_run_was_cut_off_in_it(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    begun = [night.state(ScopeState.FREE), start(night, "tile-1"), night.state(ScopeState.SCANNING), night.lines()]
    store.take(begun)
    ended_ns = night.now_ns
    resumed = night.state(ScopeState.FREE)  # not INTERRUPTED: nobody saw the end of the scan
    store.take([resumed, start(night, "tile-1"), *night.whole_scan(1)])
    run = afspm.open_run(tmp_path)
    assert [(row.key, row.interrupted) for row in run.scans] == [("tile-1", True), ("tile-1", False)]
    assert run.scan("tile-1").first.filename == "scan-0001.nc"
    assert (run.scans[0].time_ns, run.scans[0].began_ns) == (ended_ns, ended_ns - 1_000_000)


def conditions(night: Night, filename: str, begin: tuple[Parameter, ...], end: tuple[Parameter, ...] = ()) -> Given:
    found = MeasurementConditions(night.now_ns, filename, begin_in_force=begin, end_in_force=end or begin)
    return night.packet(found)


BIAS, LOCK_IN = Parameter("tip-bias-voltage", "0.1", "V"), Parameter("x-lock-in-amplitude", "0.01", "V")


def test_settings_in_force_are_columns_and_fields_of_the_file(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:  # spectra F10
    pytest.importorskip("xarray")
    scanning = night.state(ScopeState.SCANNING)
    changed = (BIAS, Parameter("tip-bias-voltage", "50", "mV"))
    store.take([scanning, conditions(night, "scan-0001.nc", changed[:1], changed[1:]), *night.whole_scan(1)[1:]])
    store.take([conditions(night, "s", (BIAS, LOCK_IN)), night.spectrum()])
    run = afspm.open_run(tmp_path)
    columns = run.scans.columns()
    assert (columns["tip-bias-voltage [V]"], columns["tip-bias-voltage.end [V]"]) == ([0.1], [0.05])
    assert run.scans[0].caption() == run.scan(0).first.caption() == "V = 100 mV → 50 mV"
    assert run.scan(0).first.to_xarray().attrs["tip-bias-voltage"] == "100 mV → 50 mV"
    assert run.spectra.to_pandas()["x-lock-in-amplitude [V]"].tolist() == [0.01]
    assert run.spectrum(0).caption() == "V = 100 mV, lock-in amplitude = 10 mV"
    with h5py.File(tmp_path / run.scans[0].file) as file:
        fields = file["entry/afspm/in_force"]
        assert {name: (one[()], one.attrs["units"]) for name, one in fields.items()} == {
            "tip_bias_voltage": (0.1, "V"),
            "tip_bias_voltage_end": (0.05, "V"),
        }


def test_settings_of_another_implementation_are_those_of_its_states(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    units = night.packet(FeedbackUnits("", "", "V"))
    store.take([units, night.feedback(), night.state(ScopeState.FREE), *night.whole_scan(1)])
    run = afspm.open_run(tmp_path)
    assert run.scans.columns()["zctrl-setpoint [V]"] == [0.75]
    assert run.scan(0).first.caption() == "setpoint = 750 mV"
    assert "tip-bias-voltage [V]" not in run.scans.columns()


def test_record_without_keys_is_named_in_the_error(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    with pytest.raises(KeyError, match="nothing was measured under a key"):
        afspm.open_run(tmp_path).scans["a"]


def test_table_shows_itself_in_a_notebook(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take(night.whole_scan(1))
    store.take([start(night, "<b>"), *night.whole_scan(2)])
    shown = afspm.open_run(tmp_path).scans._repr_html_()
    assert "&lt;b&gt;" in shown
    assert "<b>" not in shown
    assert "<td" in shown
    assert "width / µm" in shown
    assert "2026-03-14 20:00:00" in shown
    assert "2 rows" in shown


def test_long_table_shows_its_ends(night: Night, store: RecordStore, tmp_path: Path) -> None:
    for number in range(1, 64):
        store.take(night.whole_scan(number))
    shown = afspm.open_run(tmp_path).scans._repr_html_()
    assert shown.count("<tr>") == 22
    assert "63 rows" in shown


def test_table_becomes_a_data_frame(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([*night.whole_scan(1), *night.whole_scan(2)])
    frame = afspm.open_run(tmp_path).scans.to_pandas()
    assert list(frame.number) == [1, 2]
    assert frame.width_m.mean() == pytest.approx(1e-6)
    assert str(frame.time_ns.dtype) == "datetime64[ns]"


def test_tables_and_stacks_without_their_packages_are_refused_with_the_extra(
    night: Night, store: RecordStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.take([*night.whole_scan(1), night.spectrum()])
    run = afspm.open_run(tmp_path)
    monkeypatch.setitem(sys.modules, "xarray", None)
    monkeypatch.setitem(sys.modules, "pandas", None)
    for convert in (run.scans.to_xarray, run.scans.to_pandas, run.spectra.stack):
        with pytest.raises(ConfigError, match=r'pip install "afspm\[xarray\]"'):
            convert()


def test_spectra_of_one_place_are_repeats(night: Night, store: RecordStore, tmp_path: Path) -> None:
    spectra = afspm.open_run(tmp_path).spectra
    with pytest.raises(InvalidValue, match="no spectra"):
        spectra.stack()
    store.take([night.spectrum()])
    stacked = afspm.open_run(tmp_path).spectra.stack()
    assert dict(stacked.sizes) == {"y": 1, "x": 1, "repeat": 1, "direction": 1, "z": 20}
    assert np.isfinite(stacked.Current.values).all()


def test_export_has_the_key_of_a_scan(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([start(night, "tile-1"), *night.whole_scan(1), *night.whole_scan(2)])
    with afspm.open_run(tmp_path) as run:
        first, second = (path for path in export(run, "h5", tmp_path / "h5"))
        list(export(run, "csv", tmp_path / "csv"))
    with h5py.File(first) as file:
        assert file["entry/afspm"].attrs["key"] == "tile-1"
    with h5py.File(second) as file:
        assert "key" not in file["entry/afspm"].attrs
    assert ",tile-1" in (tmp_path / "csv" / "scans.csv").read_text(encoding="utf-8")


def settings(
    night: Night, gain: str, key: str = "", who: str = "series", speed: str = "2", point: int | None = None
) -> Given:
    parameters = (Parameter("zctrl-igain", gain), Parameter("scan-speed", speed, "um/s")) if gain else ()
    return night.packet(MeasurementSettings(night.now_ns, who, parameters, key, point))


def test_swept_parameters_are_columns_of_the_scans(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([night.control(), *night.whole_scan(1)])  # before the sweep
    store.take([settings(night, "5", "sweep-1"), start(night, "sweep-1"), *night.whole_scan(2)])
    store.take([settings(night, "7", "sweep-2"), start(night, "sweep-2"), night.control("corrector")])
    store.take([*night.whole_scan(3), night.control()])  # of a component that has control meanwhile
    store.take([settings(night, "7", "sweep-2"), start(night, "sweep-2"), *night.whole_scan(4)])
    store.take([settings(night, ""), *night.whole_scan(5)])  # after the sweep
    scans = afspm.open_run(tmp_path).scans
    assert [row.holder for row in scans] == ["series", "series", "corrector", "series", "series"]
    frame = scans.to_pandas()
    assert frame["zctrl-igain"].tolist() == pytest.approx([np.nan, 5.0, np.nan, 7.0, np.nan], nan_ok=True)
    assert frame["scan-speed [m/s]"].tolist() == pytest.approx([np.nan, 2e-6, np.nan, 2e-6, np.nan], nan_ok=True)
    assert "settings" not in frame.columns
    assert afspm.open_run(tmp_path).about(scans[1])["settings"] == {"zctrl-igain": 5.0, "scan-speed [m/s]": 2e-6}
    assert "zctrl-igain" in scans._repr_html_()


# results C3: a swept value that a person had changed stood in the table as in force
def test_value_that_a_person_changed_meanwhile_is_in_no_column(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    store.take([night.control(), settings(night, "5", "sweep-1"), start(night, "sweep-1")])
    act = ActByHand(night.now_ns, PanelAct.VALUES, changes=(ChangedValue("zctrl-igain", "5", "9"),))
    begun = [night.state(ScopeState.SCANNING), night.lines()]
    store.take([*begun, night.packet(act), night.state(ScopeState.INTERRUPTED)])
    store.take([settings(night, "5", "sweep-1"), start(night, "sweep-1"), *night.whole_scan(2)])
    rows = afspm.open_run(tmp_path).scans
    assert [row.interrupted for row in rows] == [True, False]
    assert [[one.name for one in row.settings] for row in rows] == [["scan-speed"], ["zctrl-igain", "scan-speed"]]


@pytest.mark.parametrize("changed", ["tip-bias-voltage", "x-sample-bias"])
def test_swept_bias_of_the_sample_is_in_no_column_after_a_change_at_either_electrode(
    night: Night, store: RecordStore, tmp_path: Path, changed: str
) -> None:
    swept = MeasurementSettings(night.now_ns, "series", (Parameter("sample-bias", "1", "V"),), "sweep-1")
    act = ActByHand(night.now_ns + 1, PanelAct.VALUES, changes=(ChangedValue(changed, "0", "1", "V"),))
    store.take([night.control(), night.packet(swept), start(night, "sweep-1"), night.state(ScopeState.SCANNING)])
    store.take([night.lines(), night.packet(act), night.state(ScopeState.INTERRUPTED)])
    store.take([night.packet(swept), start(night, "sweep-1"), *night.whole_scan(2)])
    rows = afspm.open_run(tmp_path).scans
    assert [[one.name for one in row.settings] for row in rows] == [[], ["sample-bias"]]


def test_swept_parameters_are_columns_of_the_spectra(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([night.control(), settings(night, "5"), night.state(ScopeState.SPEC), night.spectrum()])
    spectra = afspm.open_run(tmp_path).spectra
    assert spectra.columns()["zctrl-igain"] == [5.0]


def test_a_record_without_a_sweep_has_no_column_of_it(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([night.control(), *night.whole_scan(1)])
    columns = afspm.open_run(tmp_path).scans.columns()
    assert not {"settings", "zctrl-igain"} & columns.keys()


def test_a_contact_sheet_shows_the_sweep(night: Night, store: RecordStore, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from afspm.report import sweep_sheet

    store.take([night.control(), *night.whole_scan(1)])
    with afspm.open_run(tmp_path) as run:
        assert list(sweep_sheet.figures(run, "night")) == [], "there was no sweep"
    for number, (gain, speed) in enumerate([("5", "1"), ("5", "2"), ("70", "2"), ("70", "1")], 2):
        store.take([settings(night, gain, speed=speed), *night.whole_scan(number)])
    with afspm.open_run(tmp_path) as run:
        (named,) = sweep_sheet.figures(run, "night")
    assert named[0] == "sweep"
    named[1].savefig(tmp_path / "sweep.png")
    assert (tmp_path / "sweep.png").stat().st_size > 10_000
    across = [text.get_text() for text in named[1].texts]
    assert across[-4:] == ["1 µm/s", "2 µm/s", "5", "70"]
    assert len(named[1].axes) == 4 + 1, "one colour bar"


@pytest.mark.parametrize(
    ("speeds", "columns"),
    [(["1", "2", "1"], ["1 µm/s", "2 µm/s", "1 µm/s"]), (["2", "2", "1", "1"], ["1 µm/s"] * 2 + ["2 µm/s"] * 2)],
)
def test_contact_sheet_has_a_column_for_each_point_of_equal_value(
    night: Night, store: RecordStore, tmp_path: Path, speeds: list[str], columns: list[str]
) -> None:
    pytest.importorskip("matplotlib")
    from afspm.report import sweep_sheet

    rows = [("5", speeds), ("70", speeds if len(speeds) == 3 else speeds[::-1])]  # a loop, or a snake of repeats
    points = [(gain, speed) for gain, along in rows for speed in along]
    store.take([night.control()])
    for number, (gain, speed) in enumerate(points, 1):
        store.take([settings(night, gain, speed=speed, point=number), *night.whole_scan(2 * number)])
        store.take([settings(night, gain, speed=speed, point=number), *night.whole_scan(2 * number + 1)])
    with afspm.open_run(tmp_path) as run:
        sheets = dict(sweep_sheet.figures(run, "night"))
        assert run.scans.columns()["point"] == [1 + n // 2 for n in range(2 * len(points))]
    assert list(sheets) == ["sweep", "sweep_2"], "each scan of a point has a sheet"
    for figure in sheets.values():
        texts = [text.get_text() for text in figure.texts]
        assert texts[-len(columns) - 2 :] == [*columns, "5", "70"]
        assert sum(bool(axes.images) for axes in figure.axes) == len(points)


def test_row_without_contrast_has_a_scale_of_its_own() -> None:
    pytest.importorskip("matplotlib")
    from afspm.report import sweep_sheet

    noise = np.random.default_rng(1).normal(size=(2, 2, 16, 16))
    noise[1, 0, 3] = np.nan

    def ranges(*, largest_m: float) -> list[tuple[float, float]]:
        scans = [
            (sweep_sheet.Panel((SweptSetting("gain", gain, ""), SweptSetting("scan-speed", speed, "m/s"))),
             Scan(REGION, "Height", "m", height_m * noise[row, column], 0, ""))
            for row, (gain, height_m) in enumerate([(5.0, 1e-9), (70.0, largest_m)])
            for column, speed in enumerate([1e-6, 2e-6])
        ]  # fmt: skip
        return [axes.images[0].get_clim() for axes in sweep_sheet.sheet(scans, "night").axes if axes.images]

    assert len(set(ranges(largest_m=2e-9))) == 1, "the same colours mean the same heights"
    good, _, oscillating, _ = found = ranges(largest_m=20e-9)
    assert len(set(found)) == 2
    assert 10e-9 > good[1] - good[0] < 0.1 * (oscillating[1] - oscillating[0])
