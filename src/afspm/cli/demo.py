"""`afspm demo`: a simulated night, from a sample that is installed with afspm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from afspm.cli import run as running
from afspm.cli.arguments import RUNS, Runs

_TIP_REPAIR = "A simulated night of eight hours: the tip changes three times, and is repaired. Two minutes."
_DRIFT = "A simulated night of eighteen hours on a sample that drifts by micrometres. Three to five minutes."


def demo(
    drift: Annotated[bool, typer.Option("--drift", help="The night on a sample that drifts.")] = False,
    runs: Runs = RUNS,
    dashboard: Annotated[bool, typer.Option("--dashboard", help="Show it in the browser, too.")] = False,
) -> None:
    """Show a simulated night: the tip changes, is seen to have changed, and is repaired.

    Nothing but afspm is needed. The night leaves a folder with its scans, a picture and `report.html`.
    """
    typer.echo(_DRIFT if drift else _TIP_REPAIR)
    typer.echo(f"It leaves a folder in {runs}, with report.html. Ctrl-C ends it early.")
    running.run([sample("drift_night" if drift else "tip_repair") / "experiment.toml"], runs=runs, dashboard=dashboard)


def sample(name: str) -> Path:
    """Return the folder of a sample: the one in the wheel, in a clone that in `experiments`."""
    package = Path(__file__).parents[1]
    installed = package / "samples" / name
    return installed if installed.is_dir() else package.parents[1] / "experiments" / name
