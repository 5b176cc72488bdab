"""A command: `afspm example-hello`."""

from __future__ import annotations

import typer


def hello(name: str = "everybody") -> None:
    """Greet somebody."""
    typer.echo(f"hello {name}")
