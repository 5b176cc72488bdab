"""`afspm graph`: an experiment as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.cli.arguments import Files


def graph(
    files: Files,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="The SVG file to write. Default: named as the experiment.", show_default=False
        ),
    ] = None,
) -> None:
    """Draw the components, sockets and envelopes of an experiment as SVG."""
    from afspm.errors import FileError
    from afspm.experiment import load
    from afspm.experiment.graph import draw

    experiment = load(*files)
    experiment.require_valid()
    target = output or Path(f"{experiment.name}.svg")
    try:
        target.write_text(draw(experiment), encoding="utf-8")
    except OSError as error:
        raise FileError(f"the picture can't be written: {error.strerror or error}", where=str(target)) from error
    typer.echo(target)
