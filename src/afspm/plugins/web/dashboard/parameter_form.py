"""A form with the parameters of the microscope; all edited values are set together."""

from __future__ import annotations

from collections.abc import Mapping

from nicegui import background_tasks, ui

from afspm.model import names
from afspm.plugins.web.dashboard.actions import ActionResult
from afspm.plugins.web.dashboard.steering_session import SteeringSession, button

PARAMETERS = tuple(names.BASE_PARAMETERS)


class ParameterForm:
    """A field for each settable parameter: all parameters in MANUAL, the adjustable parameters in AUTOMATED."""

    def __init__(self, session: SteeringSession) -> None:
        self._session = session
        self._offered: tuple[str, ...] = ()
        self._settings: object = None
        self._is_reading = False
        self._in_force: dict[str, str] = {}
        self._fields: dict[str, ui.input] = {}
        with ui.element("div").classes("parameters") as self._box:
            self._rows = ui.element("div").classes("fields")
            with ui.element("div").classes("acts"):
                button("Set", self._set, "primary")
                button("Read again", lambda: self._read())
        self._box.set_visibility(False)

    def show(self) -> None:
        """Show the parameters that may be set at present."""
        content = self._session.content
        offered = () if content.ended else PARAMETERS if content.is_manual else content.adjustable
        settings = (tuple(map(content.set_ns.get, offered)), content.feedback)
        if offered == self._offered:
            # set by another person or a component; the feedback also at the controller
            if offered and settings != self._settings and not self._is_reading:
                self._settings = settings
                background_tasks.create(self._read(edited_too=False))
            return
        self._offered, self._settings = offered, settings
        self._box.set_visibility(bool(offered))
        self._rows.clear()
        self._fields, self._in_force = {}, {}
        if offered:
            # not awaited: while the microscope is slow to answer, the page must go on, with its button to stop
            background_tasks.create(self._read())

    async def _read(self, *, edited_too: bool = True) -> None:
        offered, self._is_reading = self._offered, True
        try:
            result = await self._session.carry_out(lambda a: a.read(offered))
        finally:
            self._is_reading = False
        if offered == self._offered and not self._rows.is_deleted:
            self._take(result.each, edited_too=edited_too)

    def _take(self, told: Mapping[str, ActionResult], *, edited_too: bool = True) -> None:
        # a refused parameter does not exist on this microscope
        for name, one in told.items():
            if not one.ok:
                continue
            if name not in self._fields:
                with self._rows:
                    self._fields[name] = ui.input(name).props("dense outlined").on("keydown.enter", self._set)
            is_edited = name in self._in_force and self._fields[name].value != self._in_force[name]
            self._in_force[name] = one.text
            if is_edited and not edited_too:
                continue
            self._fields[name].set_value(one.text)
            self._fields[name].props(remove="error error-message")

    async def _set(self) -> None:
        wanted = {
            name: text
            for name, field in self._fields.items()
            if (text := str(field.value or "").strip()) != self._in_force[name]
        }
        if not wanted:
            self._session.say(ActionResult("Nothing was changed: edit a value first.", ok=False))
            return
        shown = dict(self._in_force)
        result = await self._session.carry_out(lambda a: a.set(wanted, shown))
        if self._rows.is_deleted:
            return
        self._session.say(result)
        for name, one in result.each.items():
            if not one.ok:
                self._fields[name].props("error").props["error-message"] = one.text
        done = tuple(name for name, one in result.each.items() if one.ok)
        self._take((await self._session.carry_out(lambda a: a.read(done))).each)
