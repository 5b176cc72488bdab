"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

_FILES = "The experiment file; each further file overrides those before it, and needs to hold only what differs."
_WHERE = "The folder of a run, a folder of runs (its newest is meant), or the experiment file."
RUNS = Path("runs")
BEFORE, MEANWHILE, AFTERWARDS = "Before", "While it runs", "Afterwards"
MICROSCOPES, PLUGINS = "Microscopes", "Plug-ins"
"""Panels of `afspm --help`."""

Files = Annotated[list[Path], typer.Argument(metavar="FILE [OVERLAY…]", help=_FILES, show_default=False)]
OptionalFiles = Annotated[list[Path] | None, typer.Argument(metavar="FILE [OVERLAY…]", help=_FILES, show_default=False)]
Where = Annotated[Path, typer.Argument(metavar="RUN|FILE", help=_WHERE)]
RecordedRun = Annotated[
    Path, typer.Argument(metavar="RUN", help="The folder of a run, or of all runs: its newest is meant.")
]
Runs = Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where to make the run's folder.")]


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
NoProgress = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
"""For commands whose printed text is the result."""


class HelpWhenBare(TyperGroup):
    """Command group that shows its help if nothing is asked of it, and ends with 0 as with --help.

    The help lists the commands by their panels, each with its whole first paragraph.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, args or [ctx.help_option_names[0]])

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        found = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        shown = [(name, command) for name, command in found if command is not None and not command.hidden]
        width = max(len(name) for name, _ in shown)
        panels: dict[str, list[tuple[str, str]]] = {}
        for name, command in shown:
            panel = getattr(command, "rich_help_panel", None)  # typer's DefaultPlaceholder if none was given
            rows = panels.setdefault(panel if isinstance(panel, str) else "Commands", [])
            rows.append((f"{name:{width}}", (command.help or "").partition("\n\n")[0]))
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows)


def opt(help_text: str, *flags: str, **more: Any) -> object:
    """Return a command-line option; the help does not show the default, so `help_text` may state it."""
    return typer.Option(*flags, help=help_text, show_default=False, **more)


_SPEED = "Experiment seconds in a real second; simulated microscopes only."
Speed = Annotated[float | None, opt(_SPEED, min=1e-6)]
CheckSpeed = Annotated[float, typer.Option(min=1e-6, help=_SPEED)]
"""For commands that check a microscope; their default speed differs from a run's."""
WithinFrame = Annotated[
    str,
    opt(
        'Stay within a square of this side about the centre of the frame that is set, e.g. "500 nm". '
        "Default: within the frame that is set.",
        metavar="SIZE",
    ),
]
SuiteReportFile = Annotated[
    Path | None, opt("Write the report here, too; as JUnit's XML if FILE ends with .xml.", "--report", metavar="FILE")
]


def names_in(given: list[str] | None) -> tuple[str, ...]:
    """Return the names given to an option, which may be repeated, or have several names separated by commas."""
    return tuple(name.strip() for names in given or () for name in names.split(",") if name.strip())
