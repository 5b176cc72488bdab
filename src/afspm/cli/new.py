"""`afspm new`: something to begin with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", help="Make something to begin with.")


@app.callback()
def _new() -> None:
    """Make something to begin with."""


@app.command("driver")
def driver(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the package, e.g. my_scope.")],
    into: Annotated[Path, typer.Option("--into", metavar="DIR", help="Where to make its folder.")] = Path(),
) -> None:
    """Make a package with a driver for a new controller.

    As it is, it drives a controller that only pretends, and passes the checks of what it has.
    """
    from afspm.testing.skeletons import write_driver

    folder = write_driver(name, into)
    typer.echo(f"{folder}: replace its PretendController, and look how far it is with")
    typer.echo(f"    cd {folder} && afspm test-translator experiment.toml")
