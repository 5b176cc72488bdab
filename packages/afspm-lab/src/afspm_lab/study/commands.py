"""The command `afspm drift study`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.cli import NoProgress
from afspm.plugins.drift.commands import Jobs, one_thread_a_process


def study(
    settings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME=VALUE,…",
            help="Values to try: tracker=bank,paper paper.queue=3,5,10; or a TOML file of such names.",
            show_default=False,
        ),
    ] = None,
    nights: Annotated[int, typer.Option("--nights", "-n", min=1, help="Nights for each combination of settings.")] = 10,
    seed: Annotated[int, typer.Option(help="Of the first night; every combination gets the same nights.")] = 1,
    cluster: Annotated[
        str, typer.Option(metavar="ADDRESS", help="The scheduler of a Dask cluster to work on.", show_default=False)
    ] = "",
    jobs: Jobs = None,
    quiet: NoProgress = False,
) -> None:
    """Simulate many nights over a grid of settings, rank the settings, and check whether the defaults hold."""
    one_thread_a_process()
    from afspm.experiment import importing_from
    from afspm_lab.study import study_table

    with importing_from([Path.cwd()]):
        study_table.run(settings or [], nights, seed, cluster, jobs, quiet=quiet)
