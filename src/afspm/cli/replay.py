"""`afspm replay`: a recorded run once more, to develop a component or the dashboard on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.cli.arguments import names_in


def replay(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="The folder of a run, or of all runs: its newest is meant.")
    ] = Path("runs"),
    speed: Annotated[
        float | None,
        typer.Option(
            min=1e-6, help="Experiment seconds in a real second. Default: as it was recorded.", show_default=False
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", metavar="MESSAGE[,…]", help="Publish only these, e.g. Scan2d,ControlState.", show_default=False
        ),
    ] = None,
    publish: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Where. Default: as the experiment file says, else a free port.", show_default=False
        ),
    ] = None,
    serve: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Where requests are answered.", show_default=False)
    ] = None,
    stay: Annotated[
        bool, typer.Option("--stay", help="Stay when all is published, for who joins late; Ctrl-C ends it.")
    ] = False,
    runs: Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where to make the replay's folder.")] = Path(
        "runs"
    ),
) -> None:
    """Publish a recorded run again, with its timing at any speed, as its scheduler did.

    It can be joined like a running experiment: afspm.connect, afspm dashboard, afspm run FILE --only COMPONENT. Who
    comes late gets what was kept. Requests are refused: nobody measures.
    """
    from afspm.supervisor import replay

    options = replay.ReplayOptions(speed, names_in(only), publish, serve, stay=stay, runs=runs)
    count = replay.replay(run, options, typer.echo)
    typer.echo(f"{count} packets were published")
