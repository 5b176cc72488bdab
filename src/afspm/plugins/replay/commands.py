"""`afspm replay`: publish a recorded run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.basics import counted
from afspm.cli import AFTERWARDS, RUNS, RecordedRun, names_in, opt

app = typer.Typer(rich_markup_mode=None, rich_help_panel=AFTERWARDS)


@app.command()
def replay(
    run: RecordedRun = RUNS,
    speed: Annotated[
        float | None, opt("Experiment seconds in a real second. Default: as it was recorded.", min=1e-6)
    ] = None,
    only: Annotated[
        list[str] | None, opt("Publish only these, e.g. Scan2d,ControlState.", "--only", metavar="MESSAGE[,…]")
    ] = None,
    publish: Annotated[
        str | None,
        opt("Where. Default: the address in the experiment file if local, else a free port.", metavar="ADDRESS"),
    ] = None,
    serve: Annotated[str | None, opt("Where requests are answered.", metavar="ADDRESS")] = None,
    stay: Annotated[
        bool, typer.Option("--stay", help="Serve late joiners when all is published, until Ctrl-C.")
    ] = False,
    runs: Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where to make the replay's folder.")] = RUNS,
) -> None:
    """Publish a recorded run again, with its timing at any speed, as its scheduler did.

    The replay can be joined like a running experiment: afspm.connect, afspm dashboard, afspm run FILE --only COMPONENT.
    Late joiners get the cached packets. Requests are refused, since nothing is measured.
    """
    from afspm.plugins.replay import replay as replaying

    options = replaying.ReplayOptions(speed, names_in(only), publish, serve, stay=stay, runs=runs)
    count = replaying.replay(run, options, typer.echo)
    typer.echo(f"published {counted(count, 'packet')}")
