"""A command: `afspm example-hello`."""

from __future__ import annotations

import typer


def hello(name: str = "everybody") -> None:
    """Print a greeting."""
    typer.echo(f"hello {name}")
