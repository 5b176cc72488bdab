"""`ShadowMarks`: the table of a shadow on a recorded night's page, where a person marks each row right or wrong."""

from __future__ import annotations

import asyncio
from html import escape
from pathlib import Path

from nicegui import context, ui

from afspm import open_run
from afspm.basics import time_of_day
from afspm.plugins.web.dashboard.access import Visitor
from afspm.plugins.web.dashboard.actions import Steering
from afspm.report import shadow_report


class ShadowMarks:
    """The rows of a shadow's table, each with its mark; viewers who have signed in have two buttons a row.

    Args:
        night: the table as it is read at the start of the page.
    """

    def __init__(self, folder: Path, night: shadow_report.ShadowNight, steering: Steering, visitor: Visitor) -> None:
        self._folder, self._steering, self._visitor = folder, steering, visitor
        self._client = context.client
        self._figures = ui.html("", sanitize=False)
        self._marks: dict[int, ui.html] = {}
        with ui.element("div").classes("scrolled"):
            for row in night.rows:
                with ui.element("div").classes("acts shadow-row"):
                    self._row(row)
        self._show(night)

    def _row(self, row: shadow_report.ShadowRow) -> None:
        parts = (escape(row.would), row.answer and f"<i>{escape(row.answer)}</i>")
        words = f"<b>{row.number} {escape(row.kind)}</b> {' — '.join(filter(None, parts))}"
        ui.html(f"<span><time>{time_of_day(row.time_ns)}</time> {words}</span>", sanitize=False)
        self._marks[row.number] = ui.html("", sanitize=False).classes("quiet")
        if self._visitor.person:
            for opinion in (shadow_report.RIGHT, shadow_report.WRONG):
                button = ui.button(
                    opinion, on_click=lambda row=row, opinion=opinion: self._mark(row, opinion), color=None
                )
                button.props(f'no-caps outline dense aria-label="row {row.number} is {opinion}"')

    async def _mark(self, row: shadow_report.ShadowRow, opinion: str) -> None:
        text = shadow_report.mark_text(row, opinion)
        doing = self._steering.do(self._visitor, lambda actions: actions.note(text, None, row.time_ns))
        result = await asyncio.wrap_future(doing)
        night = await asyncio.to_thread(read, self._folder)
        if not self._client.is_deleted:
            with self._client:
                ui.notify(result.text, type="positive" if result.ok else "negative")
            self._show(night)

    def _show(self, night: shadow_report.ShadowNight) -> None:
        for row in night.rows:
            if row.number in self._marks and row.mark is not None:
                self._marks[row.number].set_content(shadow_report.RIGHT if row.mark.right else shadow_report.WRONG)
        self._figures.set_content(f'<p class="quiet">{escape(shadow_report.marks_in_words(night))}</p>')


def read(folder: Path) -> shadow_report.ShadowNight:
    """Return the table of a run; empty for a run that commands."""
    with open_run(folder) as run:
        return shadow_report.read(run)
