"""The benchmark's pairs match their truth, and its bounds match their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.drift import cuts, families, pairs
from benchmarks.drift.bounds import bounds, row_precision, unknown_rough
from benchmarks.drift.conditions import CONDITIONS, flattened, measured
from benchmarks.drift.pairs import HEIGHT_M, PIXEL_M, Sampling, pair
from benchmarks.drift.published import PublishedBrief
from benchmarks.drift.surfaces import OVERSAMPLING, SURFACES, Grid, rough_power
from benchmarks.drift.trials import PUBLISHED, Cell, Trial
from scipy import ndimage
from tests.plugins.drift.quiet_pairs import QUIET, found_at, require_match_at_truth


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("samplings", [None, (Sampling.square(128), Sampling((150, 200), (0.7, 0.8)))])
@pytest.mark.parametrize("half", [None, "unseen"])
def test_without_noise_a_scan_moved_by_the_truth_is_the_other(
    surface: str,
    samplings: tuple[Sampling, Sampling] | None,
    half: families.Half | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = families.drawn_condition
    monkeypatch.setattr(pairs, "drawn_condition", lambda name, random: replace(drawn(name, random), **QUIET))
    monkeypatch.setitem(CONDITIONS, "hard", replace(CONDITIONS["hard"], **QUIET))
    made = pair(surface, "hard", seed=3, samplings=samplings, half=half)
    truth = made.truth
    assert truth is not None
    assert np.abs(truth.linear).max() > 1e-3  # turned and sheared: a displacement alone would not do
    x_m, y_m = made.reference.region.pixels_m(made.reference.values.shape)
    there_m = np.stack([x_m, y_m]) + np.apply_along_axis(truth.at, 0, np.stack([x_m, y_m]))
    difference = found_at(made.scan, there_m) - made.reference.values
    seen = np.isfinite(difference)
    assert seen.mean() == pytest.approx(truth.overlap, abs=0.05)
    level = difference[seen] - difference[seen].mean()  # each scan was brought to zero by itself
    assert level.std() < 0.02 * HEIGHT_M


@pytest.mark.parametrize("surface", SURFACES)
def test_the_overlap_matches_the_condition(surface: str) -> None:
    for condition, how in CONDITIONS.items():
        truth = pair(surface, condition, seed=11, size=40).truth
        if how.elsewhere:
            assert truth is None
        else:
            assert truth is not None
            # drift and rotation change it a little
            assert how.overlap[0] - 0.06 < truth.overlap < how.overlap[1] + 1e-9


def test_the_same_arguments_give_the_same_pair_and_another_seed_another() -> None:
    first, again, other = (pair("steps", "real", seed, size=32) for seed in (5, 5, 6))
    assert np.array_equal(first.scan.values, again.scan.values)
    assert not np.allclose(first.scan.values, other.scan.values)


def test_a_prior_is_wrong_by_its_standard_deviation() -> None:
    off = []
    for seed in range(60):
        made = pair("rough", "real", seed, size=16, prior_sd_px=1.5)
        assert made.truth is not None
        assert made.prior is not None
        assert np.allclose(made.prior.covariance_m2, (1.5 * PIXEL_M) ** 2 * np.eye(2))
        off.append((made.prior.mean_m - made.truth.displacement_m) / PIXEL_M)
    assert np.std(off) == pytest.approx(1.5, rel=0.15)


def test_every_view_of_a_lattice_has_a_defect() -> None:
    """Without a defect all sites are alike, and the displacement between two views has no determinable truth."""
    grid = Grid(64.0)
    every_atom_px = 10  # a square of that side has at least one in it
    for seed in range(12):
        height = SURFACES["lattice"](grid, np.random.default_rng(seed), np.random.default_rng([seed, 1]))
        highest = ndimage.maximum_filter(height, every_atom_px * OVERSAMPLING)
        atom, side = float(np.median(highest)), 97 * OVERSAMPLING
        for view in (highest[:side, :side], highest[:side, -side:], highest[-side:, :side], highest[-side:, -side:]):
            assert view.min() < 0.8 * atom or view.max() > 1.2 * atom


def test_noise_has_its_declared_size() -> None:
    random, flat = np.random.default_rng(1), np.zeros((256, 256))
    how = replace(CONDITIONS["hard"], **{**QUIET, "white": 0.25})
    assert measured(flat, how, random).std() == pytest.approx(0.25, rel=0.02)
    rows = measured(flat, replace(how, white=0.0, row_offset=0.5), random)
    assert np.ptp(rows, axis=1).max() == 0.0
    assert rows[:, 0].std() == pytest.approx(0.5, rel=0.15)
    slow = [measured(flat, replace(how, white=0.0, one_over_f=0.3), random).std() for _ in range(20)]
    assert np.mean(slow) == pytest.approx(0.3, rel=0.15)
    level = flattened(rows + np.linspace(0, 1, 256))
    assert np.abs(level).max() < 1e-12


@pytest.mark.parametrize("surface", SURFACES)
def test_maximum_likelihood_reaches_the_bound_of_white_noise(surface: str) -> None:
    """One noisy image against the exact surface: half of C, if both images had the whole overlap."""
    made = pair(surface, "white10", seed=5, size=80)
    frame, random = made.frames[1], np.random.default_rng(7)
    sample = frame.sample_px(frame.offsets_px())
    clean, chi2 = made.view.at(sample), []
    for _ in range(40):
        noisy, shift = clean + 0.1 * random.standard_normal(clean.shape), np.zeros(2)
        for _ in range(3):
            moved = sample + shift[:, None, None]
            slope = made.view.gradient(moved)
            information = np.einsum("iyx,jyx->ij", slope, slope)
            shift = shift + np.linalg.solve(information, np.einsum("iyx,yx->i", slope, noisy - made.view.at(moved)))
        chi2.append(shift @ information @ shift / 0.1**2)
    assert np.mean(chi2) == pytest.approx(2.0, abs=4 * 2 / np.sqrt(40))  # of two degrees of freedom
    whole_px2 = 2 * 0.1**2 * np.trace(np.linalg.inv(information))
    assert 0.9 * whole_px2 < np.trace(bounds(made).white) < 2.0 * whole_px2  # fewer pixels, less known


def test_row_noise_matches_the_bound() -> None:
    """The errors of the best linear estimate scatter as predicted by its information."""
    how = replace(CONDITIONS["real"], scars=0.0)
    made = pair("particles", "real", seed=5)
    frame, random = made.frames[0], np.random.default_rng(3)
    slope = made.view.gradient(frame.sample_px(frame.offsets_px()))
    weighted = slope @ row_precision(how, 128)
    information = np.einsum("iyx,jyx->ij", weighted, slope)
    errors = [
        np.linalg.solve(information, np.einsum("iyx,yx->i", weighted, measured(np.zeros((128, 128)), how, random)))
        for _ in range(150)
    ]
    chi2 = np.einsum("ki,ij,kj->k", errors, information, errors)
    assert chi2.mean() == pytest.approx(2.0, abs=4 * 2 / np.sqrt(150))


def test_nuisance_parameters_enlarge_the_bound() -> None:
    for surface in SURFACES:
        best = bounds(pair(surface, "hard", seed=2))
        assert np.trace(best.white) < np.trace(best.rows) < np.trace(best.full)


def test_the_best_estimate_on_an_unknown_ground_matches_its_bound() -> None:
    """The processor of Hannan and Thomson, on a periodic ground that is seen twice."""
    how, size, random = CONDITIONS["white3"], 64, np.random.default_rng(8)
    k = 2 * np.pi * np.fft.fftfreq(size)
    power = rough_power((k[None, :] ** 2 + k[:, None] ** 2) / (2 * np.pi) ** 2)
    power[0, 0] = 0.0
    power *= size**2 / power.sum()
    weight = power / (how.white**4 + 2 * how.white**2 * power)
    errors = []
    for _ in range(300):
        ground, *noise = np.fft.fft2(random.standard_normal((3, size, size)))
        one, two = (np.sqrt(power) * ground + how.white * each for each in noise)
        across = (one.conj() * two).imag * weight
        errors += [np.sum(q * across) / np.sum(q**2 * power * weight) / size**2 for q in (k[None, :], k[:, None])]
    known = 1.0 / np.sqrt(np.sum(k[None, :] ** 2 * power / (2 * how.white**2)))
    assert np.std(errors) / known == pytest.approx(unknown_rough(how, size), rel=0.06)
    assert unknown_rough(how, size) > 1.08


def test_the_published_estimator_has_its_measured_error_and_accepts_unrelated_scans() -> None:
    """0.13 px on rough ground; and unrelated scans are accepted."""
    pytest.importorskip("skimage")
    trials = [Trial("", "rough", "real", seed, (PUBLISHED,)) for seed in range(8)]
    found = Cell.of(outcome for trial in trials for outcome in trial.run())
    assert found.failed == 0.0
    assert 0.06 < found.rms_px < 0.26
    (elsewhere,) = Trial("", "particles", "null", 1, (PUBLISHED,)).run()
    assert elsewhere.accepted


def test_pairs_of_a_family_have_different_parameters_and_the_halves_share_none() -> None:
    drawn = [pair("lattice", "hard", seed, half=half).condition for half in families.HALVES for seed in range(3)]
    assert len({(how.white, how.exponent, how.blunt) for how in drawn}) == 6


def test_no_sample_of_a_real_image_is_in_both_halves() -> None:
    fitted, unseen = ({name[:10] for name, _ in cuts.IMAGES[half]} for half in families.HALVES)
    assert not fitted & unseen


def test_creep_displaces_the_start_of_a_line_and_not_its_end() -> None:
    frame = pairs.Frame((128, 128), (1.0, 1.0), np.zeros(2), np.eye(2), creep_px=1.0, creep_length_px=6.0)
    there = np.array([[-63.5, 63.5], [0.0, 0.0]])
    assert frame.sample_px(there)[0] == pytest.approx([-62.5, 63.5], abs=1e-6)
    assert frame.seen_px(np.array([-50.0, 3.0])) == pytest.approx([-50.0 - np.exp(-13.4 / 6.0), 3.0], abs=0.01)


def generated(name: str, channel: str) -> np.ndarray:
    """Stand in for an image of a real microscope."""
    random = np.random.default_rng(len(name) + len(channel))
    return np.asarray(ndimage.gaussian_filter(random.standard_normal((256, 256)), 3.0))


def test_pair_cut_from_an_image_matches_itself_at_its_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuts, "_image", generated)
    require_match_at_truth(monkeypatch)


def test_trial_shows_the_error_of_a_compared_method(monkeypatch: pytest.MonkeyPatch) -> None:
    def stumble(*_: object) -> None:
        raise ArithmeticError("no corners")

    monkeypatch.setattr(PublishedBrief, "register", stumble)
    with pytest.raises(ArithmeticError):  # a guard would have put a plain correlation in its place
        Trial("real", "rough", "real", 3, (PUBLISHED,), size=64, prior_sd_px=1.5).run()
