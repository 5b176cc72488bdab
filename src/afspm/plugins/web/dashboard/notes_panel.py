"""The notes of a run, and a line to write one."""

from __future__ import annotations

import asyncio

from nicegui import context, ui

from afspm.plugins.web.dashboard.access import Visitor
from afspm.plugins.web.dashboard.actions import ActionResult, Steering
from afspm.plugins.web.watch import Watch

MOMENT, SCAN = "this moment", "the scan shown"
_SHOWN = "return window.afspm?.image?.head?.time_ns ?? ''"


class NotesPanel:
    """Lists the notes, and lets a viewer who has signed in write one."""

    def __init__(self, watch: Watch, steering: Steering, visitor: Visitor) -> None:
        self._watch = watch
        self._steering = steering
        self._visitor = visitor
        self._client = context.client
        if visitor.person:
            with ui.element("div").classes("acts"):
                self._text = ui.input("note").props("dense outlined").classes("text").on("keydown.enter", self._write)
                self._on = ui.select([SCAN, MOMENT], value=SCAN, label="on").props("dense outlined")
                ui.button("Note", on_click=self._write, color=None).props("no-caps outline")
        else:
            ui.html('<p class="quiet"><a href="/login">Sign in</a> to write a note.</p>', sanitize=False)
        self._list = ui.html("", sanitize=False).classes("scrolled").props('tabindex="0"')

    def show(self, notes: str) -> None:
        """Bring the list up to date."""
        self._list.set_content(notes)

    async def _write(self) -> None:
        text, time_ns, scan_ns = str(self._text.value or "").strip(), self._watch.moment_ns, None
        if self._on.value == SCAN:
            shown = await ui.run_javascript(_SHOWN)
            if not shown:
                self._say(ActionResult("The scan shown is not finished: write the note on this moment.", ok=False))
                return
            scan_ns, time_ns = int(shown), None
        doing = self._steering.do(self._visitor, lambda actions: actions.note(text, scan_ns, time_ns))
        result = await asyncio.wrap_future(doing)
        if not self._client.is_deleted:
            self._say(result)

    def _say(self, result: ActionResult) -> None:
        with self._client:
            ui.notify(result.text, type="positive" if result.ok else "negative", position="bottom-right")
            if result.ok:
                self._text.set_value("")
