"""All commands. Each module imports what it works with inside its function, so that any command starts fast."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from afspm import entry_points
from afspm.cli import (
    clients,
    commission,
    dashboard,
    demo,
    doctor,
    drift,
    drivers,
    experiment_file,
    new,
    notify,
    recorded,
    run,
    runs,
    status,
    steer,
    trace,
)
from afspm.errors import ConfigError

app = typer.Typer(
    name="afspm",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",  # paragraphs are filled; [security] is text
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


BEFORE, MEANWHILE, AFTERWARDS = "Before", "While it runs", "Afterwards"
MICROSCOPES, PLUGINS = "Microscopes", "Plug-ins"

app.command("demo")(demo.demo)
app.command("run")(run.run)
app.add_typer(new.app, name="new", rich_help_panel=BEFORE)
app.command("check", rich_help_panel=BEFORE)(experiment_file.check)
app.command("doctor", rich_help_panel=BEFORE)(doctor.doctor)
app.command("graph", rich_help_panel=BEFORE)(experiment_file.graph)
app.command("keys", rich_help_panel=BEFORE)(experiment_file.keys)
app.command("notify", rich_help_panel=BEFORE)(notify.notify)
app.command("dashboard", rich_help_panel=MEANWHILE)(dashboard.dashboard)
app.command("status", rich_help_panel=MEANWHILE)(status.status)
app.command("watch", rich_help_panel=MEANWHILE)(status.watch)
app.command("pause", rich_help_panel=MEANWHILE)(steer.pause)
app.command("resume", rich_help_panel=MEANWHILE)(steer.resume)
app.command("end", rich_help_panel=MEANWHILE)(steer.end)
app.command("restart", rich_help_panel=MEANWHILE)(steer.restart)
app.command("problems", rich_help_panel=MEANWHILE)(steer.problems)
app.command("note", rich_help_panel=MEANWHILE)(steer.note)
app.command("runs", rich_help_panel=AFTERWARDS)(runs.runs)
app.command("report", rich_help_panel=AFTERWARDS)(recorded.report)
app.command("export", rich_help_panel=AFTERWARDS)(recorded.export)
app.command("replay", rich_help_panel=AFTERWARDS)(recorded.replay)
app.add_typer(drift.app, name="drift", rich_help_panel=AFTERWARDS)
app.command("test-client", rich_help_panel=MICROSCOPES)(clients.check_client)
app.command("test-translator", rich_help_panel=MICROSCOPES)(drivers.check_translator)
app.command("commission", rich_help_panel=MICROSCOPES)(commission.commission)
app.command("trace", rich_help_panel=MICROSCOPES)(trace.trace)
app.command("emulate", rich_help_panel=MICROSCOPES)(drivers.emulate)


def _add_plugins() -> None:
    """Add the commands of installed packages: one that can't be loaded says so when it is called."""
    for name in entry_points.names(entry_points.COMMANDS):
        try:
            command = entry_points.load(entry_points.COMMANDS, name)
        except ConfigError as error:
            command = _unloadable(error)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=PLUGINS)
        else:
            app.command(name, rich_help_panel=PLUGINS)(command)


def _unloadable(error: ConfigError) -> Callable[[], None]:
    def command() -> None:
        """Not available: its package can't be loaded."""
        raise error

    return command


_add_plugins()
