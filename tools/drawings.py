"""Draws the diagrams of the documentation: `python tools/drawings.py` (or `--check`).

The transfer of control is drawn from the record of a night: `docs/pictures/control-transfer.json` keeps what is
drawn. `python tools/control_transfer.py runs/tip_repair-…` takes it from another run.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from control_transfer import control_transfer
from message_drawings import message_bytes, two_paths
from sheet import BAD, CONTROL, DATA, GOOD, GREY, INK, QUIET, Sheet

FOLDER: Final = Path(__file__).resolve().parents[1] / "docs" / "pictures"


def computers() -> str:
    """One computer against two: the same file, and only addresses are other."""
    sheet = Sheet()
    for left, title, apart in ((10, "one computer", False), (330, "two computers", True)):
        sheet.note((left + 145, 20), title, bold=True)
        sheet.frame((left, 30), (290, 150 if apart else 265), "at the microscope")
        if apart:
            sheet.frame((left, 200), (290, 95), "")
            sheet.note((left + 10, 284), "in the office, or one with a graphics card", anchor="start", fill=QUIET)
        x = left + 145
        sheet.box((left + 65, 80), (105, 36), "controller", "controller")
        sheet.box((left + 215, 80), (130, 36), "translator", "Translator")
        sheet.box((x, 145), (150, 36), "scheduler", "Scheduler")
        sheet.arrow((left + 120, 80), (left + 148, 80), both=True)
        sheet.arrow((left + 200, 99), (left + 200, 126), stroke=DATA, both=True)
        for number, name in enumerate(("Experiment", "Tip classifier", "Tip corrector")):
            at = left + 52 + number * 93
            sheet.box((at, 245), (88, 36), "component", name)
            sheet.arrow((x + (number - 1) * 45, 164), (at, 226), stroke=CONTROL, both=True)
    sheet.note(
        (320, 318),
        "One experiment file. Apart, it says the addresses between the two; each part is started by afspm run --only …",
    )
    return sheet.document(640, 332, "An experiment on one computer and on two")


def reuse() -> str:
    """A script for each microscope; one script for all; components that are put together."""
    sheet = Sheet()
    makers = ("maker A", "maker B")
    for number, title in enumerate(("a  without", "b  with a translator", "c  with components")):
        sheet.note((20 + number * 230, 20), title, anchor="start", bold=True)
        for second, maker in enumerate(makers):
            x = 70 + number * 230 + second * 105
            sheet.box((x, 250), (90, 36), "controller", maker)
            if number == 0:
                sheet.box((x, 80), (96, 60), "component", "script", "for " + maker)
                sheet.arrow((x, 111), (x, 231), text="its commands", at=(x, 175))
            else:
                sheet.box((x, 190), (96, 36), "translator", "Translator")
                sheet.arrow((x, 209), (x, 231), both=True)
    sheet.box((352, 80), (150, 60), "component", "one script", "generic commands")
    for x in (300, 405):
        sheet.arrow((352, 111), (352, 140), (x, 140), (x, 171), stroke=CONTROL)
    for number, name in enumerate(("Experiment", "Classifier", "Corrector")):
        x = 505 + number * 78
        sheet.box((x, 65), (74, 36), "component", name)
        sheet.arrow((x, 84), (555 + number * 28, 112), stroke=CONTROL, both=True)
    sheet.box((583, 130), (150, 34), "scheduler", "Scheduler")
    for x in (530, 635):
        sheet.arrow((x, 148), (x, 171), stroke=DATA, both=True)
    return sheet.document(720, 285, "Reuse: a script for each microscope, one script, components")


def workflow() -> str:
    """The correction's workflow, from a scan that ends to the mapping that aims the next."""
    sheet = Sheet()
    steps = (
        ("scan S_i has ended", "tip coordinates"),
        ("predict its mapping", "last rate × time since"),
        ("candidates D of the queue", "overlap ≥ f_min, like resolution"),
        ("register with the oldest of D", "the next, if that fails"),
    )
    for number, lines in enumerate(steps):
        sheet.box((120, 45 + number * 70), (210, 44), "component", *lines)
        if number:
            sheet.arrow((120, 45 + number * 70 - 47), (120, 45 + number * 70 - 23))
    sheet.box((375, 255), (170, 44), "decision", "one accepted?")
    sheet.arrow((226, 255), (289, 255))
    sheet.box((375, 160), (190, 44), "translator", "M_tot = predicted", "× residual")
    sheet.arrow((375, 232), (375, 183), text="yes", at=(392, 212))
    sheet.box((610, 255), (190, 44), "translator", "M_tot = predicted", "(prediction alone)")
    sheet.arrow((461, 255), (514, 255), text="no", at=(486, 248))
    sheet.box((375, 65), (190, 44), "decision", "shared region", "below f_rescan?")
    sheet.arrow((375, 137), (375, 88))
    sheet.box((610, 65), (190, 44), "scheduler", "Rescanner takes it again", "same sample coordinates")
    sheet.arrow((471, 65), (514, 65), text="yes", at=(492, 58), stroke=CONTROL)
    sheet.box((610, 160), (190, 44), "component", "scan joins the queue,", "and is published corrected")
    sheet.arrow((471, 75), (492, 75), (492, 160), (514, 160), text="no", at=(502, 120))
    sheet.arrow((610, 232), (610, 183))
    sheet.arrow((610, 88), (610, 137))
    sheet.note(
        (365, 310),
        "M_tot maps tip to sample coordinates. It corrects what is published, and its inverse aims the next scan.",
    )
    return sheet.document(720, 325, "The workflow of drift correction")


