"""The dialog in which a person gives an agent a grant: limits of place, values, counts and time.

The dialog has the fields of a file for `afspm approve --grant`, and the same function reads them. The scheduler
decides; the dialog shows a refusal, and stays open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from nicegui import ui

from afspm.basics import AfspmError, InvalidValue, Plain, quantity
from afspm.model import Region, names
from afspm.plugins.web.dashboard.actions import ActionResult, Actions
from afspm.plugins.web.dashboard.steering_session import SteeringSession
from afspm_agents.page.approvals import grant_of

MEASURED = {names.START_SCAN: 10, names.START_SPEC: 0}
"""The first offered actions, with their initial numbers."""
LASTS = "1 h"
Pair = tuple[str, str]


@dataclass(frozen=True)
class GrantFields:
    """The fields of the dialog, as a person writes them. A region or range with empty fields only is left out."""

    agent: str
    lasts: str
    x: Pair = ("", "")
    y: Pair = ("", "")
    ranges: Sequence[tuple[str, str, str]] = ()
    counts: Mapping[str, str] = field(default_factory=dict)

    def table(self) -> dict[str, object]:
        """Return the grant as the table of a TOML file for `afspm approve --grant`.

        Raises:
            InvalidValue: no action is granted, a count is not a whole number, a parameter has no name or occurs twice,
                or a pair is incomplete.
        """
        found: dict[str, object] = {"agent": self.agent.strip(), "for": self.lasts.strip()}
        if any(text.strip() for text in (*self.x, *self.y)):
            found["region"] = {"x": _both(self.x, "x"), "y": _both(self.y, "y")}
        parameters: dict[str, list[str]] = {}
        for name, low, high in self.ranges:
            if not any(text.strip() for text in (name, low, high)):
                continue
            if not name.strip() or name.strip() in parameters:
                raise InvalidValue(f"a parameter {'has no name' if not name.strip() else f'is named twice: {name}'}")
            parameters[name.strip()] = _both((low, high), name)
        counts: dict[str, int] = {}
        for action, text in self.counts.items():
            if not text.strip().isascii() or not text.strip().isdigit():
                raise InvalidValue(f"{action}: {text.strip() or 'nothing'} is not a whole number")
            if count := int(text):
                counts[action] = count
        if not counts:
            raise InvalidValue("a grant without any action", hint="say how many scans or spectra the agent may take")
        return {**found, **({"parameters": parameters} if parameters else {}), "counts": counts}


class GrantDialog:
    """The dialog of one viewer; the dialog closes once the scheduler has accepted the grant, or at Cancel.

    Args:
        agents: suggested names; the first is filled in.
        region: the initial place; None: empty fields. A grant without a region allows no place.
    """

    def __init__(self, session: SteeringSession, agents: Sequence[str], region: Region | None) -> None:
        self._session = session
        self._agents = agents
        self._region = region
        self._facts: Plain = {}
        self._ranges: list[tuple[ui.input, ui.input, ui.input]] = []

    async def show(self) -> None:
        # as on the command line, the facts are from before the person decides: what happens meanwhile makes it stale
        result = await self._session.carry_out(self._look)
        if not result.ok:
            self._session.say(result)
            return
        with ui.dialog() as self._dialog, ui.card().classes("question grant").props('role="dialog"'):
            ui.html("<h3>Give an agent a grant</h3>", sanitize=False)
            ui.label("Within this box it measures by itself. All that is not named here is refused.").classes("quiet")
            self._fields()
            self._refusal = ui.label().classes("wrong").props('role="alert"')
            with ui.element("div").classes("acts"):
                ui.button("Cancel", on_click=lambda: self._dialog.submit(None), color=None).props("no-caps flat")
                ui.button("Give the grant", on_click=self._give).props("no-caps unelevated")
        await self._dialog
        if not self._dialog.is_deleted:  # a closed browser has already deleted it
            self._dialog.clear()
            self._dialog.delete()

    def _fields(self) -> None:
        first = self._agents[0] if self._agents else ""
        with ui.element("div").classes("fields"):
            self._agent = _field("agent", first, self._agents)
            self._lasts = _field("for", LASTS)
        ui.label("Place").classes("quiet")
        edges = ["", "", "", ""]
        if self._region is not None:
            (x, y), (width, height) = self._region.center_m, self._region.size_m
            edges = [quantity(m, "m", 6) for m in (x - width / 2, x + width / 2, y - height / 2, y + height / 2)]
        with ui.element("div").classes("fields"):
            labels = ("x from", "x to", "y from", "y to")
            self._edges = [_field(label, text) for label, text in zip(labels, edges, strict=True)]
        ui.label("Parameters that it may set").classes("quiet")
        self._box = ui.element("div")
        self._add_range()
        ui.button("Another parameter", on_click=self._add_range, color=None).props("no-caps flat dense")
        ui.label("How often").classes("quiet")
        with ui.element("div").classes("fields"):
            self._counts = {name: _field(name, str(count)) for name, count in MEASURED.items()}
        ui.label("Treatments of the tip: 0 unless you trust it with the tip").classes("quiet")
        with ui.element("div").classes("fields"):
            self._counts |= {name: _field(name, "0") for name in names.TREATMENTS}

    def _add_range(self) -> None:
        number = len(self._ranges) + 1
        with self._box, ui.element("div").classes("fields range"):
            name = _field(f"parameter {number}", "", list(names.BASE_PARAMETERS))
            self._ranges.append((name, _field(f"lowest {number}", ""), _field(f"highest {number}", "")))

    def _read(self) -> dict[str, object]:
        left, right, low, high = map(_text, self._edges)
        ranges = [(_text(name), _text(least), _text(most)) for name, least, most in self._ranges]
        counts = {name: _text(one) for name, one in self._counts.items()}
        return GrantFields(_text(self._agent), _text(self._lasts), (left, right), (low, high), ranges, counts).table()

    async def _give(self) -> None:
        try:
            table = self._read()
            grant_of(table, self._facts)  # an invalid grant is shown here, before a request is sent
        except AfspmError as error:
            self._refusal.set_text(str(error))
            return
        result = await self._session.carry_out(lambda actions: actions.approve(grant_of(table, self._facts)))
        if self._dialog.is_deleted:
            return
        if result.ok:
            self._dialog.submit("given")
            self._session.say(result)
            return
        self._refusal.set_text(result.text)
        # the person has now read why: the next attempt is judged by what holds from here on
        await self._session.carry_out(self._look)

    def _look(self, actions: Actions) -> ActionResult:
        self._facts = actions.approval_facts()
        return ActionResult("")


def _field(label: str, value: str, suggested: Sequence[str] = ()) -> ui.input:
    return ui.input(label, value=value, autocomplete=list(suggested) or None).props("dense outlined")


def _text(one: ui.input) -> str:
    return str(one.value or "")


def _both(pair: Pair, name: str) -> list[str]:
    if not all(text.strip() for text in pair):
        raise InvalidValue(f"{name}: a lowest and a highest value are needed")
    return [text.strip() for text in pair]
