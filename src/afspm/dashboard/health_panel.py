"""How it is with each process, and a button to start it anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from nicegui import ui

from afspm.dashboard.content import process_words
from afspm.dashboard.steering_panel import SteeringPanel
from afspm.dashboard.time_line import NOT_HEARD_OF
from afspm.model import ProcessCondition, ProcessState

_BAD = {ProcessCondition.SILENT, ProcessCondition.RESTARTING, ProcessCondition.GIVEN_UP}


class HealthPanel:
    """A row for each process, which stays while its words change: a button must not move under the finger."""

    def __init__(self, steering: SteeringPanel) -> None:
        self._steering = steering
        self._rows: dict[str, _Row] = {}
        self._nothing = ui.html("Nothing has been heard of processes yet.", sanitize=False).classes("nothing")
        self._list = ui.element("div").classes("processes").props('role="table" aria-label="Processes"')

    def show(self, processes: Sequence[ProcessState], unheard: Mapping[str, int]) -> None:
        """Bring the rows up to date; `unheard` as in `Content`."""
        self._nothing.set_visibility(not processes)
        for state in processes:
            row = self._rows.get(state.name)
            if row is None:
                with self._list:
                    row = self._rows[state.name] = _Row(state.name, self._steering)
            row.show(state, unheard.get(state.name))


class _Row:
    def __init__(self, name: str, steering: SteeringPanel) -> None:
        with ui.element("div").classes("process").props('role="row"'):
            self._dot = ui.element("span").classes("dot")
            ui.label(name).classes("name").props('role="rowheader"')
            self._condition = ui.label().props('role="cell"')
            self._since = ui.label().classes("quiet").props('role="cell"')
            self._restarts = ui.label().classes("quiet").props('role="cell"')
            self._button = ui.button("Restart", on_click=lambda: steering.ask_restart(name))
            self._button.props("flat dense no-caps")
            self._button.props["aria-label"] = f"Restart {name}"  # as text of properties a name could set others
        self._steering = steering
        self._style = ""

    def show(self, state: ProcessState, unheard_ns: int | None) -> None:
        condition, since, restarts = process_words(state, unheard_ns)
        self._condition.set_text(condition)
        self._since.set_text(since)
        self._restarts.set_text(restarts)
        style = "bad" if state.condition in _BAD or condition == NOT_HEARD_OF else condition.replace(" ", "-")
        if style != self._style:
            self._dot.classes(remove=f"is-{self._style}", add=f"is-{style}")
            self._style = style
        self._button.set_visibility(self._steering.may_steer)
