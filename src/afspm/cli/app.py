"""All commands. Each module imports what it works with inside its function, so that any command starts fast."""

from __future__ import annotations

import typer

from afspm.cli import (
    check,
    dashboard,
    drift,
    emulate,
    export,
    graph,
    keys,
    new,
    replay,
    report,
    run,
    status,
    steer,
    test_translator,
)

app = typer.Typer(
    name="afspm",
    help="Automate scanning probe microscopes: run experiments of several components that share one microscope.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("run")(run.run)
app.command("dashboard")(dashboard.dashboard)
app.command("status")(status.status)
app.command("watch")(status.watch)
app.command("pause")(steer.pause)
app.command("resume")(steer.resume)
app.command("end")(steer.end)
app.command("problems")(steer.problems)
app.command("report")(report.report)
app.command("export")(export.export)
app.command("replay")(replay.replay)
app.command("check")(check.check)
app.command("graph")(graph.graph)
app.command("keys")(keys.keys)
app.command("emulate")(emulate.emulate)
app.command("test-translator")(test_translator.check_translator)
app.add_typer(new.app, name="new")
app.add_typer(drift.app, name="drift")
