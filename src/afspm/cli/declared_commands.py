"""Groups of commands to which packages add their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

from afspm.basics import entry_points, packages
from afspm.basics.errors import ConfigError
from afspm.cli.arguments import PLUGINS, HelpWhenBare

if TYPE_CHECKING:
    from typer._click.core import Command

# options that typer adds to each app; only those of `afspm` itself install something
_COMPLETION = ("install_completion", "show_completion")


class DeclaredCommands(HelpWhenBare):
    """Group of commands of afspm and of other packages.

    A package's command is loaded for the help, and when called. A command of a package of this repository that is not
    installed is refused with the package's name.

    Attributes:
        group: entry points of the packages' commands.
        prefix: words between `afspm` and the name of a command, with a space at the end.
    """

    group: ClassVar[str] = entry_points.COMMANDS
    prefix: ClassVar[str] = ""

    def list_commands(self, ctx: object) -> list[str]:
        declared = entry_points.names(self.group)
        return [*self.commands, *(name for name in declared if name not in self.commands)]

    def get_command(self, ctx: object, cmd_name: str) -> Command | None:
        return self.commands.get(cmd_name) or _declared(self.group, cmd_name)

    def is_name(self, ctx: object, word: str) -> bool:
        """Return whether a word is the name of a command, installed or not."""
        return word in self.list_commands(ctx) or self.prefix + word in packages.BROUGHT_BY

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = self.prefix + args[0]
        if not ctx.resilient_parsing and name in packages.BROUGHT_BY and self.get_command(ctx, args[0]) is None:
            raise ConfigError(f"the command afspm {name} is not installed", hint=packages.advice(name))
        return super().resolve_command(ctx, args)


def _declared(group: str, name: str) -> Command | None:
    try:
        found = entry_points.load(group, name)
        if found is None:
            return None
        command = _command(name, found)
    except ConfigError as error:  # raised when the command is called: the help must list all others
        command = _command(name, _unloadable(error))
    except Exception as error:  # typer raises many kinds where a package's function can't be a command
        what = f"the command {name} of a package can't be used: {type(error).__name__}: {error}"
        command = _command(name, _unloadable(ConfigError(what, where=group)))
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
