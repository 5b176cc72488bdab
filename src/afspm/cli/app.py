"""The program `afspm` with all commands. Command modules import late, inside functions, so that commands start fast."""

from __future__ import annotations

from typing import Annotated

import typer

from afspm.cli import (
    commission,
    developing,
    experiment_file,
    run,
    runs,
    shadow,
    status,
    steer,
)
from afspm.cli.arguments import AFTERWARDS, BEFORE, MEANWHILE, MICROSCOPES
from afspm.cli.declared_commands import DeclaredCommands

app = typer.Typer(
    name="afspm",
    cls=DeclaredCommands,
    rich_markup_mode=None,  # Rich takes as long to import as all else that the help needs
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    from importlib.metadata import version

    if asked:
        typer.echo(f"afspm {version('afspm')}")
        raise typer.Exit


@app.callback()
def _afspm(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Automate scanning probe microscopes: run experiments of several components that share one microscope."""


app.command("demo")(run.demo)
app.command("run")(run.run)
app.add_typer(developing.new_app, name="new", rich_help_panel=BEFORE)
app.command("check", rich_help_panel=BEFORE)(experiment_file.check)
app.command("doctor", rich_help_panel=BEFORE)(experiment_file.doctor)
app.command("graph", rich_help_panel=BEFORE)(experiment_file.graph)
app.command("keys", rich_help_panel=BEFORE)(experiment_file.keys)
app.command("notify", rich_help_panel=BEFORE)(experiment_file.notify)
app.command("status", rich_help_panel=MEANWHILE)(status.status)
app.command("watch", rich_help_panel=MEANWHILE)(status.watch)
app.command("pause", rich_help_panel=MEANWHILE)(steer.pause)
app.command("continue", rich_help_panel=MEANWHILE)(steer.go_on)
app.command("resume", hidden=True)(steer.go_on)  # its former name
app.command("end", rich_help_panel=MEANWHILE)(steer.end)
app.command("restart", rich_help_panel=MEANWHILE)(steer.restart)
app.command("problems", rich_help_panel=MEANWHILE)(steer.problems)
app.command("note", rich_help_panel=MEANWHILE)(steer.note)
app.command("runs", rich_help_panel=AFTERWARDS)(runs.runs)
app.command("probes", rich_help_panel=AFTERWARDS)(runs.probes)
app.command("report", rich_help_panel=AFTERWARDS)(runs.report)
app.command("export", rich_help_panel=AFTERWARDS)(runs.export)
app.command("test-client", rich_help_panel=MICROSCOPES)(developing.check_client)
app.command("test-translator", rich_help_panel=MICROSCOPES)(developing.check_translator)
app.command("commission", rich_help_panel=MICROSCOPES)(commission.commission)
app.add_typer(shadow.app, name="shadow", rich_help_panel=MICROSCOPES)
app.command("trace", rich_help_panel=MICROSCOPES)(run.trace)
app.command("emulate", rich_help_panel=MICROSCOPES)(developing.emulate)
