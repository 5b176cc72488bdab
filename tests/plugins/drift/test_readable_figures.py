"""Text in each figure is large enough where the figure is shown, and no two labels overlap."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from picture_borders import cut_sides
from tests.plugins.drift.test_figures import scan
from tests.plugins.drift.test_record import record
from tests.unit.components.test_night import TIP, night
from tests.unit.surveying.surfaces import scanned
from tests.unit.surveying.test_survey_record import PLACES, RADII, measured

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure
from matplotlib.text import Text

from afspm.components.surveying import SurveyRecord, Target
from afspm.components.surveying.figure import draw_survey
from afspm.plugins.drift.registration import DriftScan, Matches
from afspm.plugins.drift.report.drawings import (
    ScanPair,
    draw_errors,
    draw_estimates,
    draw_features,
    draw_histogram,
    draw_offsets,
    draw_pairs,
)
from afspm.report import night_figure

SHOWN_PX = 800.0  # the width of a column of text in the report and the README
LEAST_PX = 7.0

AT = np.random.default_rng(2).uniform(-0.9e-6, 0.9e-6, (40, 2))
MATCHES = Matches(AT, AT + 20e-9, np.arange(40) % 4 > 0)


def drawn_night(path: Path) -> None:
    night_figure.draw(night(30), path, {TIP: "tip-shape-changed"}, title="A night", simulated=True)


def drawn_survey(path: Path) -> None:
    targets = [Target((float(x), float(y))) for x, y in PLACES]
    survey = SurveyRecord(scanned(PLACES, RADII), targets, ("top",))
    for visit in survey.visits:
        measured(visit, "top")
    draw_survey(survey, path, title="particles", simulated=True)


def saved(made: Figure, path: Path) -> None:
    made.savefig(path)


def in_m(number: int) -> DriftScan:
    return replace(scan(number), unit="m")


PICTURES: dict[str, Callable[[Path], None]] = {
    "night": drawn_night,
    "survey": drawn_survey,
    "offset": lambda path: saved(draw_offsets(record(), truth_m=record().drift_m), path),
    "pairs": lambda path: saved(draw_pairs([ScanPair(in_m(0), in_m(8), np.array([3e-9, 4e-9]), "on")]), path),
    "histogram": lambda path: saved(draw_histogram(record(), title="off"), path),
    "estimates": lambda path: saved(draw_estimates(record(), title="off", truth_m=record().misplacement_m), path),
    "features": lambda path: saved(draw_features(scan(0), scan(1), MATCHES), path),
    "errors": lambda path: saved(draw_errors(record(), record().drift_m), path),
}


@pytest.mark.parametrize("name", PICTURES)
def test_nothing_is_cut_at_the_border_of_a_picture(name: str, tmp_path: Path) -> None:
    # users N1: labels were half outside
    PICTURES[name](tmp_path / "picture.png")
    assert cut_sides(tmp_path / "picture.png") == []


@pytest.mark.parametrize("name", PICTURES)
def test_text_of_a_figure_is_readable_and_labels_do_not_overlap(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    figures: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda self, path, **how: figures.append(self) or save(self, path, format="png")
    )
    PICTURES[name](tmp_path / "picture.png")
    (figure,) = figures
    shown_px_per_pt = min(SHOWN_PX / figure.get_figwidth(), 200.0) / 72.0
    # matplotlib keeps labels that it does not draw, as those of ticks outside the limits
    drawn: list[Text] = []
    draw_text = Text.draw
    monkeypatch.setattr(Text, "draw", lambda self, *rest: drawn.append(self) or draw_text(self, *rest))
    figure.canvas.draw()
    texts = list({id(text): text for text in drawn if text.get_visible() and text.get_text().strip()}.values())
    assert len(texts) > 2
    small = [(text.get_text(), text.get_fontsize()) for text in texts]
    assert [one for one in small if float(one[1]) * shown_px_per_pt < LEAST_PX] == []
    boxes = [(text.get_text(), text.get_window_extent().padded(-1.0)) for text in texts]
    overlapping = [(a, b) for (a, one), (b, other) in itertools.combinations(boxes, 2) if one.overlaps(other)]
    assert overlapping == []


def test_displacement_of_ten_nanometres_is_magnified_with_a_key() -> None:
    made = draw_pairs([ScanPair(scan(0), scan(8), np.array([6e-9, 8e-9]))])
    labels = [text.get_text() for text in made.axes[1].texts]
    assert any("×" in label and "nm" in label for label in labels), labels


def test_compared_scans_have_a_colour_bar_with_their_unit() -> None:
    made = draw_pairs([ScanPair(in_m(0), in_m(8), np.array([6e-9, 8e-9]))])
    made.canvas.draw()
    (bar,) = made.axes[1].child_axes
    assert bar.get_ylabel().endswith("m")
    assert not any("e" in label.get_text() for label in bar.get_yticklabels())


def test_bias_of_the_estimate_is_in_the_figure() -> None:
    run = record()
    truth_m = run.drift_m - np.array([2e-9, -3e-9]) * (np.arange(len(run.drift_m)) > 0)[:, None]
    above, below = draw_errors(run, truth_m).axes
    assert "bias (2, −3) nm" in below.get_title(loc="right")
    assert above.get_title(loc="right") == "SIMULATED"
