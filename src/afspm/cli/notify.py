"""`afspm notify`: whether the calls of [notify] arrive."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import Files

if TYPE_CHECKING:
    from afspm.components.notifications import Notification, Targets, Way
    from afspm.experiment import Experiment


def notify(
    files: Files, test: Annotated[bool, typer.Option("--test", help="Send a test message by each of them.")] = False
) -> None:
    """List the calls that the [notify] of an experiment file makes, and try them.

    Ends with 1 if there are none, or if a test message does not arrive.
    """
    from afspm.cli.experiment_file import require_no_errors
    from afspm.experiment import implied_parts, load

    experiment = load(*files)
    require_no_errors(experiment)
    section = experiment.resolved.sections.notify
    targets = implied_parts.targets(section, experiment.folder)
    if not targets.ways:
        typer.echo("afspm: the file has no [notify] with a `command` or a `webhook`", err=True)
        raise typer.Exit(1)
    if not test:
        typer.echo(f"{' and '.join(targets.ways)}, on {', '.join(section.on)}; --test sends a message")
        return
    arrived = [_arrives(targets, _message(experiment), way) for way in targets.ways]
    if not all(arrived):
        raise typer.Exit(1)


def _message(experiment: Experiment) -> Notification:
    from afspm.basics.clock import ExperimentClock
    from afspm.components.notifications import TEST, Notification

    now_ns = ExperimentClock.real().now_ns()
    return Notification(TEST, experiment.name, "", now_ns, "a test message of afspm: calls from this experiment arrive")


def _arrives(targets: Targets, message: Notification, way: Way) -> bool:
    """Send a message once, and say whether it arrived."""
    from afspm.basics.errors import ConfigError
    from afspm.components.notifications import NotDelivered

    try:
        targets.deliver(message, way)
    except (ConfigError, NotDelivered) as error:
        typer.echo(f"the {way} failed: {error}", err=True)
        return False
    typer.echo(f"the {way} took the message")
    return True
