"""`afspm keys`: a CURVE key pair for each process of an experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.cli.arguments import Files


def keys(
    files: Files,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", help="Where to put them. Default: [security] keys of the file, else keys/ beside it."),
    ] = None,
    also: Annotated[
        list[str] | None, typer.Option("--also", metavar="NAME", help="A person who is to have a key. Repeatable.")
    ] = None,
) -> None:
    """Make a key pair for each process of an experiment, for the supervisors, and for the people named.

    Keys that are there already are left as they are. Copy public/ to every computer, and of private/ only the keys of
    what runs there.
    """
    from afspm.experiment import load
    from afspm.logic.supervisor_registry import SUPERVISOR
    from afspm.transport.keys import generate

    experiment = load(*files)
    target = folder or experiment.keys_folder or experiment.folder / "keys"
    written = generate(target, [*experiment.component_names, SUPERVISOR, *(also or ())])
    for file in written:
        typer.echo(file)
    if not written:
        typer.echo(f"all keys are there already, in {target}")
    if experiment.keys_folder is None:
        typer.echo(f'to use them: [security] keys = "{target.name}"')
