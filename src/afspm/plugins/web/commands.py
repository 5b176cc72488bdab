"""`afspm dashboard`: the page of a running or ended experiment; and the page of `afspm run --dashboard`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.basics import Plain, PlainMapping, parse_toml
from afspm.cli import MEANWHILE, RUNS, Where, opt

if TYPE_CHECKING:
    from types import FrameType

    from afspm.experiment import Experiment
    from afspm.plugins.web.dashboard import Dashboard
    from afspm.plugins.web.dashboard.recorded import RecordedSettings
    from afspm.supervisor import ResumableRun
    from afspm.transport import Port

NAME_OF_CLASS = "Dashboard"

app = typer.Typer(rich_markup_mode=None, rich_help_panel=MEANWHILE)


@app.command()
def dashboard(
    where: Where = RUNS,
    host: Annotated[
        str, typer.Option(help="The address to listen at; others than this computer's own need a password.")
    ] = "127.0.0.1",
    port: Annotated[int | None, opt("By default 8080, or any that is free.")] = None,
    certificate: Annotated[Path | None, opt("PEM file, for https.")] = None,
    certificate_key: Annotated[Path | None, opt("PEM file, its key.")] = None,
    people: Annotated[
        Path | None, opt('TOML file with a line for each person who may steer: Ada = "scrypt:…".')
    ] = None,
    make_password: Annotated[
        bool, typer.Option("--make-password", help="Ask for a name and a password, print their line, and end.")
    ] = False,
) -> None:
    """Show an experiment in the browser, to steer it while it runs or to look through it afterwards.

    The page joins a running experiment as a notebook would; the experiment does not depend on it. When the experiment
    ends, the page stays until Ctrl-C, with a slider through the night; a run that has ended is shown in the same way.
    If the experiment runs on another computer, name its experiment file: the page connects to the scheduler's address
    in it. A password for viewers who only look may be in the environment: AFSPM_DASHBOARD_PASSWORD.
    """
    from afspm.record import goes_on

    if make_password:
        _print_password()
        return
    settings: dict[str, object] = {
        "host": host, "port": port, "certificate": certificate, "certificate_key": certificate_key,
        "people": None if people is None else _people_in(people),
    }  # fmt: skip
    folder = _run_here(where)
    if folder is None:
        raise typer.Exit(_start_part(where))
    typer.echo(f"opening the page of {folder.name} …")  # loading the page takes seconds
    if goes_on(folder):
        raise typer.Exit(_join(folder, settings))
    _serve_recorded(folder, settings)


def stay(folder: Path, name: str, settings: PlainMapping) -> None:
    """Show a run that has ended until Ctrl-C.

    Args:
        name: name of the dashboard component, whose settings are `settings`.
    """
    import subprocess
    import sys

    line = f"{_recorded(folder, name, settings).to_json()}\n"
    command = [sys.executable, "-P", "-m", "afspm.plugins.web.dashboard.recorded"]
    # a process of its own: the page of a running experiment may already have used this process's NiceGUI
    with subprocess.Popen(command, stdin=subprocess.PIPE, text=True, encoding="utf-8") as process:
        assert process.stdin is not None
        process.stdin.write(line)
        process.stdin.flush()
        with suppress(KeyboardInterrupt):
            process.wait()
        # leaving closes its standard input, which ends the page if Ctrl-C has not


def page_of(experiment: Experiment, started: Sequence[str]) -> tuple[str, PlainMapping] | None:
    """Return name and settings of a dashboard among the processes started here; None without one."""
    for process in experiment.resolved.processes.values():
        if process.class_path.rpartition(".")[2] == NAME_OF_CLASS and process.name in started:
            return process.name, process.settings
    return None


def with_page(files: list[Path]) -> Experiment:
    """Return the experiment, with a dashboard added if its files define none."""
    from afspm.experiment import load as load_experiment

    experiment = load_experiment(*files)
    return experiment if _has_dashboard(experiment) else load_experiment(*files, _overlay())


def resumed_with_page(found: ResumableRun) -> ResumableRun:
    """Return the run to resume, with a dashboard added if its experiment has none."""
    return found if _has_dashboard(found.experiment) else found.with_overlay(_overlay())


def _has_dashboard(experiment: Experiment) -> bool:
    return NAME_OF_CLASS in {
        process.class_path.rpartition(".")[2] for process in experiment.resolved.processes.values()
    }


def _overlay() -> Path:
    from afspm.plugins.web import dashboard

    return Path(dashboard.__file__).with_name("assets") / "dashboard.toml"


def _print_password() -> None:
    from afspm.plugins.web.passwords import check_name, hashed

    person = check_name(typer.prompt("Name (empty: a password for all who look)", default="", show_default=False))
    password = typer.prompt("Password", hide_input=True, confirmation_prompt=True)
    typer.echo(f'people."{person}" = "{hashed(password)}"' if person else f'password_hash = "{hashed(password)}"')


def _people_in(file: Path) -> dict[str, str]:
    # keys may begin with `people.`, as `--make-password` prints them

    from afspm.basics import ConfigError

    try:
        found = parse_toml(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"can't be read: {error}", where=str(file), hint='lines like Ada = "scrypt:…"') from error
    table = found.get("people", found)
    if not isinstance(table, dict) or not all(isinstance(kept, str) for kept in table.values()):
        raise ConfigError(
            "that is not a table of names and hashes", where=str(file), hint='lines like Ada = "scrypt:…"'
        )
    return table


def _run_here(where: Path) -> Path | None:
    # None: an experiment file without a run here; its run was started on another computer
    from afspm.basics import FileError
    from afspm.client import find_run

    try:
        return find_run(where)
    except FileError:
        if where.suffix == ".toml" and where.is_file():
            return None
        raise


def _join(folder: Path, settings: Plain) -> int:
    import logging
    import sys

    from afspm.basics import ExitCode, require
    from afspm.cli import looking
    from afspm.experiment import DASHBOARD
    from afspm.plugins.web.dashboard import Dashboard
    from afspm.record import read_run_json

    url = _url_in(read_run_json(folder).get("processes"), folder, DASHBOARD)
    if url is not None:
        typer.echo(f"this run has a dashboard already: {url}")
        return 0
    require(Dashboard)
    with looking(folder):
        pass  # raises if the scheduler does not answer
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    code = _run_as_guest(folder, Dashboard(**settings), DASHBOARD)
    if code == ExitCode.ENDED:
        stay(folder, DASHBOARD, settings)
    return 0 if code in (ExitCode.ENDED, ExitCode.DONE, ExitCode.ORPHAN) else 1


def _url_in(processes: object, folder: Path, name: str) -> str | None:
    from afspm import Memory
    from afspm.basics import FileError
    from afspm.record import STATE_DIR

    if not isinstance(processes, dict) or name not in processes:
        return None
    try:
        url = Memory(folder / STATE_DIR / f"{name}.json").get("url")
    except FileError:
        return None
    return url if isinstance(url, str) else None


def _run_as_guest(folder: Path, dashboard: Dashboard, name: str) -> int:
    # returns a component's exit code; the name needs the role `operate` to command the microscope in MANUAL
    import dataclasses
    import logging

    from afspm.basics import ExperimentClock
    from afspm.client import guest_of
    from afspm.record import STATE_DIR
    from afspm.supervisor import register_own_messages
    from afspm.transport import ProcessActivity, ProcessContext, new_session, open_port

    launch = guest_of(folder, name)
    register_own_messages(folder, launch.messages)
    launch = dataclasses.replace(launch, run_dir=str(folder), state_dir=str(folder / STATE_DIR))
    clock = ExperimentClock.from_dict(launch.clock)
    port = open_port(launch, clock)
    context = ProcessContext(
        launch,
        clock,
        open_port=lambda: port,
        log=logging.getLogger(f"afspm.{name}"),
        activity=ProcessActivity(clock),
        session=new_session(launch.run),
    )
    with _ended_by_ctrl_c(port):
        return dashboard.run_process(context)


@contextmanager
def _ended_by_ctrl_c(port: Port) -> Iterator[None]:
    # a dashboard that joins has no parent process: a signal stands for the parent's end
    import signal

    from afspm.transport import ParentGone

    def end(_number: int, _frame: FrameType | None) -> None:
        port.wake_up(ParentGone())

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _serve_recorded(folder: Path, settings: Plain) -> None:
    from afspm.basics import require
    from afspm.experiment import DASHBOARD
    from afspm.plugins.web.dashboard import Dashboard
    from afspm.plugins.web.dashboard.recorded import serve

    require(Dashboard)
    serve(_recorded(folder, DASHBOARD, settings), typer.echo)


def _recorded(folder: Path, name: str, settings: PlainMapping) -> RecordedSettings:
    from afspm.plugins.web.dashboard.recorded import RecordedSettings

    given: Plain = {k: str(v) if isinstance(v, Path) else v for k, v in settings.items() if v is not None}
    return RecordedSettings(str(folder.resolve()), name, **given)


def _start_part(file: Path) -> int:
    # the scheduler runs elsewhere, so the dashboard is started as `afspm run --only` would start it
    import sys

    from afspm.basics import ConfigError
    from afspm.supervisor import RunOptions, dry_run, run_experiment

    experiment = with_page([file])
    names = [one.name for one in experiment.resolved.processes.values() if one.class_path.endswith(f".{NAME_OF_CLASS}")]
    try:
        dry_run(experiment, RunOptions(only=tuple(names)))
    except ConfigError as error:
        what = f"nothing of it runs here, and where its scheduler would be is not in the file: {error.what}"
        raise ConfigError(what, where=str(file), hint="start it with `afspm run`") from error
    ended = run_experiment(experiment, RunOptions(only=tuple(names)), terminal=sys.stdout)
    return ended.outcome.exit_code
