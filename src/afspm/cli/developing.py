"""`afspm new`, `test-translator`, `test-client` and `emulate`: for developers of components, drivers and clients."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import RUNS, CheckSpeed, HelpWhenBare, Runs, WithinFrame, names_in, opt

if TYPE_CHECKING:
    from rich.console import Console

    from afspm.basics.plain_data import Plain
    from afspm.simulation.emulation.emulator import Emulator
    from afspm.testing.translators import CheckOptions


_ASK = """This moves the probe, takes scans and spectra, changes gains and bias by a few percent, and switches the
feedback off and on, all within the present frame, and then restores all settings. It never approaches, pulses or
crashes. Is the tip so far from the sample that it can't reach it, even at the full extension of the feedback?"""
_ASK_WITHOUT_TIP = """This takes scans and changes settings by a few percent, all within the present frame, and then
restores all settings. Shall it begin?"""


def check_translator(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE [OVERLAY…]",
            help="An experiment file with a translator; a scheduler, too, unless the usual one will do.",
            show_default=False,
        ),
    ] = None,
    only: Annotated[
        list[str] | None, opt("Only checks with this in their name.", "--only", "-k", metavar="PART")
    ] = None,
    without: Annotated[
        list[str] | None,
        opt("Processes that run already: joined by the addresses in the file.", "--without", metavar="NAME[,NAME…]"),
    ] = None,
    report: Annotated[
        Path | None, opt("Write the report here, too; JUnit's XML if FILE ends with .xml.", "--report", metavar="FILE")
    ] = None,
    runs: Runs = RUNS,
    speed: CheckSpeed = 20.0,
    frame: WithinFrame = "",
    yes: Annotated[bool, typer.Option("--yes", "-y", help="The tip is withdrawn: don't ask.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the checks, and do none.")] = False,
) -> None:
    """Check each base operation of a translator from outside, with the tip withdrawn.

    Starts translator and scheduler (and an emulated controller, if the file has one), or joins running processes.
    Operations that the microscope does not support are skipped and listed. Ends with 0 if nothing was wrong.
    """
    import sys

    from rich.console import Console

    from afspm.basics.units import si
    from afspm.testing.translators import CheckOptions
    from afspm.testing.translators.translator_suite import TRANSLATOR_SUITE

    if listed:
        for check in TRANSLATOR_SUITE.checks():
            typer.echo(check.listed)
        return
    if not files:
        raise typer.BadParameter("give an experiment file", param_hint="FILE")
    console = Console(file=sys.stdout, highlight=False)
    options = CheckOptions(files, names_in(without), runs, speed, names_in(only), si(frame, "m") if frame else None)
    if not yes and (question := _question(options)):
        typer.confirm(question, abort=True)
    _check(options, console, report)


def _question(options: CheckOptions) -> str:
    # empty: a simulated microscope can't be damaged
    from afspm.testing.translators.session import has_tip, is_simulated, prepare

    experiment = prepare(options)
    if is_simulated(experiment, options):
        return ""
    return _ASK if has_tip(experiment) else _ASK_WITHOUT_TIP


