"""Exports contain the measurements, as other programs read them."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from picture_borders import cut_sides
from record_lab import REGION, Night

import afspm
from afspm.basics.errors import FileError, InvalidValue, NoSuchItem
from afspm.drawing.plotting import save_figure
from afspm.model import Region, Scan, ScopeState, Spectrum
from afspm.model.line_levelling import flattened
from afspm.night.run import Run
from afspm.record.store import RecordStore
from afspm.report.export import chosen, eln, export, png

ORCID = "https://orcid.org/0000-0002-1825-0097"


@pytest.fixture
def run(night: Night, store: RecordStore, tmp_path: Path) -> Run:
    store.take([night.control(), *night.whole_scan(1), *night.whole_scan(2)])
    store.take([night.state(ScopeState.SCANNING), night.lines(2), night.state(ScopeState.INTERRUPTED)])
    store.take([night.state(ScopeState.SPEC), night.spectrum(), night.state(ScopeState.FREE)])
    return afspm.open_run(tmp_path)


def parsed(data: bytes) -> dict[str, Any]:
    """Return a .gwy file as nested dicts, parsed by the description of the format alone."""
    assert data[:4] == b"GWYP"
    (name, content), end = _object(data, 4)
    assert (name, end) == ("GwyContainer", len(data))
    return content


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


def _object(data: bytes, at: int) -> tuple[tuple[str, dict[str, Any]], int]:
    name, at = _text(data, at)
    (size,) = struct.unpack_from("<I", data, at)
    at, end, items = at + 4, at + 4 + size, {}
    while at < end:
        key, at = _text(data, at)
        kind, at = chr(data[at]), at + 1
        items[key], at = _value(kind, data, at)
    assert at == end
    return (name, items), end


def _value(kind: str, data: bytes, at: int) -> tuple[Any, int]:
    if kind == "b":
        return bool(data[at]), at + 1
    if kind in "id":
        form, size = {"i": ("<i", 4), "d": ("<d", 8)}[kind]
        return struct.unpack_from(form, data, at)[0], at + size
    if kind == "s":
        return _text(data, at)
    if kind == "o":
        return _object(data, at)
    (count,) = struct.unpack_from("<I", data, at)
    at += 4
    if kind == "D":
        return np.frombuffer(data, "<f8", count, at), at + 8 * count
    assert kind == "O", kind
    found = []
    for _ in range(count):
        one, at = _object(data, at)
        found.append(one)
    return found, at


def test_gwyddion_gets_every_channel_with_place_and_units(run: Run, tmp_path: Path) -> None:
    files = list(export(run, "gwy", tmp_path / "out", "1"))
    assert [file.name for file in files] == ["0001.gwy"]
    content = parsed(files[0].read_bytes())
    for number, (channel, scan) in enumerate(run.scan(0).items()):
        kind, field = content[f"/{number}/data"]
        assert (kind, content[f"/{number}/data/title"]) == ("GwyDataField", channel)
        assert (field["xres"], field["yres"]) == (8, 6)
        assert np.array_equal(field["data"].reshape(6, 8)[::-1], scan.values)
        # the sides of Gwyddion are those of whole pixels
        assert field["xreal"] == pytest.approx(REGION.size_m[0] * 8 / 7)
        assert field["xoff"] + field["xreal"] / 2 == pytest.approx(REGION.center_m[0])
        assert field["yoff"] + field["yreal"] / 2 == pytest.approx(-REGION.center_m[1])
        assert field["si_unit_xy"] == field["si_unit_z"] == ("GwySIUnit", {"unitstr": "m"})
        assert content[f"/{number}/meta"][1]["in_control"] == "series"


def test_independent_reader_of_gwyddion_files_reads_them(run: Run, tmp_path: Path) -> None:
    import gwyfile.util  # a reader by others

    (file,) = export(run, "gwy", tmp_path / "out", "2")
    channels = gwyfile.util.get_datafields(gwyfile.load(str(file)))
    assert {name: field.data.shape for name, field in channels.items()} == {"Height": (6, 8), "Height Retrace": (6, 8)}
    assert np.array_equal(channels["Height"].data[::-1], run.scan(1)["Height"].values)


def test_unmeasured_pixels_are_masked_for_gwyddion(run: Run, tmp_path: Path) -> None:
    (file,) = export(run, "gwy", tmp_path / "out", "3")
    content = parsed(file.read_bytes())
    mask = content["/0/mask"][1]["data"].reshape(6, 8)[::-1]
    assert np.array_equal(mask.astype(bool), np.isnan(run.scan(2)["Height"].values))
    assert np.isfinite(content["/0/data"][1]["data"]).all()


def test_gwyddion_gets_the_curves_of_a_spectrum(run: Run, tmp_path: Path) -> None:
    file = next(file for file in export(run, "gwy", tmp_path / "out") if file.name.startswith("spectrum-0001"))
    model = parsed(file.read_bytes())["/0/graph/graph/1"][1]
    ((kind, curve),) = model["curves"]
    assert (kind, model["y_unit"][1]["unitstr"], curve["description"]) == ("GwyGraphCurveModel", "A", "Current")
    assert np.array_equal(curve["ydata"], run.spectrum(0)["Current"])


def spectra_of_a_grid(night: Night, store: RecordStore, folder: Path) -> Run:
    """Record two rows of three spectra; the current at a bias of 1 V is 1, 2 … 6 A."""
    bias = np.linspace(-1.0, 2.0, 31)
    for number in range(6):
        place = (number % 3 * 2e-9, number // 3 * 3e-9)
        values = np.column_stack((bias, (number + 1) * bias, (number + 1) * bias))
        taken = Spectrum(place, "IV", ("Bias", "Current", "Current Retrace"), ("V", "A", "A"), values, night.now_ns)
        store.take([night.state(ScopeState.SPEC), night.packet(taken, "Spec1d_IV"), night.state(ScopeState.FREE)])
    return afspm.open_run(folder)


def test_spectra_of_a_grid_are_volume_data_for_gwyddion(night: Night, store: RecordStore, tmp_path: Path) -> None:
    import gwyfile  # a reader by others

    *_, file = export(spectra_of_a_grid(night, store, tmp_path), "gwy", tmp_path / "out")
    assert file.name == "grid-01-IV.gwy"
    content = gwyfile.load(str(file))
    assert [content[f"/brick/{number}/title"] for number in (0, 1)] == ["Current, forward", "Current, backward"]
    brick = content["/brick/0"]
    assert (brick["xres"], brick["yres"], brick["zres"]) == (3, 2, 31)
    planes = brick["data"].reshape(31, 2, 3)
    assert planes[20].tolist() == pytest.approx(np.array([[4, 5, 6], [1, 2, 3]]))  # at 1 V, y downwards
    assert (brick["xreal"], brick["xoff"], brick["yoff"]) == pytest.approx((6e-9, -1e-9, -4.5e-9))
    assert (brick["zoff"], brick["zreal"]) == pytest.approx((-1.05, 3.1))
    assert [brick[f"si_unit_{axis}"]["unitstr"] for axis in "xyzw"] == ["m", "m", "V", "A"]


def test_spectra_of_a_grid_are_one_nexus_file(night: Night, store: RecordStore, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    *_, name = export(spectra_of_a_grid(night, store, tmp_path), "h5", tmp_path / "out")
    with h5py.File(name) as file:
        data = file["entry"][file["entry"].attrs["default"]]
        assert list(data.attrs["axes"]) == ["y", "x", "bias"]
        assert data[data.attrs["signal"]][:, :, 20] == pytest.approx(np.array([[1, 2, 3], [4, 5, 6]]))
        assert data["x"][:].tolist() == pytest.approx([0.0, 2e-9, 4e-9])
        assert [data[name].attrs["role"] for name in ("bias", "current")] == ["bias", "current"]


ONE_WAY = np.linspace(-1.0, 2.0, 30)
THERE_AND_BACK = np.concatenate([np.arange(15.0), np.arange(15.0)[::-1]])
COLUMNS = [("Current", "Current Retrace"), ("I [fwd]", "I [bwd]"), ("Force",), ("Force Retrace",)]


@pytest.mark.parametrize("columns", COLUMNS)
@pytest.mark.parametrize("swept", [ONE_WAY, THERE_AND_BACK])
def test_file_of_a_grid_is_read_as_the_spectra_of_the_run(
    night: Night, store: RecordStore, tmp_path: Path, columns: tuple[str, ...], swept: np.ndarray
) -> None:
    for number in (0, 1, 2, 3, 5):  # of two rows of three that are turned, one is missing
        x, y = number % 3 * 2e-9, number // 3 * 3e-9
        place = (0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y)
        values = np.column_stack((swept, *((number + way) * swept**2 for way, _ in enumerate(columns))))
        units = ("V", *("A" for _ in columns))
        taken = Spectrum(place, "IV", ("Bias", *columns), units, values, night.now_ns)
        store.take([night.state(ScopeState.SPEC), night.packet(taken, "Spec1d_IV"), night.state(ScopeState.FREE)])
    run = afspm.open_run(tmp_path)
    *_, file = export(run, "h5", tmp_path / "out")
    found = afspm.read(file).spectra
    assert len(found) == 5
    for row, one in zip(run.spectra, found, strict=True):
        own = run.spectrum(row)
        assert (one.kind, one.names, one.units, one.frame) == (own.kind, own.names, own.units, own.frame)
        assert (one.time_ns, one.position_m) == (own.time_ns, pytest.approx(own.position_m, abs=1e-15))
        assert one.values == pytest.approx(own.values)
        assert one.roles.roles_of(one.names) == own.roles.roles_of(own.names)


def test_damaged_spectrum_is_missing_in_the_grid(night: Night, store: RecordStore, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    run = spectra_of_a_grid(night, store, tmp_path)
    (tmp_path / run.spectra[4].file).write_bytes(b"no file")
    told: list[str] = []
    *_, name = export(run, "h5", tmp_path / "out", tell=told.append)
    assert len(told) == 1
    with h5py.File(name) as file:
        assert np.isnan(file["entry/forward/current"][1, 1]).all()
        assert file["entry/forward/current"][1, 2, 20] == pytest.approx(6.0)


def test_spectrum_beside_a_grid_is_named_as_the_reason_why_there_is_no_file_of_the_grid(
    night: Night, store: RecordStore, tmp_path: Path
) -> None:
    bias = np.linspace(-1.0, 1.0, 5)
    places = [(x * 1e-7, y * 1e-7) for y in range(3) for x in range(4)]
    for place in [*places, (5.3e-6, 2.2e-6)]:
        values = np.column_stack((bias, bias))
        spectrum = Spectrum(place, "IV", ("Bias", "Current"), ("V", "A"), values, night.now_ns, "")
        store.take([night.packet(spectrum, "Spec1d_IV")])
    told: list[str] = []
    written = list(export(afspm.open_run(tmp_path), "gwy", tmp_path / "out", tell=told.append))
    assert len(written) == len(places) + 1
    (said,) = told
    assert said.startswith("13 spectra of kind IV are in no file of a grid: ")


def test_map_of_a_grid_is_a_scan(night: Night, store: RecordStore, tmp_path: Path) -> None:
    spectra = spectra_of_a_grid(night, store, tmp_path).spectra
    current = spectra.map("Current", at=1.0)
    assert current.values == pytest.approx(np.array([[1, 2, 3], [4, 5, 6]]))
    assert (current.unit, current.channel) == ("A", "Current at 1 V")
    assert current.region.size_m == pytest.approx((4e-9, 3e-9))
    by_role = spectra.map("current", at=1.0)
    assert by_role.values == pytest.approx(current.values)
    assert (by_role.unit, by_role.channel) == ("A", "current at 1 V")
    slope = spectra.map(lambda one: float(np.polyfit(one["Bias"], one["Current"], 1)[0]), unit="S")
    assert slope.values == pytest.approx(current.values)
    assert slope.channel == "map"
    assert spectra.map(lambda one: one["Current"].max(), unit="A", name="largest current").channel == "largest current"
    assert spectra.map("Current", at=1.0, name="current").channel == "current"
    with pytest.raises(InvalidValue, match=r"map returned \[.*\] for a spectrum, not a number"):  # users N7
        spectra.map(lambda one: list(one["Current"]))  # type: ignore[arg-type,return-value]


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"quantity": "Current", "at": 3.0}, "swept from -1 to 2 V, not to 3 V"),
        ({"quantity": "Current"}, "give at="),
        ({"quantity": "Force", "at": 1.0}, "no variable 'Force'"),
        ({"quantity": "current", "at": 3.0}, "the bias was swept from -1 to 2 V, not to 3 V"),
        ({"quantity": "force", "at": 1.0}, "no 'force' was measured"),
        ({"quantity": "Current", "at": 1.0, "direction": "up"}, "there is forward, backward"),
    ],
)
def test_map_of_an_unknown_quantity_is_refused(
    night: Night, store: RecordStore, tmp_path: Path, asked: dict[str, Any], why: str
) -> None:
    spectra = spectra_of_a_grid(night, store, tmp_path).spectra
    with pytest.raises(InvalidValue, match=re.escape(why)):
        spectra.map(**asked)
    with pytest.raises(InvalidValue, match="at least two columns"):
        spectra[:3].map("Current", at=1.0)


def test_netcdf_is_read_by_xarray(run: Run, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("scipy")
    files = list(export(run, "nc", tmp_path / "out"))
    assert len(files) == 4
    with xarray.open_dataset(files[0], engine="scipy") as found:
        assert np.array_equal(found["height"].values, run.scan(0)["Height"].values)
        assert (found["height"].units, found["x"].units, found.in_control) == ("m", "m", "series")
        assert float(found["y"][-1]) == pytest.approx(-1.75e-6)
    with xarray.open_dataset(files[-1], engine="scipy") as found:
        assert np.array_equal(found["current"].values, run.spectrum(0)["Current"])


def test_pictures_are_there_for_every_channel(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    names = [file.name for file in export(run, "png", tmp_path / "out")]
    assert names[:2] == ["0001_Height.png", "0001_Height_Retrace.png"]
    assert len(names) == 2 + 2 + 1 + 1
    assert all((tmp_path / "out" / name).read_bytes().startswith(b"\x89PNG") for name in names)


SIDES = {"square": (1e-6, 1e-6), "wide": (3e-6, 0.6e-6), "high": (0.5e-6, 4e-6)}


def of_size(size_m: tuple[float, float]) -> Scan:
    values = 1e-9 * np.random.default_rng(1).normal(size=(24, 32))
    return Scan(Region((0.0, 0.0), size_m, 0.2), "Height (retrace)", "m", values)


def curve() -> Spectrum:
    volts = np.linspace(-1.0, 1.0, 50)
    values = np.column_stack([volts, 1e-9 * volts**3, 1e-10 * volts])
    return Spectrum((0.0, 0.0), "IV", ("bias", "current", "conductance"), ("V", "A", "S"), values)


def exported(name: str) -> Callable[[Path], None]:
    return lambda path: save_figure(png.scan_figure(of_size(SIDES[name]), "a title"), path, 100)


def plotted(kind: str, name: str) -> Callable[[Path], None]:
    def plot(path: Path) -> None:
        from matplotlib.figure import Figure

        figure = of_size(SIDES[name]).plot(kind).figure
        assert isinstance(figure, Figure)
        figure.savefig(path)

    return plot


BORDERED: dict[str, Callable[[Path], None]] = {
    **{f"export, {name}": exported(name) for name in SIDES},
    **{f"plot, {name}": plotted("image", name) for name in SIDES},
    "surface": plotted("surface", "square"),
    "export, curve": lambda path: save_figure(png.spectrum_figure(curve(), "a title"), path, 100),
}


@pytest.mark.parametrize("name", BORDERED)
def test_nothing_is_cut_at_the_border_of_a_picture(name: str, tmp_path: Path) -> None:
    # users N1: labels were half outside
    pytest.importorskip("matplotlib")
    BORDERED[name](tmp_path / "picture.png")
    assert cut_sides(tmp_path / "picture.png") == []


def test_pictures_of_one_channel_are_asked_for_by_role(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    names = [file.name for file in export(run, "png", tmp_path / "out", "1-2", channels=["Height Retrace"])]
    assert names == ["0001_Height_Retrace.png", "0002_Height_Retrace.png"]
    with pytest.raises(NoSuchItem, match="there are Height"):
        list(export(run, "pdf", tmp_path / "out", "1", channels=["current"]))
    with pytest.raises(InvalidValue, match="--channel is for pictures"):
        list(export(run, "gwy", tmp_path / "out", channels=["Height"]))


def test_text_of_a_figure_for_print_is_text(run: Run, tmp_path: Path) -> None:
    # some journals refuse fonts of type 3
    pytest.importorskip("matplotlib")
    (file, _) = export(run, "pdf", tmp_path / "out", "1")
    assert b"/Type3" not in file.read_bytes()
    assert b"/TrueType" in file.read_bytes() or b"/CIDFontType2" in file.read_bytes()


def test_figures_for_print_are_those_of_each_measurement_and_of_the_night(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "targets.pdf").write_bytes(b"%PDF of a survey")
    names = [file.name for file in export(run, "pdf", tmp_path / "out")]
    assert names[:4] == ["night.pdf", "targets.pdf", "0001_Height.pdf", "0001_Height_Retrace.pdf"]
    assert all((tmp_path / "out" / name).read_bytes().startswith(b"%PDF") for name in names)
    assert [file.name for file in export(run, "pdf", tmp_path / "one", "1")] == names[2:4]


def test_pictures_of_heights_have_levelled_lines_and_say_so(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    drawn: list[tuple[Scan, str]] = []
    draw = png.scan_figure
    monkeypatch.setattr(png, "scan_figure", lambda scan, title: drawn.append((scan, title)) or draw(scan, title))
    assert len(list(export(run, "png", tmp_path / "out", "1"))) == 2
    scan, title = drawn[0]
    assert "Height, lines levelled, " in title
    np.testing.assert_array_equal(scan.values, flattened(run.scan(0)["Height"].values))


def test_tables_have_their_columns_even_if_they_are_empty(run: Run, tmp_path: Path) -> None:
    files = {file.name: file for file in export(run, "csv", tmp_path / "out")}
    with files["scans.csv"].open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["number"] for row in rows] == ["1", "2", "3"]
    assert rows[0]["time"].startswith("2026-03-14T20:00:00.")
    assert [row["interrupted"] for row in rows] == ["False", "False", "True"]
    assert files["drift.csv"].read_text(encoding="utf-8").startswith("time,x_m,y_m,rate_x_m_s")
    curve = files["spectrum-0001.csv"].read_text(encoding="utf-8").splitlines()
    assert curve[0] == "Bias [V],Current [A],dI/dV [S]"
    assert float(curve[1].split(",")[1]) == run.spectrum(0)["Current"][0]


# users N13
def test_picture_is_laid_out_without_drawing_it(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    draw = Figure.draw
    monkeypatch.setattr(Figure, "draw", lambda figure, renderer: drawn.append(figure) or draw(figure, renderer))
    pictures = len(list(export(run, "png", tmp_path, "1")))
    assert len(drawn) == 2 * pictures, "savefig alone draws twice"


# users N6
def test_tables_for_excel_have_its_separators_and_the_mark_of_utf8(run: Run, tmp_path: Path) -> None:
    files = {file.name: file for file in export(run, "excel", tmp_path / "out")}
    plain = {file.name: file for file in export(run, "csv", tmp_path / "plain")}
    assert files.keys() == plain.keys()
    assert all(file.read_bytes().startswith(b"\xef\xbb\xbf") for file in files.values())
    assert not any(file.read_bytes().startswith(b"\xef\xbb\xbf") for file in plain.values())
    with files["scans.csv"].open(encoding="utf-8-sig", newline="") as file:
        first = next(csv.DictReader(file, delimiter=";"))
    assert re.fullmatch(r"2026-03-14 20:00:00,\d{3}", first["time"])
    header, curve = files["spectrum-0001.csv"].read_text(encoding="utf-8-sig").splitlines()[:2]
    assert header == "Bias [V];Current [A];dI/dV [S]"
    assert "." not in curve
    assert float(curve.split(";")[1].replace(",", ".")) == run.spectrum(0)["Current"][0]


@pytest.mark.parametrize(("numbers", "meant"), [("2", [2]), ("1-2", [1, 2]), ("3, 1", [3, 1]), ("2-", [2, 3])])
def test_scans_are_chosen_by_their_numbers(run: Run, numbers: str, meant: list[int]) -> None:
    assert [row.number for row in chosen(list(run.scans), numbers)] == meant


@pytest.mark.parametrize("numbers", ["", "x", "0", "4", "1-9", "2-1", "2-1,3", "1-999999999999999", "1;2"])
def test_unknown_scan_is_refused(run: Run, numbers: str) -> None:
    with pytest.raises(InvalidValue):
        chosen(list(run.scans), numbers)


def test_unknown_format_and_an_impossible_folder_are_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match="no format 'doc'"):
        list(export(run, "doc", tmp_path))
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="can't be written"):
        list(export(run, "gwy", tmp_path / "file"))


@pytest.mark.parametrize("to", ["gwy", "nc", "png"])
def test_damaged_file_costs_its_own_measurement_only(run: Run, tmp_path: Path, to: str) -> None:
    if to == "png":
        pytest.importorskip("matplotlib")
    whole = len(list(export(run, to, tmp_path / "whole")))
    with (tmp_path / run.scans[1].file).open("r+b") as file:
        file.truncate(1000)
    told: list[str] = []
    assert 0 < len(list(export(run, to, tmp_path / "out", tell=told.append))) < whole
    (said,) = told
    assert str(Path(run.scans[1].file)) in said


def test_deleted_file_is_named_in_the_archive_and_costs_nothing_else(run: Run, tmp_path: Path) -> None:
    scan, spectrum = run.scans[1].file, run.spectra[0].file
    for file in (scan, spectrum):
        (tmp_path / file).unlink()
    told: list[str] = []
    (path,) = export(run, "eln", tmp_path / "out", tell=told.append)
    assert [Path(scan).name in told[0], Path(spectrum).name in told[1], len(told)] == [True, True, 2]
    with zipfile.ZipFile(path) as container:
        names = {name.partition("/")[2].partition("/")[2] for name in container.namelist()}
        crate = json.loads(container.read(f"{path.stem}/ro-crate-metadata.json"))
    assert run.scans[0].file in names
    assert run.scans[2].file in names
    assert not {scan, spectrum} & names
    (experiment,) = (node for node in crate["@graph"] if node.get("genre") == "experiment")
    assert f"missing here</h2><ul><li>{scan}</li><li>{spectrum}</li></ul>" in experiment["text"]
    assert "2 scans and 0 spectra" in experiment["description"]


def test_film_is_made_of_the_files_that_are_there(night: Night, store: RecordStore, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    store.take([night.control(), *night.whole_scan(1), *night.whole_scan(2), *night.whole_scan(3)])
    run = afspm.open_run(tmp_path)
    (tmp_path / run.scans[0].file).unlink()
    told: list[str] = []
    assert [file.suffix for file in export(run, "gif", tmp_path / "out", tell=told.append)] == [".gif"]
    assert len(told) == 1


def test_packets_of_a_damaged_file_are_left_out_on_request(run: Run, tmp_path: Path) -> None:
    (tmp_path / run.scans[1].file).unlink()
    told: list[str] = []
    packets = list(run.packets(tell=told.append))
    assert [row.file for row in run.scans if any(str(Path(row.file)) in said for said in told)] == [run.scans[1].file]
    assert len({packet.envelope for packet in packets if packet.envelope.startswith("Scan2d")}) == 2


def test_scan_without_lines_is_reported_and_left_out(night: Night, store: RecordStore, tmp_path: Path) -> None:
    store.take([night.state(ScopeState.SCANNING), night.state(ScopeState.INTERRUPTED)])
    told: list[str] = []
    assert list(export(afspm.open_run(tmp_path), "gwy", tmp_path / "out", tell=told.append)) == []
    assert told == ["scan 1 was interrupted before anything of it was seen"]


def test_lab_notebook_archive_is_read_by_ro_crate(run: Run, tmp_path: Path) -> None:
    from rocrate.rocrate import ROCrate  # a reader by others

    (tmp_path / "run.json").write_text(
        json.dumps({"run": "1f", "metadata": {"sample": "gold", "person": "Ada L", "orcid": ORCID, "vendor": "V"}})
    )
    (path,) = export(run, "eln", tmp_path / "out")
    assert path.name == f"{tmp_path.name}.SIMULATED.eln"
    with zipfile.ZipFile(path) as container:
        assert {Path(name).parts[0] for name in container.namelist()} == {path.stem}
        container.extractall(tmp_path / "extracted")
    crate = ROCrate(tmp_path / "extracted" / path.stem)
    night = crate.dereference(f"./{tmp_path.name}/")
    assert night["name"].endswith("(SIMULATED)")
    assert "SIMULATED" in night["description"]
    assert night["author"].id == ORCID
    assert (night["author"]["givenName"], night["author"]["familyName"]) == ("Ada", "L")
    files = {part.id.split("/", 1)[1]: part for part in night["hasPart"]}
    assert {row.file for row in run.scans if row.file} <= files.keys()
    for name, entity in files.items():
        content = (tmp_path / "extracted" / path.stem / tmp_path.name / name).read_bytes()
        assert entity["sha256"] == hashlib.sha256(content).hexdigest()
        assert entity["contentSize"] == str(len(content))
    again = afspm.open_run(tmp_path / "extracted" / path.stem / tmp_path.name)
    assert [row.file for row in again.scans] == [row.file for row in run.scans]
    assert (again.scan(0)["Height"].values == run.scan(0)["Height"].values).all()


def test_lab_notebook_archive_of_chosen_scans_has_only_their_files(run: Run, tmp_path: Path) -> None:
    (path,) = export(run, "eln", tmp_path / "out", "2")
    with zipfile.ZipFile(path) as container:
        scans = [name for name in container.namelist() if name.endswith(".h5")]
        crate = json.loads(container.read(f"{path.stem}/ro-crate-metadata.json"))
    assert [Path(name).name for name in scans] == [Path(run.scans[1].file).name]
    assert "1 scan and 0 spectra" in next(node for node in crate["@graph"] if node["@id"] == "./")["description"]


def test_lab_notebook_archive_that_cannot_be_written_leaves_nothing(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(eln, "_file_node", full)
    with pytest.raises(FileError, match="can't be written"):
        list(export(run, "eln", tmp_path / "out"))
    assert list((tmp_path / "out").iterdir()) == []
