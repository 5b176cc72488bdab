"""The program `afspm` with all commands. Command modules import late, inside functions, so that commands start fast."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperCommand, TyperGroup

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError
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
from afspm.cli.arguments import AFTERWARDS, BEFORE, MEANWHILE, MICROSCOPES, PLUGINS, HelpWhenBare

if TYPE_CHECKING:
    from typer._click.core import Command

# options that typer adds to each app; only those of `afspm` itself install something
_COMPLETION = ("install_completion", "show_completion")


class DeclaredCommands(HelpWhenBare):
    """Commands of afspm and of other packages; a package's command is loaded for the help, and when called."""

    def list_commands(self, ctx: object) -> list[str]:
        declared = entry_points.names(entry_points.COMMANDS)
        return [*self.commands, *(name for name in declared if name not in self.commands)]

    def get_command(self, ctx: object, cmd_name: str) -> Command | None:
        return self.commands.get(cmd_name) or _declared(cmd_name)


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


def _declared(name: str) -> Command | None:
    try:
        found = entry_points.load(entry_points.COMMANDS, name)
        if found is None:
            return None
        command = _command(name, found)
    except ConfigError as error:  # raised when the command is called: the help must list all others
        command = _command(name, _unloadable(error))
    except Exception as error:  # typer raises many kinds where a package's function can't be a command
        what = f"the command {name} of a package can't be used: {type(error).__name__}: {error}"
        command = _command(name, _unloadable(ConfigError(what, where=entry_points.COMMANDS)))
    return command


def _command(name: str, found: typer.Typer | Callable[..., object]) -> Command:
    if not isinstance(found, typer.Typer):
        function, found = found, typer.Typer(rich_markup_mode=None)
        found.command()(function)
    command = typer.main.get_command(found)
    command.name = name
    command.params = [one for one in command.params if one.name not in _COMPLETION]
    if isinstance(command, TyperCommand | TyperGroup):  # typer sets the panel only in add_typer
        command.rich_help_panel = found.rich_help_panel if isinstance(found.rich_help_panel, str) else PLUGINS
    return command


def _unloadable(error: ConfigError) -> Callable[[], None]:
    def command() -> None:
        """Not available: its package can't be loaded."""
        raise error

    return command
