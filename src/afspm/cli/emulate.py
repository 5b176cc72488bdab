"""`afspm emulate`: a vendor's controller to develop against, without the vendor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from afspm.emulators.emulator import Emulator


def emulate(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The controller; without it: those that there are.")] = "",
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
    seed: Annotated[int, typer.Option(help="Everything left to chance follows from it.")] = 1,
    speed: Annotated[float, typer.Option(min=1e-6, help="Experiment seconds in a real second.")] = 1.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND[@SECONDS][,count=N][,duration=SECONDS]", help="What goes wrong, and when.", show_default=False
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option("--folder", "-o", metavar="DIR", help="For its files. Default: emulated-NAME", show_default=False),
    ] = None,
) -> None:
    """Emulate a vendor's controller: its own protocol, simulated physics behind it.

    Runs until Ctrl-C. It listens on this computer only, at a free port unless it is told another: whoever connects
    to the vendor's usual port may expect a real controller there.
    """
    from afspm.emulators.registry import emulator, names

    if not name:
        for known in names():
            typer.echo(_described(known, emulator(known)))
        return
    class_ = emulator(name)
    given = {**(class_.usual if usual else {}), **({"port": port} if port else {}), **_settings(settings or [])}
    made = class_(seed=seed, faults=fault or [], **given)
    made.check()
    _run(made, speed, folder or Path(f"emulated-{class_.vendor.lower()}"))


def _run(emulator: Emulator, speed: float, folder: Path) -> None:
    import signal

    from afspm.clock import ExperimentClock
    from afspm.emulators.emulator import Crashed
    from afspm.process.log import set_up

    log = set_up("emulate", "INFO")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: emulator.stop())

    def listening(address: str) -> None:
        where = f"listening at {address}, files in {folder.resolve()}" if address else "does not listen for now"
        typer.echo(f"SIMULATED {emulator.vendor} controller: {where}")

    try:
        emulator.run(ExperimentClock.starting_now(speed=speed), folder.resolve(), log, listening)
    except Crashed as crash:
        typer.echo(f"SIMULATED crash: {crash}", err=True)
        raise typer.Exit(1) from None


def _described(name: str, class_: type[Emulator]) -> str:
    faults = "".join(f"\n    {kind:20} {does}" for kind, does in class_.fault_kinds.items())
    return f"{name}: {class_.vendor}{faults}"


def _settings(given: list[str]) -> dict[str, Any]:
    """`a=1`, `a.b="x"`, `a=word`: as in TOML, but that a word needs no quotes.

    Raises:
        ConfigError: not of that form.
    """
    import tomllib

    from afspm.errors import ConfigError

    lines = []
    for one in given:
        key, found, value = one.partition("=")
        try:
            tomllib.loads(f"value = {value}")
        except tomllib.TOMLDecodeError:
            quoted = value.replace("\\", "\\\\").replace('"', '\\"')
            value = f'"{quoted}"'
        if not found:
            raise ConfigError(f"{one!r} is no setting", hint="SETTING=VALUE")
        lines.append(f"{key} = {value}")
    try:
        return tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{' '.join(given)}: {error}", hint="SETTING=VALUE, names separated by dots") from error
