"""Every sample runs unchanged to its end; here with fewer pixels and scans.

The samples of tip repair and of makers' controllers run in other tests.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import math
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy import ndimage
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm
from afspm.simulation import World
from afspm.supervisor.ports import FreePorts

EXPERIMENTS = Path(__file__).parents[3] / "experiments"
SERIES = '[series]\nscans = 2\nevery = "2 min"\npixels = [16, 16]\n'
QUICKER: dict[str, tuple[str, int, int]] = {
    "keep_scanning": ('[series]\nduration = "15 min"\npixels = [16, 16]\n', 1, 0),
    "scan_list": ('[list]\nevery = "5 min"\npixels = [16, 8]\n', 6, 0),
    "sweep": ("[sweep]\npixels = [16, 16]\n[sweep.parameters]\nscan-speed = [8e-6]\n", 9, 0),
    "agent": ("", 1, 1),
    "region_grid": ("[grid]\ncounts = [2, 2]\npixels = [16, 16]\n", 4, 0),
    "adaptive_map": ("[map.until]\nspectra = 12\n", 0, 12),
    "other_sites": ("[sites]\nsites = 2\n", 2, 0),
    "three_spots": ("".join(f"[spot_{one}]\ncounts = [2, 2]\n" for one in "abc"), 0, 12),
    "spectroscopy_grid": ("[curves]\ncounts = [2, 2]\n", 0, 4),
    "line_watch": ("[series]\nscans = 2\npixels = [16, 16]\n", 2, 0),
    "picture": ("[clock]\nspeed = 600.0\n[details]\npixels = [16, 12]\n", 3, 0),
    "own_component": (SERIES, 2, 0),
    "other_language": ("[flattest]\npixels = 32\n", 2, 0),
    "two_computers": (SERIES, 2, 0),
    "wide_and_narrow": ("[list]\nrounds = 1\npixels = [16, 16]\n", 4, 0),
    "feedback_gains": ('[series]\nduration = "90 min"\npixels = [32, 32]\n', 4, 0),
    "best_points": ("[best_points]\nrounds = 1\nbest = 2\npixels = 32\n[random_points]\npoints = 5\n", 3, 0),
    "time_lapse": ("[series]\nscans = 3\npixels = [64, 64]\n", 4, 0),  # one of them by the Rescanner
    "constant_height": ('[stack]\npixels = 16\nheights = ["0 pm", "-100 pm"]\n', 3, 0),
    "particle_survey": ("[survey]\ncount = 2\n", 4, 4),  # one of them by the Rescanner
    "paper_form": ('scan_pixels = [16, 16]\n[series]\nduration = "10 min"\n', 1, 0),
}
"""What is other than in the sample, and how many scans and spectra come of it."""
FOR_A_TIME = {"feedback_gains", "keep_scanning", "paper_form"}  # and as many more as a busy computer finds time for
ADDRESS = re.compile(r'^(\w+) = "tcp://127\.0\.0\.1:\d+"$', re.MULTILINE)
SAYS = {
    "feedback_gains": (
        "is too slow",
        "tuner +integral gain 1280: the feedback follows",
        "oscillates",
        "integral gain 3120$",
    )
}
"""What the log has to say, in this order."""


def to_its_end(afspm_run: Run, tmp_path: Path, files: tuple[str, ...], quicker: str, *options: str) -> AfspmRun:
    """Run a reduced sample at free ports; it ends without an error."""
    samples, second, ports = [EXPERIMENTS / file for file in files], tmp_path / "quicker.toml", FreePorts()
    used = ADDRESS.findall(samples[0].read_text(encoding="utf-8"))
    second.write_text("".join(f'{use} = "{ports.address()}"\n' for use in used) + quicker, encoding="utf-8")
    one = afspm_run(*map(str, samples), str(second), "--runs", str(tmp_path / "runs"), *options)
    assert one.end() == 0, one.output
    assert not [line for line in one.lines if re.search(r" (ERROR|CRITICAL) ", line)], one.output
    return one


@pytest.mark.parametrize("name", QUICKER)
def test_a_sample_runs_to_its_end(afspm_run: Run, tmp_path: Path, name: str) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("PIL")
    quicker, scans, spectra = QUICKER[name]
    one = to_its_end(afspm_run, tmp_path, (f"{name}/experiment.toml",), quicker)
    assert re.search(".*".join(SAYS.get(name, ())), one.output, re.DOTALL | re.MULTILINE), one.output
    with afspm.open_run(one.folder) as record:
        taken = min(len(record.scans), scans) if name in FOR_A_TIME else len(record.scans)
        assert (taken, len(record.spectra)) == (scans, spectra), one.output


# at 240 times real time a busy computer takes scans late
SHORT_NIGHT = """
[clock]
speed = 120.0
[series]
every = "5 min"
scans = 7
pixels = [64, 64]
[scheduler.drift]
correct_after = "15 min"
"""
NIGHT = "drift_night/experiment.toml"
TABLE = '[drift_table]\ncomponent = true\nclass = "DriftTable"\n'
SHORT_SERIES = '[experiment]\nevery = "6 min"\nscans = 7\n'


# The paper's method extrapolates by the difference of two estimates, each half a pixel uncertain: on an idle computer
# the frame was up to 1.5 pixels off in one night of three. Without any correction it would be 5 pixels off
@pytest.mark.parametrize(
    ("files", "quicker", "pixels"),
    [
        ((NIGHT, "drift_night/simulator.toml"), SHORT_NIGHT + TABLE, 1.0),
        ((NIGHT, "drift_night/simulator.toml", "drift_night/paper.toml"), SHORT_NIGHT + TABLE, 2.0),
        (("paper_form/drift.toml",), SHORT_SERIES + TABLE, 1.0),
    ],
    ids=["drift_night", "drift_night-paper", "published"],
)
def test_drift_night_runs_and_its_frame_follows_the_sample(
    afspm_run: Run, tmp_path: Path, files: tuple[str, ...], quicker: str, pixels: float
) -> None:
    if "drift_night/paper.toml" in files:
        pytest.importorskip("skimage")
    pictures = ("--without", "drift_pictures") if "drift_night" in files[0] else ()  # they take longer than the night
    one = to_its_end(afspm_run, tmp_path, files, quicker, *pictures)
    with (one.folder / "drift_correction.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 7, one.output
    assert [row["reason"] for row in rows if row["matched"] != "yes"] == []
    assert {row["correcting"] for row in rows[-3:]} == {"yes"}
    drift_m, center_m = (
        np.array([[float(row[f"{what}_{axis}_m"]) for axis in "xy"] for row in rows[-3:]])
        for what in ("drift", "center")
    )
    pixel_m = 2e-6 / 64
    assert np.hypot(*drift_m[-1]) > 3 * pixel_m, "the sample stood still"
    off_m = np.hypot(*(center_m - drift_m).T)  # at a time more, where a busy computer has left scans out
    assert np.median(off_m) < pixels * pixel_m, "the frame is not where the sample has gone"


def true_world(folder: Path) -> World:
    """Return the simulated world of a run, as it was at the start."""
    first = json.loads((folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    return World.from_settings(first["settings"], int(first["seed"]), float(first["time_s"]))


@pytest.mark.parametrize(("exponent", "true"), [(2.0, "diffuse"), (8.0, "sharp")])
def test_hypotheses_decides_for_the_true_shape_of_the_spot(
    afspm_run: Run, tmp_path: Path, exponent: float, true: str
) -> None:
    quicker = f"[microscope]\nproperty_map = {{ spot_exponent = {exponent} }}\n"
    one = to_its_end(afspm_run, tmp_path, ("hypotheses/experiment.toml",), quicker)
    decision = json.loads((one.folder / "decision.json").read_text(encoding="utf-8"))
    assert decision["decision"] == true, one.output
    assert 0.99 <= decision["probability"] < 1.0
    with afspm.open_run(one.folder) as record:
        assert len(record.spectra) == decision["spectra"] < 49  # 7 x 7: see the comparison below
    axis_m = np.linspace(-0.5e-6, 0.5e-6, 201)
    gap_ev = true_world(one.folder).property_map.at(axis_m[None, :], axis_m[:, None])
    inside = gap_ev > (gap_ev.min() + gap_ev.max()) / 2
    row, column = ndimage.center_of_mass(inside)
    center_m = np.interp([column, row], np.arange(201), axis_m)
    half_width_m = math.sqrt(inside.sum() / math.pi) * (axis_m[1] - axis_m[0])
    assert math.dist(decision["center_m"], center_m) < 0.15 * half_width_m
    assert decision["half_width_m"] == pytest.approx(half_width_m, rel=0.15)
    assert (one.folder / "decision.png").stat().st_size > 30_000


def sample_module(monkeypatch: pytest.MonkeyPatch, file: str) -> ModuleType:
    """Import a module of a sample, whose neighbours it finds by their names."""
    path = EXPERIMENTS / file
    monkeypatch.syspath_prepend(str(path.parent))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SPOTS = 6
"""How many spots of each shape are compared: 40 gave the figures in the README of the sample."""


def curves_until_clear(spots: ModuleType, true: str, seed: int, *, chosen: bool) -> tuple[int, str]:
    """Return the curves that a decision took, and the decision: chosen places, or ever finer complete lattices."""
    random = np.random.default_rng(seed)
    spot = (
        1.0,
        random.choice([-1, 1]) * random.uniform(0.1, 0.3),
        *random.uniform(-0.2, 0.2, 2),
        random.uniform(0.13, 0.25),
    )

    def lattice(count: int) -> np.ndarray:
        axis = np.linspace(-0.5, 0.5, count)
        return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)

    def measured(places: np.ndarray) -> np.ndarray:
        return np.asarray(spots.spot(true, places, *spot) + 0.02 * random.standard_normal(len(places)))

    places, count, candidates = lattice(4), 4, lattice(25)
    gaps = measured(places)
    while True:
        better, probability, fits = spots.judged(places, gaps)
        if probability >= 0.99 or len(gaps) > 150:
            return len(gaps), better
        if chosen:
            place = candidates[[spots.difference(fits, candidates).argmax()]]
            places, gaps = np.vstack([places, place]), np.append(gaps, measured(place))
        else:
            count += 1
            places = lattice(count)
            gaps = measured(places)


@pytest.mark.parametrize("true", ["diffuse", "sharp"])
def test_chosen_places_of_hypotheses_need_fewer_curves_than_lattices(
    monkeypatch: pytest.MonkeyPatch, true: str
) -> None:
    spots = sample_module(monkeypatch, "hypotheses/spots.py")
    chosen, lattices = (
        [curves_until_clear(spots, true, seed, chosen=which) for seed in range(SPOTS)] for which in (True, False)
    )
    assert sum(decision == true for _, decision in chosen) >= SPOTS - 1
    assert np.median([count for count, _ in chosen]) < 0.7 * np.median([count for count, _ in lattices])


def true_defects(world: World, half_m: float) -> list[tuple[float, float, str]]:
    """Return position and kind of each defect, which are made of another material than the atoms."""
    axis_m = np.linspace(-half_m, half_m, 801)
    relief = world.sample.relief(axis_m[None, :], axis_m[:, None], 0.0, 0.0)
    marked, count = ndimage.label(relief.material > 0.995)
    centers = np.round(ndimage.center_of_mass(marked > 0, marked, range(1, count + 1))).astype(int)
    heights_m = relief.height_m[tuple(centers.T)]
    kinds = np.where(heights_m > 90e-12, "adatom", "vacancy")  # a common atom is 60 pm high
    return [(axis_m[column], axis_m[row], str(kind)) for (row, column), kind in zip(centers, kinds, strict=True)]


def test_lattice_defects_are_classified_and_measured_where_they_are(afspm_run: Run, tmp_path: Path) -> None:
    one = to_its_end(afspm_run, tmp_path, ("lattice_defects/experiment.toml",), "")
    with (one.folder / "sites.csv").open(encoding="utf-8", newline="") as file:
        rows = [(float(row["x_m"]), float(row["y_m"]), row["kind"], row["measured"]) for row in csv.DictReader(file)]
    found = [row for row in rows if row[2] != "atom"]
    world = true_world(one.folder)
    true = true_defects(world, 4.5e-9)
    near_m, border_m = 123e-12, 3.6e-9  # half of the distance of two atoms; sites at the border are left out

    def is_there(x_m: float, y_m: float, kind: str, among: list[tuple[float, float, str]]) -> bool:
        return any(kind == other[2] and math.dist((x_m, y_m), other[:2]) < near_m for other in among)

    inside = [defect for defect in true if max(map(abs, defect[:2])) < border_m]
    assert len(inside) > 8
    assert [defect for defect in inside if not is_there(*defect, [row[:3] for row in found])] == []
    assert [row for row in found if not is_there(*row[:3], true)] == []
    assert len(rows) - len(found) > 1000
    places = {row[2]: row[:2] for row in rows if row[3] == "yes"}
    assert sorted(places) == ["adatom", "atom", "vacancy"]
    with afspm.open_run(one.folder) as record:
        assert sorted(row.key for row in record.scans) == ["overview", "zoom-adatom", "zoom-atom", "zoom-vacancy"]
        for kind, place in places.items():
            assert record.scan(f"zoom-{kind}")["Height"].region.center_m == pytest.approx(place, abs=1e-12)
            curve = record.spectrum(f"curve-{kind}")
            assert curve.position_m is not None
            assert curve.position_m == pytest.approx(place, abs=1e-12)
            low = np.abs(curve["Bias"]) < 0.2
            share = np.ptp(curve["Current"][low]) / np.ptp(curve["Current"])
            # the simulated defects are metallic, the atoms have a gap
            assert (share > 0.08) == (kind != "atom"), f"{kind}: {share}"
    assert (one.folder / "sites.png").stat().st_size > 30_000
