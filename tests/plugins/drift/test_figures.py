"""The figures of drift show their data, with units."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Rectangle
from tests.plugins.drift.test_record import record

from afspm.basics import InvalidValue
from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan, Matches

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure

from afspm.plugins.drift.report import style
from afspm.plugins.drift.report.drawings import (
    ScanPair,
    _in_frame,
    draw_errors,
    draw_estimates,
    draw_features,
    draw_histogram,
    draw_offsets,
    draw_pairs,
    freedman_diaconis,
)


def scan(k: int = 0) -> DriftScan:
    values = np.random.default_rng(k).normal(size=(32, 48))
    return DriftScan(values, Region((0.0, 0.0), (2e-6, 1e-6), 0.2), 900.0 * k, 900.0 * k + 300.0)


def drawn(made: Figure, path: Path) -> Figure:
    style.save(made, path / "figure.png")
    assert (path / "figure.png").read_bytes().startswith(b"\x89PNG")
    return made


def labels(made: Figure) -> str:
    return " | ".join(label for ax in made.axes for label in (ax.get_xlabel(), ax.get_ylabel()))


@pytest.mark.parametrize("n", [1, 2, 20])
def test_offsets_are_drawn_with_units_even_of_a_single_scan(n: int, tmp_path: Path) -> None:
    run = record()[:n]
    made = drawn(draw_offsets(run, truth_m=run.drift_m, switched_on_s=run.time_s[0]), tmp_path)
    assert len(made.axes) == 4  # the colours of time too
    assert "time / h" in labels(made)
    assert "x / nm" in labels(made) or "x / µm" in labels(made)


def test_estimates_show_the_refused_apart(tmp_path: Path) -> None:
    made = drawn(draw_estimates(record(), truth_m=record().misplacement_m), tmp_path)
    names = made.axes[0].get_legend_handles_labels()[1]
    assert {"refused", "x, true"} <= set(names)
    longest = 2e9 * record().sd_m[record().matched].max(axis=0)  # bars smaller than the markers can't be seen
    assert [float(one.split()[-2]) for one in names if "± 2 sd, at most" in one] == pytest.approx(longest, rel=5e-3)
    (crosses,) = (line for line in made.axes[0].lines if line.get_label() == "refused")
    assert np.size(crosses.get_xdata()) == np.count_nonzero(~record().matched)


def test_bins_have_the_width_of_freedman_and_diaconis() -> None:
    values = np.random.default_rng(1).normal(size=1000)
    edges = freedman_diaconis(values)
    np.testing.assert_allclose(edges, np.histogram_bin_edges(values, bins="fd"))
    assert len(freedman_diaconis(np.full(5, 3.0))) == 2


def test_the_histogram_counts_accepted_pairs_only_and_not_the_first_scan(tmp_path: Path) -> None:
    made = drawn(draw_histogram(record()), tmp_path)
    counted = [sum(patch.get_height() for patch in ax.patches if isinstance(patch, Rectangle)) for ax in made.axes]
    assert counted == [np.count_nonzero(record().matched[1:])] * 3
    few = drawn(draw_histogram(record()[:9]), tmp_path)
    accepted = np.count_nonzero(record().matched[1:9])
    assert [np.size(ax.lines[0].get_xdata()) for ax in few.axes] == [accepted] * 3, "one by one, without bins"
    none = record()[:1]
    assert "no pair" in made_text(draw_histogram(none))


def made_text(made: Figure) -> str:
    return " ".join(text.get_text() for ax in made.axes for text in ax.texts)


def test_pairs_are_labelled_with_distance_and_time(tmp_path: Path) -> None:
    two = [ScanPair(scan(0), scan(8), np.array([300e-9, 400e-9]), "off"), ScanPair(scan(1), scan(9), np.zeros(2))]
    made = drawn(draw_pairs(two), tmp_path)
    assert made.axes[1].get_title(loc="left") == "2.00 h later: 500.0 nm"
    assert made.axes[0].get_title(loc="left") == "off"


def test_inliers_and_outliers_are_drawn_apart_and_a_pair_without_features_is_refused(tmp_path: Path) -> None:
    at = np.random.default_rng(1).uniform(-0.4e-6, 0.4e-6, (30, 2))
    inlier = np.arange(30) < 21
    made = drawn(draw_features(scan(0), scan(1), Matches(at, at, inlier)), tmp_path)
    assert made.axes[3].get_title(loc="right") == "21 inliers of 30 pairs"
    assert sum(line.get_marker() == "x" for line in made.axes[2].lines) == 9
    with pytest.raises(InvalidValue, match="features"):
        draw_features(scan(0), scan(1), None)


def test_a_keypoint_lies_on_the_pixel_that_it_was_found_at() -> None:
    one = scan()
    x, y = one.region.pixels_m(one.values.shape)
    corner = _in_frame(one, np.array([[x[-1, 0], y[-1, 0]]]))[0]
    left, low = one.region.top_left_m
    np.testing.assert_allclose(corner, [1e6 * left, 1e6 * (low + one.region.size_m[1])])


def test_true_errors_are_misplacement_and_estimation_error(tmp_path: Path) -> None:
    run = record()
    truth = run.drift_m + 7e-6  # from another zero on
    made = drawn(draw_errors(run, truth, switched_on_s=float(run.time_s[8])), tmp_path)
    shown = np.asarray(made.axes[0].lines[0].get_ydata(), dtype=float)
    np.testing.assert_allclose(shown[1:], 1e9 * np.hypot(*run.misplacement_m[1:].T))
    assert np.isnan(shown[0])
    believed = np.asarray(made.axes[1].lines[0].get_ydata(), dtype=float)
    np.testing.assert_allclose(believed, 0.0, atol=1e-6)


def test_lengths_have_the_unit_that_reads_best() -> None:
    assert style.unit_of(np.array([3e-9, np.nan]))[0] == "nm"
    assert style.unit_of(np.array([0.5e-12]))[0] == "pm"
    assert style.unit_of(np.array([5e-6]), 1e-9)[0] == "µm"
    assert style.unit_of(np.array([]))[0] == "pm"


def test_the_package_of_figures_loads_without_matplotlib() -> None:
    import subprocess
    import sys

    modules = "afspm.plugins.drift.report, afspm.plugins.drift.track.record"
    told = f"import sys, {modules}; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", told], check=False).returncode == 0


def test_a_record_without_refusals_has_no_mark_for_them() -> None:
    run = record()
    all_good = replace(run, matched=np.ones(20, bool))
    assert "refused" not in draw_estimates(all_good).axes[0].get_legend_handles_labels()[1]
