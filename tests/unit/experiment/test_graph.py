"""The picture of an experiment has all parts, and no overlapping texts."""

from __future__ import annotations

import itertools
from xml.etree import ElementTree

from afspm.experiment.graph import draw
from afspm.experiment.svg import text_width

from .conftest import Write

TEXT = """
name = "A night <with> tip & repair"
[watch]
component = true
class = "parts.Classifier"
[repair]
component = true
class = "parts.Corrector"
[peaks]
component = true
class = "parts.Peaks"
publisher = "tcp://127.0.0.1:9000"
[choose]
component = true
class = "parts.Chooser"
[many]
component = true
class = "parts.Anything"
envelopes = ["Scan2d_2000.0_A long name of a channel", "Spec1d", "ControlState", "ProbePosition"]
"""


def texts(svg: str) -> list[ElementTree.Element]:
    root = ElementTree.fromstring(svg)
    return [e for e in root.iter("{http://www.w3.org/2000/svg}text") if e.get("aria-hidden") is None]


def test_picture_has_all_parts_sockets_and_envelopes(write: Write) -> None:
    shown = " | ".join(e.text or "" for e in texts(draw(write(TEXT))))
    for wanted in ("watch", "repair", "scheduler", "microscope", "flags tip-shape-changed", "solves tip-shape-changed",
                   "Scan2d", "ControlState", "PeakList at tcp://127.0.0.1:9000", "simulated microscope",
                   "A night <with> tip & repair"):  # fmt: skip
        assert wanted in shown


def test_no_texts_overlap_and_none_leaves_the_picture(write: Write) -> None:
    svg = draw(write(TEXT))
    width = float(ElementTree.fromstring(svg).get("width", "0"))
    boxes = [_extent(e) for e in texts(svg)]
    for a, b in itertools.combinations(boxes, 2):
        apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        assert apart, (a, b)
    assert all(left >= 0 and right <= width for left, _, right, _, _ in boxes)


def test_no_two_arrows_end_at_the_same_place(write: Write) -> None:
    text = TEXT + TEXT[TEXT.index("[peaks]") : TEXT.index("[choose]")].replace("peaks", "more").replace("9000", "9009")
    root = ElementTree.fromstring(draw(write(text)))
    paths = [e.get("d", "") for e in root.iter("{http://www.w3.org/2000/svg}path") if e.get("fill") == "none"]
    ends = [path.rpartition("L")[2] for path in paths]
    assert len(ends) == len(set(ends))


def test_an_experiment_of_nothing_but_scheduler_and_translator_can_be_drawn(write: Write) -> None:
    ElementTree.fromstring(draw(write("")))


def _extent(e: ElementTree.Element) -> tuple[float, float, float, float, str]:
    # left, top, right, bottom of a text
    x, y, size = (float(e.get(key, "0")) for key in ("x", "y", "font-size"))
    text = e.text or ""
    wide = text_width(text, size, bold=e.get("font-weight") is not None)
    left = {"start": x, "middle": x - wide / 2, "end": x - wide}[e.get("text-anchor", "start")]
    return left, y - size * 0.8, left + wide, y + size * 0.2, text
