"""`afspm test-client`: for those who write a client in another language."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.cli.arguments import RUNS, Runs, opt


def check_client(
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="-- COMMAND ARGUMENTS…", help="The client's conformance program.", show_default=False),
    ] = None,
    only: Annotated[
        list[str] | None, opt("Only checks with this in their name.", "--only", "-k", metavar="PART")
    ] = None,
    report: Annotated[
        Path | None, opt("Write the report here, too; JUnit's XML if FILE ends with .xml.", "--report", metavar="FILE")
    ] = None,
    runs: Runs = RUNS,
    listed: Annotated[bool, typer.Option("--list", help="List the checks, and do none.")] = False,
) -> None:
    """Judge a client in another language by what it does in experiments on the simulated microscope.

    Starts the client's conformance program again and again, with real and with scripted schedulers, and gives it
    steps. Ends with 0 if nothing was wrong.
    """
    import sys

    from rich.console import Console

    from afspm.testing.clients.client_suite import CLIENT_SUITE
    from afspm.testing.clients.runner import judge, show_client_end
    from afspm.testing.conformance import show_result

    if listed:
        for check in CLIENT_SUITE.checks():
            typer.echo(check.listed)
        return
    if not command:
        raise typer.BadParameter("the client's conformance program is wanted", param_hint="-- COMMAND")
    console = Console(file=sys.stdout, highlight=False)
    result = judge(command, runs, only or (), lambda one: show_result(one, console))
    show_client_end(result, console)
    if report is not None:
        result.write(report)
    if not result.passed:
        raise typer.Exit(1)
