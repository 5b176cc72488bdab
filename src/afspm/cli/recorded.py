"""`afspm report`, `export` and `replay`: what is done with a recorded run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.basics.formatting import counted
from afspm.cli.arguments import RUNS, RecordedRun, Where, names_in, opt


def report(where: Where = RUNS) -> None:
    """Write report.html, and figures, into the folder of a run, from its record.

    Of a run that goes on, too: it shows what has happened so far. The page needs no other file.
    """
    from afspm.client.connect import find_run
    from afspm.record.report import write

    typer.echo(write(find_run(where)))


def export(
    run: RecordedRun = RUNS,
    to: Annotated[
        str,
        typer.Option(
            metavar="FORMAT",
            help="gwy, h5 (NeXus), nc, png, csv, eln, gif and mp4 (films), documents (Bluesky), or another that "
            "`afspm doctor` lists.",
        ),
    ] = "gwy",
    out: Annotated[Path | None, opt("Where to write. Default: export in the folder of the run.", metavar="DIR")] = None,
    scans: Annotated[str | None, opt("Only these scans, by their numbers; 7-: from 7 on.", metavar="1-5,8")] = None,
) -> None:
    """Write the scans and spectra of a recorded run in the format of others.

    Also of a run that goes on, or was killed. Interrupted scans come, too, as far as they were seen.
    """
    from afspm.record.export import export as exported
    from afspm.record.run import open_run

    with open_run(run) as record:
        folder = out or record.folder / "export" / to
        written = list(exported(record, to, folder, scans, lambda text: typer.echo(f"left out: {text}", err=True)))
    typer.echo(f"{len(written)} file{'s' if len(written) != 1 else ''} in {folder}")


def replay(
    run: RecordedRun = RUNS,
    speed: Annotated[
        float | None, opt("Experiment seconds in a real second. Default: as it was recorded.", min=1e-6)
    ] = None,
    only: Annotated[
        list[str] | None, opt("Publish only these, e.g. Scan2d,ControlState.", "--only", metavar="MESSAGE[,…]")
    ] = None,
    publish: Annotated[
        str | None, opt("Where. Default: as the experiment file says, else a free port.", metavar="ADDRESS")
    ] = None,
    serve: Annotated[str | None, opt("Where requests are answered.", metavar="ADDRESS")] = None,
    stay: Annotated[
        bool, typer.Option("--stay", help="Serve late joiners when all is published, until Ctrl-C.")
    ] = False,
    runs: Annotated[Path, typer.Option("--runs", metavar="DIR", help="Where to make the replay's folder.")] = RUNS,
) -> None:
    """Publish a recorded run again, with its timing at any speed, as its scheduler did.

    It can be joined like a running experiment: afspm.connect, afspm dashboard, afspm run FILE --only COMPONENT. Who
    comes late gets what was kept. Requests are refused: nobody measures.
    """
    from afspm.supervisor import replay as replaying

    options = replaying.ReplayOptions(speed, names_in(only), publish, serve, stay=stay, runs=runs)
    count = replaying.replay(run, options, typer.echo)
    typer.echo(f"published {counted(count, 'packet')}")
