"""`afspm trace`: an experiment with all that is said to and by the controller kept in one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from afspm.cli.arguments import RUNS, Files, Runs, Speed

if TYPE_CHECKING:
    from afspm.experiment import Experiment


def trace(
    files: Files,
    runs: Runs = RUNS,
    speed: Speed = None,
) -> None:
    """Run an experiment, and record everything that is said to and by the controller.

    The trace is in the run's folder: one file, with the files that the controller saved and without secrets. Send it
    with a report of a bug: `afspm emulate --replay` plays it back. As `afspm run` with `trace = true` in the section of
    the translator.
    """
    import sys

    from afspm.cli.experiment_file import require_no_errors
    from afspm.supervisor import run as running
    from afspm.translator.trace import FILE

    experiment = with_trace(files)
    require_no_errors(experiment, (), ())
    ended = running.run(experiment, running.RunOptions(runs=runs, speed=speed), terminal=sys.stdout)
    file = ended.folder / FILE
    typer.echo(f"the trace: {file}" if file.exists() else "nothing was said to the controller: there is no trace")
    raise typer.Exit(ended.outcome.exit_code)


def with_trace(files: list[Path]) -> Experiment:
    """Return the experiment, with a trace.

    Raises:
        ConfigError: its translator has none.
    """
    import tempfile

    from afspm.basics.errors import ConfigError
    from afspm.experiment import load
    from afspm.experiment.tracing import trace_overlay

    with tempfile.TemporaryDirectory() as folder:
        overlay = trace_overlay(load(*files).resolved, Path(folder))
        if overlay is None:
            raise ConfigError("no translator here talks to a controller: nothing to trace", where=str(files[0]))
        return load(*files, overlay)
