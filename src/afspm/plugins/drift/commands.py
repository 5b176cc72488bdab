"""`afspm drift`: follow drift in recorded scans, and study settings in simulated nights."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from afspm.processes import AFTERWARDS, HelpWhenBare, NoProgress

_FILES = "files"


class FilesUnlessNamed(HelpWhenBare):
    """Command group that runs `afspm drift a.sxm` as `afspm drift files a.sxm`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = [_FILES, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=FilesUnlessNamed,
    rich_markup_mode=None,
    rich_help_panel=AFTERWARDS,
    help="Follow drift in recorded scans (afspm drift FILE…; its options: afspm drift files --help), or study settings "
    "in simulated nights (afspm drift study).",
)
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        "-j",
        min=1,
        help="Processes. Default: the cores, or for a few small scans this one alone.",
        show_default=False,
    ),
]


@app.command(_FILES)
def files(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="FILE…", help="Scans, folders of them, or folders of runs.", show_default=False),
    ],
    channel: Annotated[
        str, typer.Option(help="The channel to follow. Default: the topography.", show_default=False)
    ] = "",
    estimator: Annotated[str, typer.Option(help="How two scans are registered.")] = "least-squares",
    tracker: Annotated[str, typer.Option(help="How drift is followed from scan to scan.")] = "bank",
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Where to write.")] = Path("drift"),
    jobs: Jobs = None,
    quiet: NoProgress = False,
) -> None:
    """Follow drift in recorded scans.

    Prints a table and writes it (drift.csv), with figures and a stack of the aligned scans over their common area
    (drift_stack.nc). Unreadable files are named and left out. Your own estimator or tracker, module.Class, may be in
    the current folder.
    """
    _one_thread_a_process()
    from afspm.plugins.drift.report import file_commands as drift_files
    from afspm.processes import importing_from

    # only for a class of one's own: the current folder may be a download, with a module named like a library's
    folders = [Path.cwd()] if "." in estimator + tracker else []
    with importing_from(folders):
        drift_files.run(paths, channel, estimator, tracker, output, jobs, quiet=quiet)


@app.command("study")
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
    _one_thread_a_process()
    from afspm.plugins.drift.study import study_commands as drift_study
    from afspm.processes import importing_from

    with importing_from([Path.cwd()]):
        drift_study.run(settings or [], nights, seed, cluster, jobs, quiet=quiet)


def _one_thread_a_process() -> None:
    # Registration works on small arrays with one process per core: threads of the linear algebra would only compete.
    # The variables count before numpy is loaded, and child processes inherit them.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
