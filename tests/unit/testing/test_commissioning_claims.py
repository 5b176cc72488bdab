"""Claims about a maker's program, and what the steps of a commissioning say of them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from afspm.model import Region, Scan, ScanLines
from afspm.testing.commissioning import maker_claims
from afspm.testing.commissioning.guide import Guide
from afspm.testing.commissioning.lines_in_scan import places, retrace_runs_as_trace
from afspm.testing.commissioning.maker_claims import MakerClaim
from afspm.testing.commissioning.progress import CommissioningStep
from afspm.testing.commissioning.steps import line_time
from afspm.testing.conformance import Failed, Unsupported
from afspm.testing.translators.support import Support

REGION = Region((0.0, 0.0), (1e-7, 1e-7))
NOISE = np.random.default_rng(1).normal(size=(8, 16))


def scan(values: np.ndarray = NOISE, role: str = "current") -> Scan:
    return Scan(REGION, "Current", "A", values, roles=(role,))


def lines(values: np.ndarray, first_row: int = 2) -> list[ScanLines]:
    return [ScanLines(REGION, (8, 16), "Current", "A", first_row, values)]


def test_line_is_found_in_its_row() -> None:
    found = list(places(scan(), lines(NOISE[2:5] + 1e-9)))
    assert [(one.is_row, one.is_mirrored, one.is_retrace) for one in found] == [(True, False, False)] * 3


def test_lines_of_a_memory_the_other_way_round_are_in_other_rows() -> None:
    assert [one.is_row for one in places(scan(), lines(NOISE[::-1][2:4]))] == [False, False]


def test_mirrored_line_of_a_retrace_is_found_from_right_to_left() -> None:
    (found,) = places(scan(role="current, retrace"), lines(NOISE[2:3, ::-1]))
    assert (found.is_row, found.is_mirrored, found.is_retrace) == (True, True, True)


@pytest.mark.parametrize("values", [np.zeros((8, 16)), np.full((8, 16), np.nan)])
def test_lines_that_are_alike_have_no_place(values: np.ndarray) -> None:
    assert list(places(scan(values), lines(values[:2]))) == []


def test_line_that_is_not_in_the_scan_has_no_place() -> None:
    assert list(places(scan(), lines(NOISE[:2] + NOISE[2:4]))) == []


@pytest.mark.parametrize(("step", "runs_as_trace"), [(1, True), (-1, False)])
def test_retrace_shows_whether_its_lines_are_mirrored(step: int, runs_as_trace: bool) -> None:
    other = NOISE + 0.3 * np.random.default_rng(2).normal(size=NOISE.shape)
    both = [scan(), scan(other[:, ::step], "current, retrace")]
    assert retrace_runs_as_trace(both) is runs_as_trace
    assert retrace_runs_as_trace(both[:1]) is None
    assert retrace_runs_as_trace([scan(), scan(np.zeros_like(NOISE), "current, retrace")]) is None
    unlike = np.random.default_rng(3).normal(size=NOISE.shape)
    assert retrace_runs_as_trace([scan(), scan(unlike, "current, retrace")]) is None


@pytest.mark.parametrize(
    ("lasted_s", "speed", "holds"),
    [(8.5, 1.0, True), (12.0, 1.0, True), (4.2, 1.0, False), (16.5, 1.0, False), (14.0, 1.0, None), (4.2, 20.0, None)],
)
def test_time_of_a_scan_shows_whether_a_line_is_forward_and_backward(
    lasted_s: float, speed: float, holds: bool | None
) -> None:
    client: Any = SimpleNamespace(clock=SimpleNamespace(real_s=lambda s: s / speed))
    guide: Any = SimpleNamespace(kit=SimpleNamespace(client=client))
    assert line_time(guide, lasted_s, 8.0) is holds


class Person:
    """Confirms nothing but what is in `yes`, and sees a frame at the panel as `sees` says."""

    def __init__(self, yes: str = "", sees: str = "") -> None:
        self.yes, self.sees = yes, sees

    def show(self, text: str) -> None: ...

    def confirm(self, question: str) -> bool:
        return bool(self.yes) and self.yes in question

    def text(self, question: str) -> str:
        return ""

    def choose(self, question: str, options: Any, default: str = "") -> str:
        return self.sees or default


CLAIMS = {
    "y-up": MakerClaim("Up is up.", "none", "", "", commission="frame/y-up"),
    "whole": MakerClaim("All is well.", "none", "", "", commission="frame"),
    "prepared": MakerClaim("It is switched off.", "none", "", "", commission="frame", ask="Switch it on."),
    "later": MakerClaim("Another step.", "none", "", "", commission="angle"),
}


def settled(person: Person, *, has_panel: bool = True) -> dict[str, str]:
    def look(guide: Guide) -> str:
        guide.require_choice("Where to?", "up", ["down"], "a frame", "frame/y-up")
        return ""

    step = CommissioningStep(name="frame", title="", do=look, explained="", moves=False)
    kit: Any = SimpleNamespace(support=Support({}, {}))
    guide = Guide(kit, person, Path(), has_panel=has_panel, claims=CLAIMS)
    with suppress(Failed):
        guide.perform(step)
    return maker_claims.verdicts(CLAIMS, "frame", guide.seen, guide.unprepared)


def test_passed_step_settles_its_claims() -> None:
    assert settled(Person("Switch it on", "up")) == dict.fromkeys(("y-up", "whole", "prepared"), "holds")


def test_claim_whose_preparation_is_not_confirmed_is_not_shown() -> None:
    assert settled(Person(sees="up")) == {"y-up": "holds", "whole": "holds", "prepared": "not shown"}


def test_failed_step_refutes_only_the_claim_that_was_seen_to_fail() -> None:
    found = settled(Person("Switch it on", "down"))
    assert found == {"y-up": "does not hold", "whole": "not shown", "prepared": "not shown"}


def test_step_for_claims_alone_is_not_asked_for_without_a_claim() -> None:
    step = CommissioningStep(
        name="pause-at-panel", title="", do=lambda _: "", explained="", moves=False, for_claims=True
    )
    kit: Any = SimpleNamespace(support=Support({}, {}))
    with pytest.raises(Unsupported, match="no claim of this driver"):
        Guide(kit, Person(), Path(), claims=CLAIMS).perform(step)


@pytest.mark.parametrize(("sees", "verdict"), [("yes", "holds"), ("", "not shown"), ("no", "not shown")])
def test_what_the_person_does_not_see_at_the_panel_passes_and_settles_nothing(sees: str, verdict: str) -> None:
    step = CommissioningStep(
        name="frame", title="", do=lambda guide: guide.require_at_panel("Stopped?", "a stop"), explained="", moves=False
    )
    kit: Any = SimpleNamespace(support=Support({}, {}))
    guide = Guide(kit, Person(sees=sees), Path(), claims=CLAIMS)
    if sees == "no":
        with pytest.raises(Failed, match="the person says no"):
            guide.perform(step)
    else:
        guide.perform(step)
    assert maker_claims.verdicts(CLAIMS, "frame", guide.seen, guide.unprepared)["whole"] == verdict


def test_step_without_a_panel_settles_nothing_that_the_panel_shows() -> None:
    assert set(settled(Person("Switch it on", "up"), has_panel=False).values()) == {"not shown"}
