"""`afspm report`: what happened in a run, on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    where: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|FILE",
            help="The folder of a run, a folder of runs (its newest is meant), or the experiment file.",
        ),
    ] = Path("runs"),
) -> None:
    """Write report.html, and figures, into the folder of a run, from its record.

    Of a run that goes on, too: it shows what has happened so far. The page needs no other file.
    """
    from afspm.client.connect import find_run
    from afspm.record.report import write

    typer.echo(write(find_run(where)))
