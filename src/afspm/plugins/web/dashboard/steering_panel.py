"""Buttons and dialogs for a person's actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from html import escape

from nicegui import events, ui

from afspm.basics import PlainMapping, time_of_day, typeset_position
from afspm.drawing import tint_class
from afspm.model import ControlMode, Region, TipStatus
from afspm.plugins.web.dashboard.actions import Actions
from afspm.plugins.web.dashboard.content import Content, NotAsPlanned
from afspm.plugins.web.dashboard.flags import Flag
from afspm.plugins.web.dashboard.page_parts import page_part
from afspm.plugins.web.dashboard.parameter_form import ParameterForm
from afspm.plugins.web.dashboard.scan_dialog import ScanDialog
from afspm.plugins.web.dashboard.steering_session import SteeringSession, asked, button

_MANUAL = "Scan here and Spectrum here, beside the scan, measure where you point."
_TAKE_OVER = "In MANUAL you can set parameters, scan and take spectra here."
_ADJUST = "Changes hold from the next line on. In MANUAL you can set all parameters, and scan."


class ModeButtons:
    """The buttons to take over and to hand back, which are always visible."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        self._manual = self._automated = None
        if session.signed_in:
            self._manual = button("Take over: MANUAL", lambda: self._set(ControlMode.MANUAL), "primary")
            self._automated = button("Hand back: AUTOMATED", self._hand_back, "primary")
            self._automated.set_visibility(False)

    def show(self) -> None:
        if self._manual is not None and self._automated is not None:
            is_manual, may = self._session.content.is_manual, self._session.may_steer
            self._manual.set_visibility(may and not is_manual)
            self._automated.set_visibility(may and is_manual)

    def _set(self, mode: ControlMode) -> None:
        self._session.do(lambda a: a.set_mode(mode), urgent=True)

    async def _hand_back(self) -> None:
        content = self._session.content
        if content.by_hand:
            now = (content.tip or TipStatus()).to_continue_with
            text = f"{content.by_hand[:1].upper()}{content.by_hand[1:]}. Now {now}. Components will measure again."
            if not await asked("Let the run continue?", text, "Continue"):
                return
        self._set(ControlMode.AUTOMATED)


class ProblemBar:
    """A line for each flagged problem, with advice and a button to clear it, and for a person at the microscope."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        self._shown: tuple[object, ...] = ()
        self._box = ui.element("div").classes("problems").props('role="alert"')
        self._box.set_visibility(False)

    def show(self) -> None:
        content, may = self._session.content, self._session.may_steer
        flags, by_hand, remedy = content.problems, content.by_hand, content.tip.remedy if content.tip else ""
        if (flags, may, by_hand, remedy) == self._shown:
            return
        self._shown = (flags, may, by_hand, remedy)
        self._box.set_visibility(bool(flags or by_hand))
        self._box.clear()
        with self._box:
            if by_hand:
                with ui.element("div").classes("flag"):
                    ui.html(_by_hand_html(by_hand, remedy), sanitize=False)
            for flag in flags:
                with ui.element("div").classes("flag"):
                    ui.html(_flag_html(flag), sanitize=False)
                    if may:
                        clear = button("Clear", partial(self._clear, [flag]))
                        clear.props["aria-label"] = f"Clear {flag.name}"  # as text a name could set other properties
                    if may and flag is flags[-1] and len(flags) > 1:
                        button("Clear all problems", partial(self._clear, flags)).classes("all")

    def _clear(self, flags: Sequence[Flag]) -> None:
        numbers = [flag.number for flag in flags]
        if len(numbers) == 1:
            self._session.do(lambda a: a.clear(numbers[0]))
        else:
            self._session.do(lambda a: a.clear_all(numbers))


class SettingsBar:
    """A line for each value in the place of a plan's, and in MANUAL for each one that a plan would set again."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        self._shown: tuple[object, ...] = ()
        self._box = ui.element("div").classes("problems approvals")
        self._box.set_visibility(False)

    def show(self) -> None:
        found, may = self._session.content.not_as_planned, self._session.may_steer
        if (found, may) == self._shown:
            return
        self._shown = (found, may)
        self._box.set_visibility(bool(found))
        self._box.clear()
        with self._box:
            for one in found:
                with ui.element("div").classes("flag"):
                    what = "After you hand back" if one.is_asked else "Not as planned"
                    ui.html(f'<b data-part="setting">{what}</b> <small>{escape(one.text)}</small>', sanitize=False)
                    if may:
                        button("Keep mine" if one.is_asked else "As planned", partial(self._settle, one))

    def _settle(self, one: NotAsPlanned) -> None:
        self._session.do(lambda a: a.settle_plan(one.parameter, keeps=one.is_asked))


