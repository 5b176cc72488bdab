"""`afspm export`: a recorded run for Gwyddion and others."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def export(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="The folder of a run, or of all runs: its newest is meant.")
    ] = Path("runs"),
    to: Annotated[str, typer.Option(metavar="gwy|nc|png|csv", help="Gwyddion, netCDF, pictures, or tables.")] = "gwy",
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Where to write. Default: export in the folder of the run.", show_default=False
        ),
    ] = None,
    scans: Annotated[
        str | None,
        typer.Option(metavar="1-5,8", help="Only these scans, by their numbers; 7-: from 7 on.", show_default=False),
    ] = None,
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
