"""Buttons and dialogs for what a person can do. The result is shown, with the reason of a refusal."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from functools import partial
from html import escape

from nicegui import background_tasks, context, events, ui

from afspm.dashboard.access import Visitor
from afspm.dashboard.actions import Action, ActionResult, Actions, Steering
from afspm.dashboard.content import Content
from afspm.dashboard.watch import Watch
from afspm.formatting import time_of_day, typeset_area, typeset_position
from afspm.model import ControlMode, Region, names

PARAMETERS = tuple(names.BASE_PARAMETERS)


class SteeringPanel:
    """The buttons, for a viewer who has signed in; for others a word about that."""

    def __init__(self, watch: Watch, steering: Steering, visitor: Visitor) -> None:
        self._watch = watch
        self._steering = steering
        self._visitor = visitor
        self._content = Content()
        self._client = context.client
        if not visitor.may_steer:
            ui.html('<p>You may look. To steer, <a href="/login">sign in</a> with your name.</p>', sanitize=False)
            return
        self._mode_buttons()
        self._problem_buttons()
        self._microscope_buttons()
        self._results = ui.html("", sanitize=False).classes("outcomes").props('role="status" aria-live="polite"')
        ui.on("scan_here", self._ask_scan)
        ui.on("spectrum_here", self._ask_spectrum)

    @property
    def may_steer(self) -> bool:
        """True if the viewer has signed in, and the experiment goes on."""
        return self._visitor.may_steer and not self._content.ended

    @property
    def may_measure(self) -> bool:
        """True if the viewer can ask the microscope for something."""
        return self.may_steer and self._content.is_manual

    def show(self, content: Content) -> None:
        """Bring it up to date."""
        before, self._content = self._content, content
        if not self._visitor.may_steer:
            return
        self._manual.set_visibility(not content.is_manual)
        self._automated.set_visibility(content.is_manual)
        self._by_hand.set_visibility(content.is_manual)
        self._not_by_hand.set_visibility(not content.is_manual)
        if content.problems != before.problems:
            self._offer_problems()

    # --- the experiment ---

    def _mode_buttons(self) -> None:
        with ui.element("div").classes("acts"):
            self._manual = _button("Take over: MANUAL", lambda: self._do(lambda a: a.set_mode(ControlMode.MANUAL)))
            self._automated = _button(
                "Hand back: AUTOMATED", lambda: self._do(lambda a: a.set_mode(ControlMode.AUTOMATED)), "primary"
            )
            _button("Stop the scan", self._ask_stop)
            _button("End the experiment …", self._ask_end, "negative").props("outline")

    def _problem_buttons(self) -> None:
        ui.html("<h3>Problems</h3>", sanitize=False)
        self._flagged = ui.element("div").classes("acts")
        with ui.element("div").classes("acts"):
            options = {number: name for name, number in self._watch.problems.items()}
            self._problem = ui.select(options, label="problem", value=next(iter(options))).props("dense outlined")
            _button("Raise", lambda: self._do(partial(Actions.flag, problem=int(self._problem.value))))

    def _offer_problems(self) -> None:
        self._flagged.clear()
        with self._flagged:
            for number, name, _ in self._content.problems:
                _button(f"Clear {name}", partial(self._do, partial(Actions.clear, problem=number)))
            if len(numbers := [number for number, *_ in self._content.problems]) > 1:
                _button("Clear all problems", partial(self._do, partial(Actions.clear_all, problems=numbers)))

    async def _ask_end(self) -> None:
        if await _asked("End the experiment?", "All components stop; what was measured is kept.", "End it") and (
            await _asked("Really?", "It can't be gone on with from here.", "Yes, end the experiment")
        ):
            self._do(lambda a: a.end())

    async def _ask_stop(self) -> None:
        if self._content.is_manual:
            self._do(lambda a: a.stop_scan())
        elif await _asked(
            "Stop the scan?",
            "A component is in control. To stop its scan the mode is set to MANUAL first; components go on when you "
            "hand back.",
            "Set MANUAL and stop",
        ):
            self._do(lambda a: a.stop_scan(by_manual=True))

    async def ask_restart(self, name: str) -> None:
        """Start a process anew, after a question."""
        if await _asked(f"Restart {name}?", "It is ended and started anew; what it keeps on disk stays.", "Restart"):
            self._do(lambda a: a.restart(name))

    # --- the microscope, in MANUAL ---

    def _microscope_buttons(self) -> None:
        ui.html("<h3>Microscope</h3>", sanitize=False)
        self._not_by_hand = ui.label("In MANUAL you can set parameters, scan and take spectra here.").classes("quiet")
        self._by_hand = ui.element("div")
        with self._by_hand:
            with ui.element("div").classes("acts"):
                _button("Scan as set", lambda: self._do(lambda a: a.scan()))
                _button("Spectrum at the probe", lambda: self._do(lambda a: a.spectrum()))
            ui.label("Or choose Scan here or Spectrum here over the scan, and click in it.").classes("quiet")
            with ui.element("div").classes("acts"):
                self._parameter = ui.select(list(PARAMETERS), label="parameter", on_change=self._read)
                self._parameter.props("dense outlined options-dense")
                self._value = ui.input("value with unit").props("dense outlined").on("keydown.enter", self._set)
                _button("Set", self._set)
            self._in_force = ui.label().classes("quiet").props('role="status"')

    async def _read(self) -> None:
        name = self._parameter.value
        if not name:
            return
        self._in_force.set_text("…")
        result = await self._carry_out(lambda a: a.read(str(name)))
        self._in_force.set_text(f"{name} is {result.text}" if result.ok else result.text)

    async def _set(self) -> None:
        name, text = self._parameter.value, str(self._value.value or "").strip()
        if not name or not text:
            self._say(ActionResult("Choose a parameter, and write a value with its unit.", ok=False))
            return
        result = await self._carry_out(lambda a: a.set(str(name), text))
        self._say(result)
        if result.ok:
            self._in_force.set_text(result.text)

    async def _ask_scan(self, event: events.GenericEventArguments) -> None:
        place = event.args
        size = (float(place["width"]), float(place["height"]))
        region = Region((float(place["x"]), float(place["y"])), size, float(place["angle"]))
        shape = _shape(int(place["rows"]), int(place["columns"]), size)
        angle = f", turned by {math.degrees(region.angle_rad):.3g}°" if region.angle_rad else ""
        what = f"{typeset_area(size)} at {typeset_position(region.center_m)}{angle}, {shape[1]} × {shape[0]} px"
        if await _asked("Scan here?", what, "Scan"):
            self._do(lambda a: a.scan(region, shape))

    async def _ask_spectrum(self, event: events.GenericEventArguments) -> None:
        at_m = (float(event.args["x"]), float(event.args["y"]))
        if await _asked("Spectrum here?", f"The probe moves to {typeset_position(at_m)}.", "Take it"):
            self._do(lambda a: a.spectrum(at_m))

    # --- within ---

    def _do(self, action: Action) -> None:
        """Carry out an action; the page goes on meanwhile."""

        async def doing() -> None:
            result = await self._carry_out(action)
            with self._client:
                self._say(result)

        background_tasks.create(doing())

    async def _carry_out(self, action: Action) -> ActionResult:
        return await asyncio.wrap_future(self._steering.do(self._visitor, action))

    def _say(self, result: ActionResult) -> None:
        style = "done" if result.ok else "refused"
        time = time_of_day(self._watch.clock.now_ns())
        self._results.set_content(f'<p class="{style}"><time>{time}</time> {escape(result.text)}</p>')
        if result.ok:
            ui.notify(result.text, type="positive", position="bottom-right", timeout=4000)
        else:  # stays until it is read
            ui.notify(result.text, type="negative", position="bottom-right", timeout=0, close_button="Close")


def _button(text: str, on_click: Callable[..., object], colour: str | None = None) -> ui.button:
    return ui.button(text, on_click=on_click, color=colour).props(
        f"no-caps {'unelevated' if colour == 'primary' else 'outline'}"
    )


async def _asked(title: str, text: str, yes: str) -> bool:
    """Ask the viewer, in a dialog that Escape leaves."""
    with ui.dialog() as dialog, ui.card().classes("question").props('role="alertdialog"'):
        ui.html(f"<h3>{escape(title)}</h3>", sanitize=False)
        ui.label(text)
        with ui.element("div").classes("acts"):
            ui.button("Cancel", on_click=lambda: dialog.submit(None), color=None).props("no-caps flat autofocus")
            ui.button(yes, on_click=lambda: dialog.submit(yes)).props("no-caps unelevated")
    answer = await dialog
    dialog.clear()
    dialog.delete()
    return bool(answer)


def _shape(rows: int, columns: int, size: tuple[float, float]) -> tuple[int, int]:
    """As many pixels along the longer side as before, square ones."""
    most = max(rows, columns)
    longest = max(size)
    return max(1, round(most * size[1] / longest)), max(1, round(most * size[0] / longest))
