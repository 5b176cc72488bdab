"""What afspm exports it reads again: values, units, names, geometry and times, of turned frames too."""

from __future__ import annotations

import csv
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from record_lab import ABOUT, Night

import afspm
from afspm.model import (
    ChannelRoles,
    Frame,
    MeasurementConditions,
    Parameter,
    Region,
    Scan,
    ScanSet,
    ScopeState,
    Spectrum,
)
from afspm.model.variables import VariableRoles
from afspm.night.run import Run
from afspm.record.store import RecordStore
from afspm.report.export import export, gwyddion, netcdf
from afspm.storage.formats import FileContent

LENGTHS = st.floats(-1e-5, 1e-5)
SIZES = st.floats(1e-10, 1e-4)
NUMBERS = st.floats(-1e6, 1e6) | st.just(float("nan"))
UNITS = st.sampled_from(["m", "V", "", "m/sqrt(Hz)", "µm", "deg"])
NAMES = st.lists(
    st.sampled_from(["Height", "Height Retrace", "height", "x", "y", "x_m", "2 ω", "Höhe €"]), min_size=2, max_size=3,
    unique=True,
)  # fmt: skip
REGIONS = st.builds(
    Region,
    st.tuples(LENGTHS, LENGTHS),
    st.tuples(SIZES, SIZES),
    st.floats(-3.2, 3.2) | st.just(0.0),
)
FEW = settings(max_examples=12, deadline=None, phases=[Phase.generate])
"""Without shrinking: each example is recorded and exported, through real files."""
EXACT = ["h5", "nc", "gwy"]
"""Formats that `afspm.read` reads without loss."""


@st.composite
def scans(draw: st.DrawFn) -> list[Scan]:
    region, shape = draw(REGIONS), draw(st.tuples(st.integers(2, 4), st.integers(2, 4)))
    return [
        Scan(region, name, draw(UNITS), np.array(draw(_many(shape[0] * shape[1]))).reshape(shape), 5, "one.dat")
        for name in draw(NAMES)
    ]


@st.composite
def spectra(draw: st.DrawFn) -> Spectrum:
    names, points = draw(NAMES), draw(st.integers(1, 4))
    values = np.array([draw(_many(points)) for _ in names]).T
    position = draw(st.none() | st.tuples(LENGTHS, LENGTHS))
    units = tuple(draw(UNITS) for _ in names)
    return Spectrum(position, "IV", tuple(names), units, values, 7, "one.dat")


def _many(count: int) -> st.SearchStrategy[list[float]]:
    return st.lists(NUMBERS, min_size=count, max_size=count)


def recorded(folder: Path, things: list[Scan] | list[Spectrum]) -> Run:
    (folder / "run").mkdir()
    night, store = Night(), RecordStore(folder / "run", ABOUT)
    states = (ScopeState.SPEC if isinstance(things[0], Spectrum) else ScopeState.SCANNING, ScopeState.FREE)
    envelopes = [f"Scan2d_1_{one.channel}" if isinstance(one, Scan) else "Spec1d_IV" for one in things]
    roles = ChannelRoles({"height, retrace": (things[0].channel,)} if isinstance(things[0], Scan) else {})
    store.take([night.packet(roles.with_topography(feedback_on=None))])
    packets = [night.packet(one, envelope) for one, envelope in zip(things, envelopes, strict=True)]
    store.take([night.control(), night.state(states[0]), *packets, night.state(states[1])])
    store.close()
    return afspm.open_run(folder / "run")


def exported(run: Run, to: str, folder: Path) -> FileContent:
    (path,) = (path for path in export(run, to, folder / to) if path.name.startswith(("0001", "spectrum-0001")))
    return afspm.read(path)


@pytest.mark.parametrize("to", EXACT)
@FEW
@given(scans())
def test_exported_scan_is_read_as_it_was_measured(to: str, measured: list[Scan]) -> None:
    with TemporaryDirectory() as folder:
        run = recorded(Path(folder), measured)
        found = exported(run, to, Path(folder))
        assert found.end_ns == run.scans[0].time_ns
        assert found.start_ns == run.scans[0].began_ns
        there = run.scan(0)  # the wire format rounds the place of a frame
        run.close()
    assert [*there] == [scan.channel for scan in measured]
    for one, expected in zip(found.scans, there.values(), strict=True):
        np.testing.assert_array_equal(one.values, expected.values)
        assert one.region == expected.region
        assert one.roles == expected.roles == (("height, retrace",) if one is found.scans[0] else ())
        assert (one.channel, one.unit, one.filename) == (expected.channel, expected.unit, expected.filename)
        assert one.time_ns == (found.end_ns if to == "gwy" else expected.time_ns)