def drift_stages() -> str:
    """The stages of drift correction: what each takes and gives, with units and signs, and its folder."""
    sheet = Sheet()
    sheet.frame((110, 78), (270, 262), "estimators/: by name")
    stages = (
        (125, "pairs/", "one grid, levelled, mended"),
        (210, "registration/", "search, then fit"),
        (295, "doubt/", "how exact, how likely wrong"),
        (390, "track/", "many pairs become one drift D(t)"),
        (485, "frame/", "requests and packets, mapped"),
    )
    for number, (y, folder, does) in enumerate(stages):
        kind = ("translator", "translator", "decision", "component", "scheduler")[number]
        sheet.box((245, y), (230, 46), kind, folder, does)
    flows = (
        (
            44,
            100,
            "two scans: values [y, x] · region in tip coordinates, m",
            "start and end, s · a feature is at x_j, later at x_k",
        ),
        (150, 185, "two images in pixels, and the noise of their lines", ""),
        (
            235,
            270,
            "shift u in px: a feature at q is later at q + u",
            "linear map A in px per px, and the normal equations",
        ),
        (
            320,
            365,
            "displacement d = x_k − x_j, m, + to larger x · its covariance, m²",
            "linear part, 1 · accepted, or the reason why not",
        ),
        (
            415,
            460,
            "at any time t: M_tot, the translation by −D(t), m",
            "covariance of D, m² · rate of D, m/s, with the sign of D",
        ),
        (
            510,
            550,
            "to components: x_sample = M_tot x_tip = x_tip − D",
            "to the microscope: x_tip = x_sample + D, and the rate, m/s",
        ),
    )
    for top, bottom, *texts in flows:
        sheet.arrow((245, top), (245, bottom), stroke=DATA)
        for number, text in enumerate(filter(None, texts)):
            sheet.note((395, (top + bottom) / 2 + number * 15), text, anchor="start", size=11)
    sheet.arrow((129, 390), (95, 390), (95, 210), (128, 210), stroke=CONTROL)
    for number, text in enumerate(("the prior:", "expected d, m", "covariance, m²")):
        sheet.note((12, 285 + number * 15), text, anchor="start", fill=CONTROL, size=11)
    sheet.note(
        (20, 590),
        "report/ draws and tabulates what track/ and frame/ know; afspm-lab runs the stages in simulated nights.",
        anchor="start",
    )
    return sheet.document(790, 605, "The stages of drift correction")


