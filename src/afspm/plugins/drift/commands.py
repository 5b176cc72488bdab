"""`afspm drift`: follow drift in recorded scans; packages add further commands."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from afspm.cli import AFTERWARDS, DeclaredCommands, NoProgress

_FILES = "files"


class FilesUnlessNamed(DeclaredCommands):
    """Command group that runs `afspm drift a.sxm` as `afspm drift files a.sxm`."""

    group = "afspm.drift_commands"
    prefix = "drift "

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and not self.is_name(ctx, args[0]) and args[0] not in ctx.help_option_names:
            args = [_FILES, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=FilesUnlessNamed,
    rich_markup_mode=None,
    rich_help_panel=AFTERWARDS,
    help="Follow drift in recorded scans (afspm drift FILE…; its options: afspm drift files --help), or study settings "
    "in simulated nights (afspm drift study, of the package afspm-lab).",
)


@app.callback()
def _drift() -> None:  # without it typer makes a group with one command that command
    pass


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
    one_thread_a_process()
    from afspm.experiment import importing_from
    from afspm.plugins.drift.report import file_commands as drift_files

    # only for a class of one's own: the current folder may be a download, with a module named like a library's
    folders = [Path.cwd()] if "." in estimator + tracker else []
    with importing_from(folders):
        drift_files.run(paths, channel, estimator, tracker, output, jobs, quiet=quiet)


def one_thread_a_process() -> None:
    """Let the linear algebra of this process and its children use one thread; call it before numpy is imported."""
    # registration works on small arrays with one process per core: threads would only compete
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
