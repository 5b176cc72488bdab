"""The steps of a commissioning, in order.

Each step returns a line with its observation, or raises Failed, Skipped or Declined.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics.errors import ConfigError
from afspm.basics.formatting import quantity
from afspm.basics.units import same_kind
from afspm.drawing import raster
from afspm.model import ChannelRoles, ControlRequest, Feedback, RegionChange, Scan, ScanParameters, ScopeState, names
from afspm.model.requests import Parameter
from afspm.testing.commissioning import lines_in_scan, moved_frame
from afspm.testing.commissioning.guide import UNSEEN, Guide
from afspm.testing.commissioning.maker_claims import LOOKS
from afspm.testing.commissioning.progress import CommissioningStep
from afspm.testing.conformance import Declined, Failed, Lost, Skipped, expect
from afspm.testing.translators.checks import frames, picture, scans
from afspm.testing.translators.client import describe_all
from afspm.testing.translators.client import scans as published
from afspm.testing.translators.measuring import SCAN_S, STOPPED_REAL_S, TURN_RAD, FrameSetting, Taken, number

READ, FRAME, ANGLE, SCAN, END, FILES, STOP, LOSS, AXES = (
    "read", "frame", "angle", "scan", "end of a scan", "files", "stop", "lost connection", "axes",
)  # fmt: skip
UP, LINE_TIME, ROWS, COLUMNS = "frame/y-up", "scan/line-time", "lines/rows", "lines/columns"
ENGAGES, STOP_WITHDRAWS, BACKWARD = "scan/engages", "stop-at-panel/withdraws", "axes/backward"
MOVES, PAUSE_ENDS, PAUSE_UNSEEN = "frame-in-scan/moves", "pause-at-panel/ends", "pause-at-panel/unseen"
CURVE_AS_SCAN, SILENCES = "curve-at-panel/as-scan", "dialog/silences"
REMOTE, HAS_GAIN = "controller/remote", f"controller/{names.ZCTRL_PGAIN}"
COMPARED: Final = (names.ZCTRL_SETPOINT, names.TIP_BIAS_VOLTAGE, names.ZCTRL_PGAIN, names.CURRENT)
"""The values that the person compares with the panel, the last two only where a claim depends on them."""
SETPOINT, BIAS, GAIN, CURRENT = PANEL = tuple(f"panel/{name}" for name in COMPARED)
WITHDRAWN: Final = "contact/withdrawn"
OBSERVATIONS: Final = (
    UP, LINE_TIME, ROWS, COLUMNS, ENGAGES, STOP_WITHDRAWS, BACKWARD, MOVES, PAUSE_ENDS, PAUSE_UNSEEN, CURVE_AS_SCAN,
    SILENCES, REMOTE, HAS_GAIN, *PANEL, WITHDRAWN,
)  # fmt: skip
"""Observations within steps that settle claims, beside the passed steps themselves and the looks."""
OPERATIONS: Final = (READ, FRAME, ANGLE, SCAN, END, FILES, STOP, LOSS, AXES)
LINES_REAL_S: Final = 2.0
"""Least real seconds of a scan that is watched while it fills."""
_NOTICED_S: Final = 5.0
"""Seconds between the end of a scan at the panel and its publication: reaction, saving, polling."""
_LOST_S: Final = 60.0
_NOISE_S: Final = 60.0
_LEAST_READINGS: Final = 8
_HELD_S: Final = 5.0
"""Experiment seconds for which the feedback is off."""
_STEPS: list[CommissioningStep] = []
_FRAME = (names.SCAN_SIZE_X, names.SCAN_SIZE_Y)


class Reopened(Lost):
    """The exception that the person has withdrawn the tip at the panel, as asked: a new run has to go on."""


def alone(name: str) -> tuple[CommissioningStep, ...]:
    """Return one step, with the questions about the controller and the tip that precede it.

    Raises:
        ConfigError: there is no such step.
    """
    wanted = next((step for step in _STEPS if step.name == name), None)
    if wanted is None:
        raise ConfigError(f"there is no step {name!r}", hint=f"one of {', '.join(step.name for step in _STEPS)}")
    gate = "contact" if wanted.contact else "withdrawn"
    after = {"controller": (), gate: ("controller",), name: (gate,)} if wanted.moves else {name: ()}
    return tuple(replace(step, after=after[step.name]) for step in _STEPS if step.name in after)


def all_steps() -> tuple[CommissioningStep, ...]:
    return tuple(_STEPS)


def _step(title: str, explained: str, remedy: str, **facts: object) -> Callable[[Callable[[Guide], str]], None]:
    def marked(do: Callable[[Guide], str]) -> None:
        name = do.__name__.strip("_").replace("_", "-")
        step = CommissioningStep(name=name, title=title, do=do, remedy=remedy, explained=explained, **facts)  # type: ignore[arg-type]
        _STEPS.append(step)

    return marked


# --- only reading ---


@_step(
    "The controller",
    "afspm has connected and read what there is; nothing was moved and no value was set.",
    "Check the address in the experiment file, and that no other controller runs at it.",
    moves=False,
    remembered=False,
    operations=(READ,),
)
def _controller(guide: Guide) -> str:
    support = guide.kit.support
    lacking = [name for name, value in support.parameters.items() if value is None]
    lacking += [name for name, has in support.actions.items() if has is False]
    guide.prompts.show(f"controller: {support.controller or 'it does not say what it is'}")
    guide.prompts.show(f"not supported: {', '.join(lacking) or 'nothing'}")
    expect(not support.errors, "an answer to every question", "; ".join(support.errors))
    guide.require("Is this the controller in front of you?", "the controller in front of the person")
    guide.seen[HAS_GAIN] = support.has(names.ZCTRL_PGAIN)
    if guide.is_remote:
        guide.seen[REMOTE] = True
    return support.controller


@_step(
    "The panel",
    "Choose at the controller's panel a frame that is not in the middle, not square and turned by some 20 degrees. "
    "Then type what the panel shows. An empty line: it is not shown there. afspm's width and height are from the first "
    "pixel to the last; a panel that shows those of whole pixels has one pixel more.",
    "Note both values and units. Do not go on with a frame that differs: report it with the trace of this run. If the "
    "bias or the setpoint differs by a factor, change its row in `parameters` of the translator's section.",
    after=("controller",),
    moves=False,
    needs_panel=True,
    operations=(READ,),
    needs=_FRAME,
)
def _panel(guide: Guide) -> str:
    guide.prompts.text("Press Enter when the frame is set")
    _go_on(guide)
    guide.kit.client.quiet()
    guide.kit.set_by_hand()
    count = _compare_frame(guide, frames.current_frame(guide.kit)) + _compare_values(guide)
    if not count:
        raise Skipped("the panel shows none of the values")
    return f"{count} values are those of the panel"


def _compare_frame(guide: Guide, frame: FrameSetting) -> int:
    region, (rows, columns) = frame.region, frame.shape
    slack_nm = 0.01 * max(region.size_m) * 1e9
    x_nm, y_nm = (value * 1e9 for value in region.center_m)
    width_nm, height_nm = (value * 1e9 for value in region.size_m)
    pixel_nm, line_nm = (1.1 * size / max(n - 1, 1) for size, n in ((width_nm, columns), (height_nm, rows)))
    seen = [
        guide.compare("width of the frame (x)", width_nm, "nm", pixel_nm),
        guide.compare("height of the frame (y)", height_nm, "nm", line_nm),
        guide.compare("x of its centre", x_nm, "nm", slack_nm),
        guide.compare("y of its centre", y_nm, "nm", slack_nm),
    ]
    if guide.kit.support.has(names.SCAN_ANGLE):
        turned_deg = math.degrees(math.remainder(region.angle_rad, math.tau))
        seen.append(guide.compare_angle(turned_deg))
    seen += [guide.compare("pixels in a line", columns, ""), guide.compare("lines", rows, "")]
    return sum(seen)


def _compare_values(guide: Guide) -> int:
    compared = 0
    asked = {one.commission for one in guide.claims.values()} | {SETPOINT, BIAS}
    for name, shows in zip(COMPARED, PANEL, strict=True):
        if guide.kit.support.has(name) and shows in asked:
            found = guide.kit.client.get(name)
            value = number(found, found.unit or "")
            noise = 0.1 * abs(value) if name == names.CURRENT else 0.0
            compared += guide.compare(name, value, found.unit or "", noise, shows)
    return compared


@_step(
    "The hardware's own guard",
    "afspm asks whether the controller itself withdraws the tip at too large a signal (a safe tip).",
    "Compare the guard at the panel; afspm does not switch it.",
    after=("controller",),
    moves=False,
    remembered=False,
    needs=(names.SAFE_TIP_ON,),
)
def _safe_tip(guide: Guide) -> str:
    client = guide.kit.client
    is_on = _is_on(guide, names.SAFE_TIP_ON)
    threshold = client.get(names.SAFE_TIP_THRESHOLD)
    at = quantity(number(threshold, threshold.unit or ""), threshold.unit or "")
    line = f"on, at {at}" if is_on else f"OFF (its threshold: {at})"
    if not is_on:
        guide.prompts.show(
            "  WARNING: the safe tip is off, and afspm alone withdraws the tip. Switch it on at the panel."
        )
    guide.require_at_panel(f"The safe tip is {line}. Does the panel show the same?", "the panel's safe tip")
    return line


@_step(
    "The noise of the settings",
    "afspm reads for a minute each setting for which a measurement stands. Leave the panel alone meanwhile.",
    "Find out what changes these settings: no measurement can stand for them.",
    after=("controller",),
    moves=False,
)
def _noise(guide: Guide) -> str:
    wanted = {
        name: row
        for name, row in guide.rows.items()
        if guide.kit.support.has(name) and row.is_number and not row.measured
    }
    if not wanted:
        raise Skipped("no setting of this translator is known")
    seen = _readings(guide, {name: row.wire_unit for name, row in wanted.items()}, _NOISE_S)
    noisy = {name: guide.propose_resolution(wanted[name], values) for name, values in seen.items()}
    found = ", ".join(f"{name} by {spread}" for name, spread in noisy.items() if spread)
    count = min(map(len, seen.values()))
    return f"{len(wanted)} settings, {count} readings each: {f'not steady: {found}' if found else 'all steady'}"


def _readings(guide: Guide, units: Mapping[str, str], lasts_s: float = 0.0) -> dict[str, list[float]]:
    # for an experiment time, and a least number of each
    clock, found = guide.kit.clock, {name: list[float]() for name in units}
    until_s, rounds = clock.monotonic_s() + clock.real_s(lasts_s), 0
    while rounds < _LEAST_READINGS or clock.monotonic_s() < until_s:
        rounds += 1
        for name, unit in units.items():
            found[name].append(number(guide.kit.client.get(name), unit))
    return found


# --- with the tip withdrawn ---


@_step(
    "The tip is withdrawn",
    "The next steps, up to the next notice, move the scanner sideways and take scans. They never approach.",
    "Withdraw the tip at the panel, then with the coarse motor, so far that the scanner can't reach the sample, and "
    "begin again.",
    after=("controller",),
    moves=False,
    about_tip=True,
    remembered=False,
)
def _withdrawn(guide: Guide) -> str:
    if not guide.prompts.confirm("Is the tip so far from the sample that the scanner can't reach it?"):
        raise Declined("the tip is not withdrawn")
    # A withdrawal at the panel takes control away, at once or at the next reading, and a run that has seen the tip at
    # the sample measures nothing in the air. A new run takes the tip as it finds it.
    try:
        line = _agreed(guide, at_sample=False)
    except Lost as lost:
        raise Reopened(str(lost)) from lost
    began = guide.kit.support.parameters.get(names.ENGAGED)
    if began is not None and began.value == "true":
        raise Reopened("the tip was at the sample when this run began")
    return line


def _agreed(guide: Guide, *, at_sample: bool) -> str:
    # the line of a step in which the person says where the tip is; raises Failed if the controller shows otherwise
    wanted = (name for name in (names.ENGAGED, names.CURRENT, names.ZCTRL_SETPOINT) if guide.kit.support.has(name))
    shown, reading = tip_shown({name: guide.kit.client.get(name) for name in wanted})
    if shown is None:
        return f"on your word alone: {reading or 'this controller does not show where its tip is'}"
    hint = "" if at_sample else ": the tip is at the sample, or z counts the other way and it never reads withdrawn"
    said = f"the tip {'at the sample' if at_sample else 'withdrawn'}, as you say"
    expect(shown is at_sample, said, reading + hint)
    return f"confirmed: {reading}"


def tip_shown(read: Mapping[str, Parameter]) -> tuple[bool | None, str]:
    """Return whether readings show the tip at the sample, and in words which; None if they do not show it.

    A current of half the setpoint flows at the sample only. A smaller one shows nothing: the feedback may be off.
    """
    engaged, current, setpoint = (read.get(name) for name in (names.ENGAGED, names.CURRENT, names.ZCTRL_SETPOINT))
    found = None if engaged is None else engaged.value == "true"
    words = [] if engaged is None else [f"{names.ENGAGED} reads {engaged.value}"]
    if current is not None and setpoint is not None and same_kind(setpoint.unit or "", "A"):
        current_a, setpoint_a = number(current, "A"), number(setpoint, "A")
        words.append(f"{names.CURRENT} reads {quantity(current_a, 'A')}, the setpoint {quantity(setpoint_a, 'A')}")
        if abs(current_a) >= abs(setpoint_a) / 2.0 > 0.0:
            found = True
    return found, ", ".join(words)


@_step(
    "Setting a frame",
    "afspm sets a frame. Look where the panel draws it.",
    "Do not scan. Compare the values; report it with the trace of this run.",
    after=("panel", "withdrawn"),
    operations=(FRAME,),
    needs=_FRAME,
)
def _frame(guide: Guide) -> str:
    client, whole = guide.kit.client, guide.kit.frames.whole
    frames.ask_for(guide.kit, guide.kit.frames.plain.request(guide.kit.support))
    frames.require_in_force(guide.kit, guide.kit.frames.plain)
    count = _compare_frame(guide, guide.kit.frames.plain)
    x, y = whole.center_m
    moved = (x, y + 0.3 * whole.size_m[1])
    client.asked(ControlRequest.SET_SCAN_PARAMS, ScanParameters(_moved(guide, moved)), "moving the frame")
    client.settled(client.observations.mark())
    above = "The frame moved, by its y. Where to, in the panel's picture?"
    seen = guide.require_choice(above, "up", ["down", "left", "right"], "a frame of a larger y", UP)
    if not (count or seen):
        return guide.unseen()
    return f"{count} values are those of the panel{', and y points up there' if seen else ''}"


def _moved(guide: Guide, center_m: tuple[float, float]) -> RegionChange:
    left, low = guide.kit.frames.plain.region.moved_to(center_m).top_left_m
    return RegionChange(left_m=left, low_m=low)


@_step(
    "Turning a frame",
    "afspm turns the frame by 20 degrees counter-clockwise. Look which way the panel turns it.",
    "Do not use angles with this controller; report it with the trace of this run.",
    after=("frame",),
    operations=(ANGLE,),
    needs=(*_FRAME, names.SCAN_ANGLE),
)
def _angle(guide: Guide) -> str:
    frames.ask_for(guide.kit, guide.kit.frames.turned.request(guide.kit.support))
    frames.require_in_force(guide.kit, guide.kit.frames.turned)
    question = "In the panel's picture, which way is it turned against the frame before?"
    seen = guide.require_choice(question, "counter-clockwise", ["clockwise", "not turned"], "a turned frame", "angle")
    return "turned counter-clockwise" if seen else guide.unseen()


@_step(
    "A scan, and its end",
    "afspm takes one scan with the tip withdrawn. Watch the panel: press Enter at the moment at which it ends there.",
    "Stop the scan at the panel if it goes on. If afspm notices its end late, report it with the trace of this run.",
    after=("frame",),
    operations=(SCAN, END),
    needs=(names.START_SCAN,),
)
def _scan(guide: Guide) -> str:
    taken, panel_s = _watched(guide)
    scans.require_order(taken.observed, ScopeState.SCANNING, Scan)
    scans.require_frame(taken)
    begin_s, free_s = taken.time_s(ScopeState.SCANNING), taken.time_s(ScopeState.FREE)
    for one in taken.scans:
        if one.time_ns is not None:
            scans.require_time(one.time_ns, taken, ScopeState.SCANNING, f"scan {one.channel!r}")
    if panel_s is not None:
        late_s = guide.kit.client.clock.real_s(free_s - panel_s)
        wanted = f"the end of the scan within {_NOTICED_S:g} s of the panel's"
        expect(abs(late_s) <= _NOTICED_S, wanted, f"{abs(late_s):.0f} s {'later' if late_s > 0 else 'earlier'}")
    elif taken.expected_s is not None:
        wanted = f"a scan of about {taken.expected_s:.3g} s, by its speed"
        # The program's own delay is real time; in experiment time it is longer if the clock runs faster. At 20 times
        # real time, Park's second for further files took the scan of 8 s to 36 s, and the others' to 18 s.
        client = guide.kit.client
        own_s = max(2.0 * _NOTICED_S, guide.program_s / client.clock.real_s(1.0)) * client.patience
        most_s = 1.5 * taken.expected_s + own_s
        expect(free_s - begin_s <= most_s, wanted, f"{_lasted(guide, free_s - begin_s)} until its end was noticed")
    end_s = free_s if panel_s is None else panel_s
    if taken.expected_s is not None and (holds := line_time(guide, end_s - begin_s, taken.expected_s)) is not None:
        guide.seen[LINE_TIME] = holds
    channels = ", ".join(one.channel for one in taken.scans)
    return f"{_lasted(guide, free_s - begin_s)}, {len(taken.scans)} channels: {channels}"


def line_time(guide: Guide, lasted_s: float, expected_s: float) -> bool | None:
    """Return whether a scan took the time that its speed gives; None if that does not show."""
    if guide.kit.client.clock.real_s(1.0) < 1.0:
        return None  # the program's own time is a large part of a scan on a fast clock
    part = lasted_s / expected_s
    return True if 0.8 <= part <= 1.6 else False if part <= 0.6 or part >= 1.9 else None


def _lasted(guide: Guide, lasted_s: float) -> str:
    # the real duration is added where experiment time runs faster
    real_s = guide.kit.client.clock.real_s(lasted_s)
    return f"{lasted_s:.3g} s" if real_s == lasted_s else f"{lasted_s:.3g} s ({real_s:.2g} s of real time)"


def _watched(guide: Guide) -> tuple[Taken, float | None]:
    kit, client = guide.kit, guide.kit.client
    frame = kit.frames.plain
    expected_s = kit.prepare(frame, SCAN_S)
    mark, was_away = client.observations.mark(), _engaged(guide) is False
    kit.act(names.START_SCAN)
    client.wait_state(ScopeState.SCANNING, mark)
    if was_away:
        guide.seen[ENGAGES] = bool(_engaged(guide))
    answer = guide.at_panel("Enter when the panel shows that the scan has ended (u: you can't see it)")
    panel_s = None if answer is None or answer.strip() else client.clock.now_s()
    limit_s = 1200.0 if expected_s is None else 5.0 * expected_s + 60.0
    client.wait_state(ScopeState.FREE, mark, client.real_s(limit_s))
    observed = client.settled(mark)
    taken = Taken(frame, observed, expected_s)
    expect(taken.scans, "a Scan2d of the scan", "none: see the files of the controller")
    guide.kit.keep("scan of the plain frame", taken)
    guide.scans["in-the-air"] = taken.scans
    return taken, panel_s


@_step(
    "Files and folders",
    "afspm has read the files of the scan. Compare them with the controller's own.",
    "Set the folder in the experiment file, as the README of the driver says.",
    after=("scan",),
    moves=False,
    operations=(FILES,),
)
def _files(guide: Guide) -> str:
    found = guide.kit.scan("plain").scans
    for one in found:
        low, high = (float(value) for value in (np.nanmin(one.values), np.nanmax(one.values)))
        file = Path(one.filename).name if one.filename else "no file"
        guide.prompts.show(f"  {one.channel}: {low:.4g} to {high:.4g} {one.unit}  ({file})")
    question = "Are these the channels that the panel records, with these units and values?"
    guide.require_at_panel(question, "the panel's channels")
    return f"{len(found)} channels"


@_step(
    "A scan, watched while it fills",
    "afspm takes a scan upwards, reads its lines while it runs, and finds them in the scan that is saved at its end.",
    "Don't rely on lines of a running scan, nor on scans without a file: see the README of the driver for their order.",
    after=("scan",),
    about_lines=True,
    needs=(names.START_SCAN,),
)
def _lines(guide: Guide) -> str:
    kit, client = guide.kit, guide.kit.client
    if kit.support.has(names.SCAN_DIRECTION):
        client.set(names.SCAN_DIRECTION, names.UP)
    client.observations.lines.clear()
    # long enough in real time for some readings
    taken = kit.take_scan(kit.frames.plain, LINES_REAL_S / client.clock.real_s(1.0))
    if not client.observations.lines:
        raise Skipped("no line came while the scan ran: the log of this run may say why")
    roles = client.observations.newest(ChannelRoles) or ChannelRoles()
    found = [roles.shown(one) for one in taken.scans]
    places = [place for one in found for place in lines_in_scan.places(one, client.observations.lines)]
    if not places:
        raise Skipped("all lines are alike, or none is in the saved scan")
    guide.seen[ROWS] = right = all(place.is_row for place in places)
    back = [place for place in places if place.is_retrace]
    if back:
        guide.seen[COLUMNS] = not any(place.is_mirrored for place in back)
    wrong = [place for place in places if not place.is_row or place.is_mirrored]
    came = f"{len(wrong)} of {len(places)} elsewhere, {'mirrored' if right else 'in other rows'}"
    expect(not wrong, "each line where it is in the saved scan", came)
    return f"{len(places)} lines are where they are in the saved scan"


@_step(
    "Stopping a scan",
    "afspm begins a scan and stops it. Watch that the panel stops, too.",
    "Stop the scan at the panel. Do not leave this controller alone until this is solved.",
    after=("scan",),
    operations=(STOP,),
    needs=(names.START_SCAN, names.STOP_SCAN),
)
def _stop(guide: Guide) -> str:
    scans.cancel(guide.kit)
    guide.require_at_panel("Has the panel stopped, and does it wait?", "a panel that has stopped")
    return "stopped, and no scan was published"


@_step(
    "Stopping at the panel",
    "afspm begins a scan. Stop it at the panel: afspm has to notice.",
    "Take over by `afspm pause` before you touch the panel; report it with the trace of this run.",
    after=("stop",),
    needs_panel=True,
    operations=(STOP,),
    needs=(names.START_SCAN,),
)
def _stop_at_panel(guide: Guide) -> str:
    client = guide.kit.client
    mark = _act_in_scan(guide, "Stop the scan at the panel", "stopped")
    client.wait_state(ScopeState.FREE, mark, client.real_s(60.0))
    observed = client.settled(mark)
    if (engaged := _engaged(guide)) is not None and guide.seen.get(ENGAGES):
        guide.seen[STOP_WITHDRAWS] = not engaged
    _go_on(guide)
    expect(not published(observed), "no scan that was stopped at the panel", describe_all(observed))
    return "noticed, and no scan was published"


def _act_in_scan(guide: Guide, act: str, done: str) -> int:
    # begins a scan, and returns the mark before it once the person has acted at the panel
    client = guide.kit.client
    # a person needs time to click
    mark, lasts_s = guide.kit.begin_long_scan(guide.kit.frames.other, STOPPED_REAL_S)
    lasts = "an unknown time: be quick" if lasts_s is None else f"about {client.clock.real_s(lasts_s):.0f} s"
    guide.prompts.show(f"  The scan lasts {lasts}.")
    if guide.prompts.text(f"{act}, then press Enter (u: it can't be {done} there)").strip():
        client.come_to_rest()
        raise Skipped(f"not {done} at the panel")
    return mark


def _engaged(guide: Guide) -> bool | None:
    # whether the tip reads as at the sample; None if the controller does not show it
    return _is_on(guide, names.ENGAGED) if guide.kit.support.has(names.ENGAGED) else None


def _go_on(guide: Guide) -> None:
    # an act at the panel that a step asks for may take control away
    while to_do := guide.kit.client.continue_run(_LOST_S):
        if guide.prompts.text(f"{to_do}. Then press Enter (u: leave it)").strip():
            raise Lost(to_do)


@_step(
    "Losing the connection",
    "End the connection as the laboratory would: pull the network cable, or switch the controller's interface off. "
    "The tip stays as it is.",
    "Restore the connection, and see that nothing runs at the panel.",
    after=("stop",),
    needs_panel=True,
    operations=(LOSS,),
)
def _connection(guide: Guide) -> str:
    client, mark = guide.kit.client, guide.kit.client.observations.mark()
    if guide.prompts.text("End the connection, then press Enter (u: leave this out)").strip():
        raise Skipped("left out")
    client.wait_state(ScopeState.UNDEFINED, mark, _LOST_S)
    mark = client.observations.mark()
    guide.prompts.text("afspm has noticed. Restore the connection, then press Enter")
    client.wait_state(ScopeState.FREE, mark, _LOST_S)
    client.regain_control(_LOST_S)
    return "noticed, and found again"


# --- with the tip withdrawn: how the maker's program behaves by itself, as its driver claims ---


@_step(
    "Moving the frame while it is scanned",
    "afspm begins a scan. Move its frame at the panel, by a quarter of its width.",
    "Take over by `afspm pause` before you touch the panel; report it with the trace of this run.",
    after=("stop-at-panel",),
    for_claims=True,
    needs_panel=True,
    needs=(names.START_SCAN, names.STOP_SCAN),
)
def _frame_in_scan(guide: Guide) -> str:
    client = guide.kit.client
    mark = _act_in_scan(guide, "Move the frame at the panel", "moved")
    moved = guide.prompts.choose("Does the scan go on at the new place?", ("yes", "no", UNSEEN), UNSEEN)
    if moved != UNSEEN:
        guide.seen[MOVES] = moved == "yes"
    client.come_to_rest()
    observed = client.settled(mark)
    _go_on(guide)
    expect(not published(observed), "no scan of a frame that was moved", describe_all(observed))
    return "no scan was published"


@_step(
    "Pausing at the panel",
    "afspm begins a scan. Pause it at the panel: afspm may take it for ended.",
    "Do not pause scans at the panel; report it with the trace of this run.",
    after=("stop-at-panel",),
    for_claims=True,
    needs_panel=True,
    needs=(names.START_SCAN, names.STOP_SCAN),
)
def _pause_at_panel(guide: Guide) -> str:
    client = guide.kit.client
    mark = _act_in_scan(guide, "Pause the scan at the panel", "paused")
    ends = _comes(guide, lambda: client.state is not ScopeState.SCANNING, _NOTICED_S)
    guide.seen |= {PAUSE_ENDS: ends, PAUSE_UNSEEN: not ends}
    guide.prompts.text("Let the scan go on at the panel, then press Enter")
    client.come_to_rest()
    observed = client.settled(mark)
    _go_on(guide)
    expect(not published(observed), "no scan that was paused and stopped", describe_all(observed))
    return "taken for ended" if ends else "not shown by the controller"


def _comes(guide: Guide, done: Callable[[], bool], within_s: float) -> bool:
    try:
        guide.kit.client.wait(done, within_s, "")
    except Failed:
        return False
    return True


@_step(
    "Switching the feedback at the panel",
    "Switch the z feedback at the panel, and back: afspm reads it. The tip is out of reach of the sample.",
    "Do not rely on `x-feedback-on`: see the README of the driver; report it with the trace of this run.",
    after=("withdrawn",),
    for_claims=True,
    moves=False,
    needs_panel=True,
    needs=(names.FEEDBACK_ON,),
)
def _feedback_at_panel(guide: Guide) -> str:
    was_on = _is_on(guide, names.FEEDBACK_ON)
    for word, wanted in (("off" if was_on else "on", not was_on), ("on" if was_on else "off", was_on)):
        if guide.prompts.text(f"Switch the feedback {word} at the panel, then press Enter (u: leave it)").strip():
            raise Skipped("not switched at the panel")
        guide.seen["feedback-at-panel"] = follows = _is_on(guide, names.FEEDBACK_ON) is wanted
        expect(follows, f"{names.FEEDBACK_ON} to read {word}", "the other")
    _go_on(guide)
    return "read as the panel switches it"


def _is_on(guide: Guide, name: str) -> bool:
    return str(guide.kit.client.get(name).value).lower() in names.ON_WORDS


@_step(
    "A curve at the panel",
    "Take a curve at the panel that lasts some ten seconds. The tip is out of reach of the sample.",
    "Take curves by afspm alone while it scans.",
    after=("withdrawn",),
    for_claims=True,
    moves=False,
    needs_panel=True,
)
def _curve_at_panel(guide: Guide) -> str:
    client, mark = guide.kit.client, guide.kit.client.observations.mark()
    if guide.prompts.text("Begin a curve at the panel, then press Enter while it runs (u: leave it)").strip():
        raise Skipped("no curve was taken")
    _comes(guide, lambda: client.state is not ScopeState.FREE, _NOTICED_S)
    guide.seen[CURVE_AS_SCAN] = client.state is ScopeState.SCANNING
    shown = client.state.name
    client.settled(mark)
    _go_on(guide)
    return f"the state meanwhile: {shown}"


@_step(
    "A dialog on the controller's screen",
    "Open a dialog on the controller's screen, such as *Open file*: it may silence the program.",
    "Close all dialogs before a night.",
    after=("withdrawn",),
    for_claims=True,
    moves=False,
    needs_panel=True,
)
def _dialog(guide: Guide) -> str:
    client, mark = guide.kit.client, guide.kit.client.observations.mark()
    if guide.prompts.text("Open a dialog, then press Enter (u: leave this out)").strip():
        raise Skipped("left out")
    guide.seen[SILENCES] = silent = _comes(guide, lambda: client.state is ScopeState.UNDEFINED, _LOST_S)
    guide.prompts.text("Close the dialog, then press Enter")
    if silent:
        client.wait_state(ScopeState.FREE, mark, _LOST_S)
        client.regain_control(_LOST_S)
    return "the program is silent while it is open" if silent else "the program answers while it is open"


@_step(
    "What only you can see",
    "Questions about the maker's program, each answered by a look or a try at the panel. Leave out what you can't try.",
    "Nothing: each answer is a verdict on a claim of the driver.",
    after=("withdrawn",),
    for_claims=True,
    moves=False,
    needs_panel=True,
)
def _looks(guide: Guide) -> str:
    looks = [one for one in guide.claims.values() if one.step == LOOKS]
    for one in looks:
        if (seen := guide.prompts.choose(one.ask, ("yes", "no", UNSEEN), UNSEEN)) != UNSEEN:
            guide.seen[one.commission] = seen == "yes"
    _go_on(guide)
    return f"{sum(one.commission in guide.seen for one in looks)} of {len(looks)} were answered"


# --- in contact ---


@_step(
    "The tip is at the sample",
    "The last steps need a sample with something asymmetric in the frame. Approach by hand, as you always do, with the "
    "feedback on. afspm does not approach.",
    "Leave the tip withdrawn. All before this is reported.",
    after=("withdrawn", "scan", "stop"),
    moves=False,
    about_tip=True,
    remembered=False,
)
def _contact(guide: Guide) -> str:
    if not guide.kit.support.has(names.RETRACT):
        guide.prompts.show(
            "afspm can't withdraw the tip of this controller: stay at the panel until the steps are over."
        )
    if not guide.prompts.confirm("Is the tip at the sample, and the feedback stable?"):
        raise Declined("the tip stays withdrawn")
    _go_on(guide)
    guide.in_contact = True
    if guide.approaches and guide.kit.support.has(names.ENGAGE, names.ENGAGED):
        mark = guide.kit.client.observations.mark()
        guide.kit.act(names.ENGAGE)  # no hand can bring a simulated tip to its sample
        guide.kit.client.settled(mark, awaiting=ScopeState.FREE)
    expect(guide.kit.support.has(names.STOP_SCAN), "a controller whose scans can be stopped", "they can't be")
    feedback = guide.kit.client.observations.newest(Feedback)
    expect(feedback is None or feedback.on is not False, "the feedback on", "it is off")
    return _agreed(guide, at_sample=True)


@_step(
    "Moving the frame",
    "afspm takes six scans: one, one moved along x, one moved along y, the first again, and two of a turned frame, and "
    "compares how far and where to the picture moves.",
    "Do not use positions of this controller: the report names the fault. Compare the scanner's calibration of the "
    "offset and of the scan range at the panel, and the angle. A scan too fast for the feedback shows wrong lengths: "
    "repeat it more slowly first. Then report it with the trace of this run.",
    after=("contact",),
    contact=True,
    operations=(AXES,),
    needs=(names.START_SCAN, *_FRAME),
)
def _moved_frame(guide: Guide) -> str:
    kit = guide.kit
    upright = [
        kit.frames.part(offset, moved_frame.PART, moved_frame.PIXELS)
        for offset in (*moved_frame.OFFSETS, moved_frame.OFFSETS[0])
    ]
    x, y = 0.1 * math.cos(TURN_RAD), 0.1 * math.sin(TURN_RAD)
    turned = [kit.frames.part(sign, moved_frame.PART, moved_frame.PIXELS, TURN_RAD) for sign in ((-x, -y), (x, y))]
    taken = [kit.take_scan(one).scans for one in (*upright, *(turned if kit.support.has(names.SCAN_ANGLE) else ()))]
    (x_move, y_move, drift), *of_turned = moved_frame.moves(taken)
    found = moved_frame.faults(x_move, y_move, of_turned[0][0] if of_turned else None, math.degrees(TURN_RAD))
    if found:
        failure = Failed("a picture that moves as its frame does", "; ".join(found))
        kit.excuse("scan/picture", failure)
        raise failure
    lengths = " and ".join(f"{np.hypot(*one):.3f}" for one in (x_move, y_move))
    return f"moves of 1 show as {lengths} along x and y; drift of {np.hypot(*drift):.3f} moves in three scans"


@_step(
    "Axes and angles",
    "afspm takes a larger scan and details of it, one turned, and fits the details into it. Then compare the picture.",
    "Do not use what was measured: axes or angles are wrong. Report it with the trace of this run.",
    after=("contact", "moved-frame"),
    contact=True,
    operations=(AXES,),
    needs=(names.START_SCAN,),
)
def _axes(guide: Guide) -> str:
    guide.kit.forget()  # those measurements were taken with the tip withdrawn
    try:
        picture.picture(guide.kit)
    except Failed as failure:
        guide.kit.excuse("scan/picture", failure)
        raise
    taken = guide.kit.scan("wide" if guide.kit.can_pass("scan/not-square") else "plain").scans
    guide.scans["at-the-sample"] = taken
    roles = guide.kit.client.observations.newest(ChannelRoles) or ChannelRoles()
    if (same_way := lines_in_scan.retrace_runs_as_trace([roles.shown(one) for one in taken])) is not None:
        guide.seen[BACKWARD] = same_way
    scan = next((one for one in taken if one.unit == "m"), taken[0])
    file = guide.folder / "commissioning.png"
    levels = raster.indices(scan.values[::-1], raster.value_range(scan.values))
    file.write_bytes(raster.png(levels))
    guide.prompts.show(f"  {scan.channel}, y upwards: {file}")
    guide.require_at_panel("Does the panel show the same picture, not mirrored and not turned?", "the panel's picture")
    return "details fit into the larger scan as reported"


@_step(
    "The feedback, off and on again",
    f"afspm switches the z feedback off for {_HELD_S:g} s, holds z, and switches it on again. z is read before, "
    "meanwhile and after. A tip lift of the controller would show here.",
    "Do not hold z with this controller (constant height, `hold_z`): switch its tip lift off, or report it with the "
    "trace of this run.",
    after=("contact",),
    contact=True,
    needs=(names.FEEDBACK_ON, names.TIP_Z, names.HOLD_Z, names.RELEASE_Z),
)
def _held_z(guide: Guide) -> str:
    kit, client = guide.kit, guide.kit.client
    unit = {names.TIP_Z: "m"}
    before = _readings(guide, unit, 3.0 * _HELD_S)[names.TIP_Z]
    row = guide.rows.get(names.TIP_Z)
    # the translator compares means of as many readings
    means = [float(one.mean()) for one in np.array_split(before, len(before) // _LEAST_READINGS)]
    if row is not None and (spread := guide.propose_resolution(row, means)):
        raise Skipped(f"z differs by {spread} between means of {_LEAST_READINGS} readings, with the feedback on")
    kit.act(names.HOLD_Z)
    held = _readings(guide, unit, _HELD_S)[names.TIP_Z]
    mark = client.observations.mark()
    kit.act(names.RELEASE_Z)
    client.settled(mark, awaiting=ScopeState.FREE)
    expect(_is_on(guide, names.FEEDBACK_ON), "the feedback on again", "it is off")
    after = _readings(guide, unit)[names.TIP_Z]
    by = [quantity(float(np.mean(one) - np.mean(before)), "m") for one in (held, after)]
    return f"z moved by {by[0]} while it was off, and by {by[1]} once it was on again"