def _by_hand_html(by_hand: str, remedy: str) -> str:
    advice = f"{remedy}; then hand back." if remedy else "Nothing is sent to the microscope until you hand back."
    return (
        f'<b data-part="by-hand">A person is at the microscope</b> <small>{escape(by_hand)}</small>'
        f'<span class="advice">{escape(advice[:1].upper() + advice[1:])}</span>'
    )


def _flag_html(flag: Flag) -> str:
    by = f'flagged by <i class="{tint_class(flag.by)}">{escape(flag.by)}</i>' if flag.by else "flagged"
    since = f" at {time_of_day(flag.since_ns)}" if flag.since_ns is not None else ""
    return (
        f'<b data-part="problem">{escape(flag.name)}</b> <small>{by}{since}</small>'
        f'<span class="advice">{escape(flag.advice)}</span>'
    )


class SteeringPanel:
    """The buttons for a signed-in viewer."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        with ui.element("div").classes("acts"):
            button("Stop the scan", self._ask_stop)
            self._by_hand = [
                button("Scan as set", lambda: session.do(lambda a: a.scan())),
                button("Spectrum at the probe", lambda: session.do(lambda a: a.spectrum())),
            ]
        self._hint = ui.label().classes("quiet")
        session.results()
        self._parameters = ParameterForm(session)
        ui.html("<h3>Flag a problem</h3>", sanitize=False)
        with ui.element("div").classes("acts"):
            options = {number: name for name, number in session.watch.problems.items()}
            self._problem = ui.select(options, label="problem", value=next(iter(options))).props("dense outlined")
            button("Flag", lambda: session.do(partial(Actions.flag, problem=int(self._problem.value))))
        with ui.element("div").classes("acts") as self._agents:
            button("Give an agent a grant …", self._give_grant)
        self._agents.set_visibility(False)
        self._grant_dialog = page_part("grant")
        with ui.element("div").classes("acts"):
            button("End the experiment …", self._ask_end, "negative").props("outline")
        ui.on("scan_here", self._ask_scan)
        ui.on("spectrum_here", self._ask_spectrum)
        ui.on("grant_here", self._ask_grant)

    def show(self, content: Content) -> None:
        """Show the buttons and parameters that are usable at present."""
        for one in self._by_hand:
            one.set_visibility(content.is_manual)
        self._hint.set_text(_MANUAL if content.is_manual else _ADJUST if content.adjustable else _TAKE_OVER)
        self._agents.set_visibility(bool(content.agents and self._session.may_steer and self._grant_dialog))
        self._parameters.show()

    async def _ask_end(self) -> None:
        if await asked("End the experiment?", "All components stop. All measurements are kept.", "End it") and (
            await asked("Really?", "The experiment can't be continued from here.", "Yes, end the experiment")
        ):
            self._session.do(lambda a: a.end(), urgent=True)

    async def _ask_stop(self) -> None:
        if self._session.content.is_manual:
            self._session.do(lambda a: a.stop_scan(), urgent=True)
        elif await asked(
            "Stop the scan?",
            "A component is in control. This sets the mode to MANUAL, then stops the scan; components go on when you "
            "hand back.",
            "Set MANUAL and stop",
        ):
            self._session.do(lambda a: a.stop_scan(by_manual=True), urgent=True)

    async def _ask_scan(self, event: events.GenericEventArguments) -> None:
        dialog = ScanDialog.of_place(event.args)
        wanted = await dialog.ask()
        ui.run_javascript("window.afspm?.image?.want(null)")
        if wanted is not None:
            self._session.do(lambda a: a.scan(*wanted))

    async def _give_grant(self) -> None:
        await self._grant_dialog(self._session, self._session.content.agents, None).show()

    async def _ask_grant(self, event: events.GenericEventArguments) -> None:
        await self._grant_dialog(self._session, self._session.content.agents, drawn_box(event.args)).show()

    async def _ask_spectrum(self, event: events.GenericEventArguments) -> None:
        at_m = (float(event.args["x"]), float(event.args["y"]))
        if await asked("Spectrum here?", f"The probe moves to {typeset_position(at_m)}.", "Take it"):
            self._session.do(lambda a: a.spectrum(at_m))


def drawn_box(place: PlainMapping) -> Region:
    """Return the box along x and y around a rectangle from the picture's script, since a grant has no angle."""
    x, y, width, height, angle = (float(place[name]) for name in ("x", "y", "width", "height", "angle"))
    cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
    return Region((x, y), (width * cos + height * sin, width * sin + height * cos))


async def ask_restart(session: SteeringSession, name: str) -> None:
    if await asked(f"Restart {name}?", "The process is ended and restarted. Its data on disk is kept.", "Restart"):
        session.do(lambda a: a.restart(name))
