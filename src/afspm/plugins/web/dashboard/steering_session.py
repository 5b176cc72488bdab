"""The actions that one viewer may do at present, shared by all panels of the page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from html import escape
from pathlib import Path

from nicegui import background_tasks, context, ui

from afspm.basics import time_of_day
from afspm.plugins.web.dashboard.access import Visitor
from afspm.plugins.web.dashboard.actions import Action, ActionResult, Steering
from afspm.plugins.web.dashboard.content import Content
from afspm.plugins.web.watch import Watch

_CLOSE = [{"label": "Close", "color": "white"}]


class SteeringSession:
    """The actions of one viewer, and the display of their results."""

    def __init__(self, watch: Watch, steering: Steering, visitor: Visitor, run_dir: Path) -> None:
        self.watch, self.run_dir = watch, run_dir
        self.content = Content()
        self._steering = steering
        self._visitor = visitor
        self._client = context.client
        self._results: ui.html | None = None

    @property
    def signed_in(self) -> bool:
        return self._visitor.may_steer

    @property
    def may_steer(self) -> bool:
        """True if the viewer is signed in and the experiment is running."""
        return self.signed_in and not self.content.ended

    @property
    def may_measure(self) -> bool:
        """True if the viewer can command the microscope."""
        return self.may_steer and self.content.is_manual

    def results(self) -> None:
        """Create the element that shows the last result."""
        self._results = ui.html("", sanitize=False).classes("outcomes").props('role="status" aria-live="polite"')

    def do(self, action: Action, *, urgent: bool = False) -> None:
        """Carry out an action in the background and show its result.

        Args:
            urgent: earlier actions of this person stop waiting for a free microscope.
        """

        async def doing() -> None:
            result = await self.carry_out(action, urgent=urgent)
            # the viewer may have closed the page meanwhile; a background task has no page of its own
            if not self._client.is_deleted:
                with self._client:
                    self.say(result)

        background_tasks.create(doing())

    async def carry_out(self, action: Action, *, urgent: bool = False) -> ActionResult:
        """Carry out an action, and return its result."""
        return await asyncio.wrap_future(self._steering.do(self._visitor, action, urgent=urgent))

    def say(self, result: ActionResult) -> None:
        """Show a result."""
        style = "done" if result.ok else "refused"
        time = time_of_day(self.watch.clock.now_ns())
        if self._results is not None:
            self._results.set_content(f'<p class="{style}"><time>{time}</time> {escape(result.text)}</p>')
        if result.ok:
            ui.notify(result.text, position="bottom-right", timeout=4000, classes="toast done")
        else:  # stays until it is read
            ui.notify(result.text, position="bottom-right", timeout=0, classes="toast refused", actions=_CLOSE)


def button(text: str, on_click: Callable[..., object], colour: str | None = None) -> ui.button:
    """Return a button, which is filled if `colour` is "primary"."""
    return ui.button(text, on_click=on_click, color=colour).props(
        f"no-caps {'unelevated' if colour == 'primary' else 'outline'}"
    )


async def asked(title: str, text: str, yes: str) -> bool:
    """Ask a yes-or-no question in a dialog; return False if the viewer cancels or closes the browser."""

    def body() -> None:
        ui.label(text)

    return await ask_in_dialog(title, body, yes)


async def ask_in_dialog(
    title: str, body: Callable[[], object], yes: str, may: Callable[[], bool] = lambda: True
) -> bool:
    """Ask the viewer in a dialog with its own body; return False if the viewer cancels.

    The button `yes` closes the dialog only while `may()` is true.
    """

    def agree() -> None:
        if may():
            dialog.submit(yes)

    with ui.dialog() as dialog, ui.card().classes("question").props('role="alertdialog"'):
        ui.html(f"<h3>{escape(title)}</h3>", sanitize=False)
        body()
        with ui.element("div").classes("acts"):
            ui.button("Cancel", on_click=lambda: dialog.submit(None), color=None).props("no-caps flat autofocus")
            ui.button(yes, on_click=agree).props("no-caps unelevated")
    answer = await dialog
    if not dialog.is_deleted:  # a closed browser has already deleted it
        dialog.clear()
        dialog.delete()
    return bool(answer)