@pytest.mark.parametrize("to", EXACT)
@FEW
@given(spectra())
def test_exported_spectrum_is_read_as_it_was_measured(to: str, measured: Spectrum) -> None:
    with TemporaryDirectory() as folder:
        run = recorded(Path(folder), [measured])
        (found,) = exported(run, to, Path(folder)).spectra
        assert found.position_m == run.spectrum(0).position_m
        run.close()
    np.testing.assert_array_equal(found.values, measured.values)
    assert (found.names, found.units, found.kind) == (measured.names, measured.units, measured.kind)
    assert (found.time_ns, found.filename) == (measured.time_ns, measured.filename)


@pytest.mark.parametrize("to", ["h5", "nc"])
def test_roles_and_settings_in_force_are_kept_in_an_export(
    to: str, night: Night, store: RecordStore, tmp_path: Path
) -> None:
    roles = VariableRoles.declared({"height": ["Ext"], "deflection": ["D"]}, towards=["Ext"])
    values = np.column_stack((np.linspace(0.0, 1.0, 5), np.ones(5)))
    curve = Spectrum((0.0, 0.0), "force", ("Ext", "D"), ("um", "nm"), values, night.now_ns, "a.ibw")
    stiff = (Parameter("x-spring-constant", "0.4", "N/m"),)
    conditions = MeasurementConditions(night.now_ns, "a.ibw", begin_in_force=stiff, end_in_force=stiff)
    store.take([night.packet(ChannelRoles(variables=roles)), night.packet(conditions), night.packet(curve, "Spec1d_f")])
    with afspm.open_run(tmp_path) as run:
        (found,) = exported(run, to, tmp_path).spectra
    assert found.of("height") == pytest.approx(-np.linspace(0.0, 1e-6, 5))
    assert found.of("force") == pytest.approx(0.4e-9)
    assert found.caption() == "k = 0.4 N/m"


def test_exported_scan_is_read_by_others_with_its_roles(night: Night, store: RecordStore, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    bias = (Parameter("tip-bias-voltage", "0.1", "V"),)
    conditions = MeasurementConditions(night.now_ns + 2_000_000, "scan-0001.nc", begin_in_force=bias)
    roles = ChannelRoles({"height": ("Height",)})
    store.take([night.packet(roles), night.packet(conditions), *night.whole_scan(1)])
    with afspm.open_run(tmp_path) as run:
        (path,) = (path for path in export(run, "nc", tmp_path / "out") if path.name.startswith("0001"))
        (first, _) = afspm.read(path).scans
    assert (first.roles, first.caption(), first.simulated) == (("height",), "V = 100 mV", True)
    with xarray.open_dataset(path) as others:
        assert others["height"].attrs["roles"] == "height"


@FEW
@given(spectra())
def test_table_of_a_spectrum_has_its_values_to_the_last_digit(measured: Spectrum) -> None:
    with TemporaryDirectory() as folder:
        run = recorded(Path(folder), [measured])
        (path,) = (path for path in export(run, "csv", Path(folder) / "csv") if path.name == "spectrum-0001.csv")
        run.close()
        header, *lines = csv.reader(path.read_text(encoding="utf-8").splitlines())
    assert header == [f"{name} [{unit}]" for name, unit in zip(measured.names, measured.units, strict=True)]
    np.testing.assert_array_equal(np.array(lines, dtype=np.float64), measured.values)


def test_frame_of_the_sample_is_kept(tmp_path: Path) -> None:
    scan = Scan(Region((0.0, 1e-6), (1e-6, 2e-6), 0.1, Frame.SAMPLE), "Height", "m", np.ones((2, 3)), 5)
    facts = {"time_ns": 5, "began_ns": None, "controller": ""}
    (tmp_path / "a.nc").write_bytes(netcdf.scan_file(ScanSet([scan]), {}, facts))
    about = {"center_m": [0.0, 1e-6], "size_m": [1e-6, 2e-6], "angle_rad": 0.1, "frame": "sample"}
    (tmp_path / "a.gwy").write_bytes(gwyddion.scan_file([scan], gwyddion.meta_of(about)))
    for path in tmp_path.iterdir():
        assert afspm.read(path).scans[0].region == scan.region


def test_pixels_of_a_turned_frame_lie_where_they_were_measured(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    region = Region((1e-6, -2e-6), (4e-7, 2e-7), 0.5)
    run = recorded(tmp_path, [Scan(region, "Height", "m", np.arange(12.0).reshape(3, 4), 5)])
    (path,) = export(run, "nc", tmp_path / "nc")
    run.close()
    with xarray.open_dataset(path, engine="scipy") as file:
        for name, places_m in zip(("x_m", "y_m"), region.pixels_m((3, 4)), strict=True):
            np.testing.assert_allclose(file[name].values, places_m, rtol=1e-12)
