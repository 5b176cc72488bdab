"""The log, filtered as one viewer wants it."""

from __future__ import annotations

from collections.abc import Sequence

from nicegui import ui

from afspm.dashboard.content import LEVELS, log_html
from afspm.model import LogLine

_EVERYTHING = "all"


class LogPanel:
    """Newest lines first."""

    def __init__(self) -> None:
        self._shown: tuple[object, ...] = ()
        self._lines: Sequence[LogLine] = ()
        with ui.element("div").classes("tools"):
            self._name = ui.select([_EVERYTHING], value=_EVERYTHING, label="component", on_change=self._draw)
            self._level = ui.select(list(LEVELS), value="INFO", label="at least", on_change=self._draw)
            self._text = ui.input("contains", on_change=self._draw)
        for element in (self._name, self._level, self._text):
            element.props("dense outlined").classes("field")
        self._html = ui.html("", sanitize=False).classes("scrolled").props('tabindex="0" role="log" aria-live="off"')

    def show(self, lines: Sequence[LogLine], names: Sequence[str]) -> None:
        """Bring it up to date."""
        every = [_EVERYTHING, *sorted({*names, *(line.name for line in lines)})]
        if every != self._name.options:
            self._name.set_options(every, value=self._name.value)
        self._lines = lines
        self._draw()

    def _draw(self) -> None:
        newest = self._lines[-1] if self._lines else None
        wanted = (newest, len(self._lines), self._name.value, self._level.value, self._text.value)
        if wanted == self._shown:
            return
        self._shown = wanted
        names = frozenset() if self._name.value == _EVERYTHING else frozenset({str(self._name.value)})
        self._html.set_content(log_html(self._lines, names, str(self._level.value), str(self._text.value or "")))
