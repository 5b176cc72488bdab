"""`afspm acme`: the maker's own commands."""

from __future__ import annotations

from pathlib import Path

import typer

app = typer.Typer(help="Files of Acme.", no_args_is_help=True)


@app.command()
def channels(file: Path) -> None:
    """List the channels of a file."""
    from afspm import read

    typer.echo(", ".join(scan.channel for scan in read(file).scans))


@app.command()
def version() -> None:
    """Show the version of the protocol."""
    typer.echo("Acme 2")