def _check(options: CheckOptions, console: Console, copy: Path | None) -> None:
    import signal

    from afspm.testing.conformance import show_result
    from afspm.testing.translators import CheckReport, run
    from afspm.testing.translators.report import show_beginning, show_end

    begun: list[CheckReport] = []

    def begin(report: CheckReport) -> None:
        begun.append(report)
        show_beginning(report, console)

    # SIGTERM, like Ctrl-C, first restores all settings
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        report = run(options, begin, done=lambda result: show_result(result, console, begun[0].results))
    except KeyboardInterrupt:
        for report in begun:
            show_end(report, console)
        raise
    show_end(report, console)
    if copy is not None:
        report.write(copy)
    if not report.passed:
        raise typer.Exit(1)


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
    """Test a client in another language by its behaviour in experiments on the simulated microscope.

    Starts the client's conformance program repeatedly, with real and with scripted schedulers, and sends the program
    steps to carry out. Ends with 0 if nothing was wrong.
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
        raise typer.BadParameter("give the client's conformance program", param_hint="-- COMMAND")
    console = Console(file=sys.stdout, highlight=False)
    result = judge(command, runs, only or (), lambda one: show_result(one, console))
    show_client_end(result, console)
    if report is not None:
        result.write(report)
    if not result.passed:
        raise typer.Exit(1)


def emulate(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="The controller. Without it, the command lists all.")
    ] = "",
    settings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SETTING=VALUE…", help="Other settings, values as in TOML: surface=steps", show_default=False
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 0,
    usual: Annotated[
        bool, typer.Option("--usual", help="Listen where the vendor's own controller does, for clients that expect it.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    speed: Annotated[float, typer.Option(min=1e-6, help="Experiment seconds in a real second.")] = 1.0,
    fault: Annotated[
        list[str] | None,
        opt("A fault, and its time.", metavar="KIND[@SECONDS][,count=N][,duration=SECONDS]"),
    ] = None,
    as_reported: Annotated[
        bool,
        typer.Option("--as-reported", help="Behave in all that others report of real ones."),
    ] = False,
    folder: Annotated[
        Path | None, opt("For its files. Default: emulated-NAME", "--folder", "-o", metavar="DIR")
    ] = None,
    replay: Annotated[
        Path | None, opt("Answer as a recorded controller did: a trace of `afspm trace`.", metavar="TRACE")
    ] = None,
) -> None:
    """Emulate a vendor's controller: its own protocol, simulated physics behind it.

    Runs until Ctrl-C. Listens on this computer only, and at a free port unless you name a port: a client that connects
    to the vendor's usual port may expect a real controller there. A replay ends with 1 if a request differs from the
    recorded one.
    """
    from afspm.basics.errors import ConfigError
    from afspm.simulation.emulation.emulator import emulator_names, find_emulator

    if replay is not None:
        _replay(replay, port, folder)
        return
    if not name:
        for known in emulator_names():
            typer.echo(_described(known, find_emulator(known)))
        return
    class_ = find_emulator(name)
    if as_reported and not class_.reported:
        raise ConfigError(f"no reports of real controllers are known for {class_.vendor}", where="--as-reported")
    options = {
        **({"port": port} if port else {}),
        **({"as_reported": True} if as_reported else {}),
        **({"seed": seed} if seed != 1 else {}),
        "faults": fault or [],
    }
    given = _settings(settings or [])
    for twice in sorted(given.keys() & {key for key, value in options.items() if value}):
        raise ConfigError(f"{twice} is given as an option and as a setting", hint="leave one of them out")
    made = class_(**_checked(class_, {**(class_.usual if usual else {}), **options, **given}, name))
    made.check()
    _emulate(made, speed, folder or Path(f"emulated-{class_.vendor.lower()}"))


def _replay(trace: Path, port: int, folder: Path | None) -> None:
    from afspm.simulation.emulation.replay import TraceReplay

    made = TraceReplay(trace=str(trace), port=port)
    made.check()
    _emulate(made, 1.0, folder or Path("emulated-replay"))
    if made.deviation:
        raise typer.Exit(1)


def _emulate(emulator: Emulator, speed: float, folder: Path) -> None:
    import signal

    from afspm.basics.clock import ExperimentClock
    from afspm.simulation.emulation.emulator import Crashed
    from afspm.transport.process import signals
    from afspm.transport.process.log import set_up

    log = set_up("emulate", "INFO")

    def listening(address: str) -> None:
        signal.set_wakeup_fd(emulator.woken.writer_fileno(), warn_on_full_buffer=False)
        where = f"listening at {address}, files in {folder.resolve()}" if address else "does not listen for now"
        typer.echo(f"SIMULATED {emulator.vendor} controller: {where}")

    try:
        with signals.caught(lambda _: emulator.stop(), -1):  # also restores the wakeup descriptor set by `listening`
            emulator.run(ExperimentClock.starting_now(speed=speed), folder.resolve(), log, listening)
    except Crashed as crash:
        typer.echo(f"SIMULATED crash: {crash}", err=True)
        raise typer.Exit(1) from None


def _described(name: str, class_: type[Emulator]) -> str:
    faults = "".join(f"\n    {kind:20} {does}" for kind, does in class_.all_faults().items())
    known = {**class_.reported, **class_.reported_of_others}
    reports = "".join(f"\n    {report:20} {does}" for report, does in known.items())
    return f"{name}: {class_.vendor}{faults}" + (f"\n  as others report of real ones:{reports}" if reports else "")


def _settings(given: list[str]) -> dict[str, object]:
    # `a=1`, `a.b="x"`, `a=word`: as in TOML, but a word needs no quotes.
    import tomllib

    from afspm.basics.errors import ConfigError

    lines = []
    for one in given:
        key, found, value = one.partition("=")
        try:
            tomllib.loads(f"value = {value}")
        except tomllib.TOMLDecodeError:
            quoted = value.replace("\\", "\\\\").replace('"', '\\"')
            value = f'"{quoted}"'
        if not found:
            raise ConfigError(f"{one!r} is not a setting", hint="SETTING=VALUE")
        lines.append(f"{key} = {value}")
    try:
        return tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{' '.join(given)}: {error}", hint="SETTING=VALUE, names separated by dots") from error


def _checked(class_: type[Emulator], given: Plain, name: str) -> Plain:
    # settings are checked and converted to SI as those of [controller] in an experiment file
    from afspm.basics.errors import ConfigError, ErrorCollector
    from afspm.experiment.component_settings import resolve
    from afspm.experiment.document import Document

    document = Document((Path("emulate"),), {name: given})
    found = resolve(class_, given, (name,), document)
    errors = ErrorCollector()
    for finding in document.findings.found:
        with errors:
            raise ConfigError(finding.what, hint=finding.hint)
    errors.raise_all()
    return found


Name = Annotated[str, typer.Argument(metavar="NAME", help="Of it and of its folder, e.g. my_idea.")]
Into = Annotated[Path, typer.Option("--into", metavar="DIR", help="Where to make its folder.")]

new_app = typer.Typer(
    cls=HelpWhenBare, rich_markup_mode=None, help="Make an experiment, component or driver to begin with."
)


@new_app.command("experiment")
def experiment(name: Name, into: Into = Path()) -> None:
    """Make a folder with an experiment file: a few scans on the simulated microscope."""
    _write("experiment", name, into, "then change it; try it with", "afspm run experiment.toml")


@new_app.command("component")
def component(name: Name, into: Into = Path()) -> None:
    """Make a folder with a component of your own, and an experiment that runs it on the simulated microscope."""
    _write("component", name, into, "then change what it does; try it with", "afspm run experiment.toml")


@new_app.command("driver")
def driver(name: Name, into: Into = Path()) -> None:
    """Make a package with a driver for a new controller.

    At first the driver works with a simulated controller in the package, and passes the checks of its operations.
    """
    what = "replace its PretendController, and look how far it is with"
    _write("driver", name, into, what, "afspm test-translator experiment.toml")


@new_app.command("instrument")
def instrument(
    maker: Annotated[str, typer.Argument(metavar="MAKER", help="Of the controller, e.g. nanonis.")],
    address: Annotated[str, typer.Argument(metavar="[ADDRESS]", help="By default the maker's usual one.")] = "",
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The file to write.")] = Path(
        "instrument.toml"
    ),
) -> None:
    """Ask a controller, and write a file for it: address, roles of channels, and proposed limits with their reasons.

    Only questions are sent. Lay the file over any experiment: `afspm run drift_night/experiment.toml instrument.toml`.
    """
    import datetime as dt

    from afspm.basics.errors import ConfigError
    from afspm.cli import contacting, examination, instrument_file
    from afspm.experiment.shadow import driver_of

    if out.exists():
        raise ConfigError("the file is there already", where=str(out), hint="name another with --out")
    name, driver = driver_of(maker)
    settings = {"address": address} if address else {}
    found, told = contacting.asked(driver, settings)
    examination.show(told)
    if found is None or found.lost is not None:
        raise typer.Exit(1)
    day = dt.datetime.now(dt.UTC).date().isoformat()
    text = instrument_file.text_of(name, driver.channels_of(settings), found, day)
    out.write_text(text, encoding="utf-8")
    typer.echo(f"{out}: look through its limits; then try it with: afspm check EXPERIMENT.toml {out}")


def _write(kind: str, name: str, into: Path, what: str, command: str) -> None:
    from afspm.testing.skeletons import write

    folder = write(kind, name, into)
    typer.echo(f"{folder}: {what}")
    typer.echo(f"    cd {folder} && {command}")