def drift_designs() -> str:
    """The two designs of drift correction in the paper: components of their own, and a scheduler of its own."""
    sheet = Sheet()
    sheet.note((20, 22), "a  estimator, corrector and rescanner apart", anchor="start", bold=True)
    sheet.svg.box(22, 130, 256, 182, fill="none", stroke=BAD, dashed=True)
    sheet.box((85, 65), (110, 36), "component", "Experiment")
    sheet.box((85, 160), (110, 44), "component", "Drift Corrector", "tip ↔ sample")
    sheet.box((215, 220), (110, 44), "component", "Drift Estimator", "pairs of scans")
    sheet.box((330, 160), (90, 36), "component", "Rescanner")
    sheet.box((150, 285), (150, 36), "scheduler", "Scheduler")
    sheet.arrow((85, 137), (85, 86), stroke=DATA, both=True)
    sheet.arrow((85, 183), (85, 266), stroke=DATA, both=True)
    sheet.arrow((205, 266), (205, 243), stroke=DATA)
    sheet.note((210, 259), "scans", anchor="start", fill=DATA, size=11)
    sheet.arrow((185, 197), (185, 175), (141, 175), stroke=DATA)
    sheet.note((190, 190), "estimates", anchor="start", fill=DATA, size=11)
    sheet.arrow((141, 152), (284, 152), stroke=CONTROL, text="rescan", at=(213, 147))
    sheet.arrow((330, 179), (330, 285), (226, 285), stroke=CONTROL)
    sheet.note((405, 22), "b  a Drift Compensated Scheduler", anchor="start", bold=True)
    sheet.box((470, 65), (110, 36), "component", "Experiment")
    sheet.box((605, 65), (90, 36), "component", "Rescanner")
    sheet.box(
        (535, 215),
        (215, 66),
        "scheduler",
        "Drift Compensated Scheduler",
        "scheduler, estimator, corrector",
        outlined=BAD,
    )
    sheet.arrow((470, 84), (470, 176), stroke=DATA, both=True)
    sheet.arrow((592, 177), (592, 86), stroke=CONTROL, text="region", at=(568, 130))
    sheet.arrow((618, 84), (618, 177), stroke=CONTROL, text="request", at=(643, 130))
    for x in (150, 535):
        sheet.box((x, 360), (150, 36), "translator", "Translator")
        sheet.arrow((x, 306 if x == 150 else 254), (x, 339), stroke=DATA, both=True)
    for x in (155, 665):
        sheet.note((x, 112), "↑ sample coordinates", anchor="start", fill=QUIET, size=11)
        sheet.note((x + 75 if x == 155 else x, 335), "↓ tip coordinates", anchor="start", fill=QUIET, size=11)
    return sheet.document(790, 390, "Two designs of drift correction: three components, or one scheduler")


def one_dimension() -> str:
    """The paper's worked example: drift of 1 a step from the start, and of 1/2 at step 13."""
    sheet = Sheet()
    true = {0: 0.0, 1: 1.0, 2: 2.0, 12: 12.0, 13: 12.5, 14: 13.0}
    total, rate = 0.0, 0.0
    for number, (step, drifted) in enumerate(true.items()):
        if step == 12:
            total, rate = 11.0, 1.0  # the steps between are as the third
        predicted = total + rate
        residual = drifted - predicted
        x = 75 + number * 112 + (25 if step >= 12 else 0)
        sheet.note((x, 30), f"t{step}", bold=True)
        lowest = 11.0 if step >= 12 else 0.0
        sample, aimed = (210 - (place - lowest) * 60 for place in (drifted, predicted))
        sheet.svg.box(x - 34, sample - 6, 68, 12, fill="#dddddd", stroke=GREY, corner=2)
        sheet.svg.box(x - 40, aimed - 10, 80, 20, fill="none", stroke=DATA, dashed=True, corner=2)
        if residual:
            sheet.arrow((x + 50, aimed), (x + 50, sample), stroke=BAD)
        total, rate = drifted, drifted - total if number else 0.0
        for row, (text, colour) in enumerate(
            ((f"predicted {predicted:g}", DATA), (f"residual {residual:g}", BAD), (f"total {total:g}", INK))
        ):
            sheet.note((x, 250 + row * 18), text, fill=colour)
    sheet.note((368, 120), "…", bold=True)
    captions = (
        "Grey: where the sample is. Blue: where the scan is aimed. Red: what registration finds; the total takes it.",
        "At the start there is no rate; from t2 on the scan is aimed right. At t13 the drift becomes slower:",
        "one scan is off by 0.5, the next is not.",
    )
    for number, caption in enumerate(captions):
        sheet.note((20, 325 + number * 18), caption, anchor="start")
    return sheet.document(740, 375, "Drift correction in one dimension")


def house() -> str:
    """The rooms by floors: the core, what stands on it, and the guests at the door."""
    sheet = Sheet()
    sheet.frame((10, 30), (470, 375), "the core: a night on the simulated microscope")
    sheet.frame((510, 30), (220, 375), "guests: plugins/")
    floors = (
        ("component", ("cli", "testing")),
        ("component", ("supervisor",)),
        ("component", ("experiment", "components", "simulation")),
        ("scheduler", ("client", "scheduler", "translator")),
        ("translator", ("transport", "record")),
        ("translator", ("storage", "wire")),
        ("controller", ("model", "basics")),
    )
    for number, (kind, rooms) in enumerate(floors):
        width = 440 / len(rooms)
        for column, room in enumerate(rooms):
            sheet.box((25 + width * (column + 0.5), 78 + number * 50), (width - 10, 34), kind, f"{room}/")
    guests = ("nanonis", "asylum", "gxsm", "nanosurf", "park", "image", "drift", "web", "bluesky", "secop")
    for number, guest in enumerate(guests):
        x, y = 567 + number % 2 * 106, 78 + number // 2 * 50
        sheet.box((x, y), (96, 34), "decision", f"{guest}/")
    sheet.note((620, 345), "… and packages of strangers", fill=QUIET)
    sheet.arrow((508, 200), (482, 200), stroke=CONTROL, both=True)
    sheet.note((495, 190), "door", fill=CONTROL)
    sheet.note(
        (370, 428), "A room imports those below it. Guests import the core; the core finds them by entry points."
    )
    return sheet.document(740, 440, "The rooms of the core and the guests")


