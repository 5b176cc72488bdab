"""`afspm new`: make an experiment, a component or a driver to start from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Name = Annotated[str, typer.Argument(metavar="NAME", help="Of it and of its folder, e.g. my_idea.")]
Into = Annotated[Path, typer.Option("--into", metavar="DIR", help="Where to make its folder.")]

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="Make an experiment, component or driver to begin with."
)


@app.command("experiment")
def experiment(name: Name, into: Into = Path()) -> None:
    """Make a folder with an experiment file: a few scans on the simulated microscope."""
    _write("experiment", name, into, "then change it; try it with", "afspm run experiment.toml")


@app.command("component")
def component(name: Name, into: Into = Path()) -> None:
    """Make a folder with a component of your own, and an experiment that runs it on the simulated microscope."""
    _write("component", name, into, "then change what it does; try it with", "afspm run experiment.toml")


@app.command("driver")
def driver(name: Name, into: Into = Path()) -> None:
    """Make a package with a driver for a new controller.

    As it is, it drives a controller that only pretends, and passes the checks of the operations that it has.
    """
    what = "replace its PretendController, and look how far it is with"
    _write("driver", name, into, what, "afspm test-translator experiment.toml")


def _write(kind: str, name: str, into: Path, what: str, command: str) -> None:
    from afspm.testing.skeletons import write

    folder = write(kind, name, into)
    typer.echo(f"{folder}: {what}")
    typer.echo(f"    cd {folder} && {command}")
