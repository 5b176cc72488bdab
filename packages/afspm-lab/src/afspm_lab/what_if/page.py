"""The result of `afspm what-if` as one HTML page, without scripts and external files."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC
from html import escape
from pathlib import Path

from afspm.basics import FileError, counted, day_and_time
from afspm.components import replace_file
from afspm.report import document, section, table
from afspm_lab.what_if.alignment import Difference
from afspm_lab.what_if.side_by_side import changed_fields, message_name, sides, where
from afspm_lab.what_if.what_if import Row, WhatIf

MOST_SHOWN = 100
"""The largest number of differences of a night on the page."""
_CSS = """
article{margin-top:3rem}article>h2{font-size:1.4rem}article:only-of-type>h2{display:none}
.differs{color:var(--problem)}td pre{margin:0;font:inherit;white-space:pre-wrap;overflow-wrap:anywhere;min-width:9rem}
"""


class DifferencePage:
    """The page of one night, or of several with the same change.

    Nights are drawn one by one: their outputs together may fill the memory.

    Args:
        changes: as for `what_if`.
    """

    def __init__(self, changes: Mapping[str, Mapping[str, object]] | Path | None) -> None:
        self._changes = changes
        self._names: list[str] = []
        self._nights: list[str] = []
        self._overview: list[list[str]] = []
        self._different = 0
        self._simulated = False

    def add(self, result: WhatIf) -> None:
        number, name, first = len(self._nights) + 1, escape(result.run.name), result.first
        self._names.append(result.run.name)
        self._nights.append(
            f'<article id="night-{number}"><h2>{name}: {_verdict(result)}</h2>{_night(result)}</article>'
        )
        at = escape(f"{first.component}, {where(first)}") if first else ""
        self._overview.append([f'<a href="#night-{number}">{name}</a>', _verdict(result), at])
        self._different += result.differs
        self._simulated |= result.simulated

    def add_unread(self, name: str, why: str) -> None:
        """Add a night that could not be replayed."""
        number, verdict = len(self._nights) + 1, "not replayed"
        self._names.append(name)
        self._nights.append(
            f'<article id="night-{number}"><h2>{escape(name)}: {verdict}</h2><p>{escape(why)}</p></article>'
        )
        self._overview.append([f'<a href="#night-{number}">{escape(name)}</a>', verdict, ""])

    def write(self, target: Path) -> None:
        """Write the page.

        Raises:
            FileError: the page can't be written.
        """
        try:
            replace_file(target, [self.html().encode()], synced=False)
        except OSError as error:
            raise FileError(f"can't be written: {error.strerror or error}", where=str(target)) from error

    def html(self) -> str:
        one = len(self._names) == 1
        title = escape(f"What if: {self._names[0] if one else counted(len(self._names), 'night')}")
        badge = '<span class="badge">SIMULATED</span>' if self._simulated else ""
        verdict = self._overview[0][1] if one else f"{self._different} of {len(self._names)} differ"
        overview = "" if one else section("Nights", table(["night", "", "first difference"], self._overview))
        head = f"<header><h1>{title}{badge}</h1><p class='lead'>{verdict}</p></header>"
        return document(title, head + section("Change", self._change()) + overview + "".join(self._nights), _CSS)

    def _change(self) -> str:
        if self._changes is None:
            return "<p>None: the installed version of the components is compared with the recorded one.</p>"
        if isinstance(self._changes, Path):
            text = escape(self._changes.read_text(encoding="utf-8"))
            return f"<p>The experiment file {_code(str(self._changes))}, laid over the run's:</p><pre>{text}</pre>"
        rows = [
            [_code(f"{name}.{key}"), escape(str(value))]
            for name, settings in self._changes.items()
            for key, value in settings.items()
        ]
        return table(["setting", "now"], rows)


def _night(result: WhatIf) -> str:
    shown = result.differences[:MOST_SHOWN]
    more = len(result.differences) - len(shown)
    left_out = f'<p class="note">And {counted(more, "more difference")}; --json prints all.</p>' if more else ""
    rows = [[escape(cell) for cell in _cells(row)] for row in result.table()]
    heads = ("process", "same", "added", "removed", "changed", "counterfactual", "")
    return (
        section("First difference", _first(result.first))
        + section("Outputs of each process", _counterfactual(result) + table(heads, rows))
        + section("Differences", table(_HEADS, [_difference(one) for one in shown]) + left_out)
        + section("Notes", _notes(result))
    )


_HEADS = ("time", "process", "packet", "difference", "recorded", "now")


def _verdict(result: WhatIf) -> str:
    return '<b class="differs">differs</b>' if result.differs else "no difference"


def _first(first: Difference | None) -> str:
    if first is None:
        return ""
    rows = [[escape(text) for text in field] for field in changed_fields(first)]
    recorded, now = map(escape, sides(first))
    shown = table(["field", "recorded", "now"], rows) or table(["recorded", "now"], [[recorded, now]])
    about = f"{where(first)}, {first.kind}{f': {message_name(first)}' if rows else ''}"
    return f'<p class="lead"><b>{escape(first.component)}</b>, {escape(about)}</p>{shown}'


def _counterfactual(result: WhatIf) -> str:
    since_ns = result.counterfactual_from_ns
    if since_ns is None:
        return ""
    return (
        f'<p class="note">A difference reaches the microscope at {day_and_time(since_ns, UTC)}. Later inputs are '
        "counterfactual: the night would have been another one. Differences of components that act are not counted "
        "from there on.</p>"
    )


def _cells(row: Row) -> list[str]:
    return [row.name, *map(str, (row.same, row.added, row.removed, row.changed, row.counterfactual)), row.note]


def _difference(one: Difference) -> list[str]:
    packet = _code(one.packet.envelope) if one.packet else "none yet"
    kind = f"{one.kind}{'<small>counterfactual</small>' if one.counterfactual else ''}"
    texts = sides(one)
    if fields := changed_fields(one):
        recorded = [f"{field}: {before}" for field, before, _ in fields]
        now = [f"{field}: {after}" for field, _, after in fields]
        name = message_name(one)
        texts = ("\n".join([name, *recorded]), "\n".join([name, *now]))
    return [
        day_and_time(one.at_ns, UTC), escape(one.component), packet, kind,
        *(f"<pre>{escape(text)}</pre>" for text in texts),
    ]  # fmt: skip


def _notes(result: WhatIf) -> str:
    notes = [
        f"{name} depends on more than its inputs: it {hazard}"
        for name, hazards in result.hazards.items()
        for hazard in hazards
    ]
    notes += [f"{name} was not replayed: {why}" for name, why in {**result.unread, **result.left_out}.items()]
    notes += [f"[{name}] {why}" for name, why in result.untried.items()]
    return "".join(f"<p>{escape(note)}</p>" for note in notes)


def _code(text: str) -> str:
    return f"<code>{escape(text)}</code>"