_VOLT_Y = {1.0: 168, 0.5: 222, 0.3: 248, 0.1: 274}
_PLANNED = (("a", 96, 0.5), ("b", 186, 1.0), ("a", 276, 0.5), ("c", 366, 0.1), ("c", 480, 0.3), ("a", 570, 0.5))


def settings_over_a_base() -> str:
    """Two plans that state a bias, one that states none, and the bias in force before, in and after their scans."""
    sheet = Sheet()
    lanes = {"a": (40, "component", DATA), "b": (70, "translator", CONTROL), "c": (100, "controller", GREY)}
    kinds = {"a": "translator", "b": "scheduler", "c": "controller"}
    for name, text in (("a", "plan a: 0.5 V"), ("b", "plan b: 1 V"), ("c", "plan c: no bias")):
        sheet.note((8, lanes[name][0] + 4), text, anchor="start")
    for name, x, _ in _PLANNED:
        sheet.box((x + 35 + 20, lanes[name][0]), (66, 22), kinds[name], "scan", bold=False)
    # the base, then the value in force over it
    sheet.svg.line([(100, _VOLT_Y[0.1]), (468, _VOLT_Y[0.1])], stroke=GOOD, end=False, dashed=True)
    sheet.svg.line([(468, _VOLT_Y[0.3]), (708, _VOLT_Y[0.3])], stroke=GOOD, end=False, dashed=True)
    way, now = [(100.0, float(_VOLT_Y[0.1]))], 0.1
    for _, x, value in (*_PLANNED[:4], ("person", 452, 0.3), *_PLANNED[5:], ("end", 648, 0.3)):
        at = x + 16
        if value != now:
            way += [(at, _VOLT_Y[now]), (at, _VOLT_Y[value])]
            now = value
    sheet.svg.line([*way, (708, _VOLT_Y[now])], stroke=INK, end=False)
    for volt, text in ((1.0, "1 V"), (0.5, "0.5 V"), (0.1, "0.1 V")):
        sheet.note((92, _VOLT_Y[volt] + 4), text, anchor="end", fill=QUIET)
    sheet.note((8, 140), "bias in force", anchor="start", bold=True)
    notes = (
        (112, 206, "set right before", INK),
        (202, 158, "switched directly", INK),
        (382, 256, "set back", INK),
        (468, 236, "a decision: 0.3 V", CONTROL),
        (664, 212, "end: set back", INK),
    )
    for x, y, text, fill in notes:
        anchor = "end" if x == 664 else "start"
        sheet.svg.text(x + (4 if anchor == "start" else 40), y, text, size=11, fill=fill, anchor=anchor, halo=True)
    sheet.note((104, 292), "base: 0.1 V", anchor="start", fill=GOOD)
    sheet.note((474, 266), "base: 0.3 V", anchor="start", fill=GOOD)
    sheet.arrow((100, 310), (708, 310))
    sheet.note((708, 326), "time", anchor="end", fill=QUIET)
    return sheet.document(720, 334, "The bias of two plans that alternate over a base, and of a plan without one")


DRAWINGS: dict[str, Callable[[], str]] = {
    "house": house,
    "one-and-two-computers": computers,
    "reuse": reuse,
    "drift-workflow": workflow,
    "drift-stages": drift_stages,
    "drift-designs": drift_designs,
    "drift-one-dimension": one_dimension,
    "two-paths": two_paths,
    "message-bytes": message_bytes,
    "control-transfer": control_transfer,
    "settings-over-a-base": settings_over_a_base,
}


def main() -> None:
    """Write the drawings that are other than they were, and name them; with --check only name them."""
    stale = []
    for name, draw in DRAWINGS.items():
        file, new = FOLDER / f"{name}.svg", draw()
        if not file.exists() or file.read_text(encoding="utf-8") != new:
            stale.append(file.name)
            if "--check" not in sys.argv:
                file.write_text(new, encoding="utf-8", newline="\n")
    sys.stdout.write("".join(f"{name}\n" for name in stale))
    sys.exit(bool(stale) and "--check" in sys.argv)


if __name__ == "__main__":
    main()
