"""`afspm commission`: commissioning of a new controller, step by step in the terminal."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from afspm.cli.arguments import RUNS, CheckSpeed, Files, Runs, WithinFrame, opt
from afspm.cli.joining import plain_console

if TYPE_CHECKING:
    from afspm.testing.commissioning.report import InstrumentReport

_INTRODUCTION = """This goes through a controller step by step. Each step is explained, and nothing is moved before you
confirm it. The first steps only read (connecting may change how the controller saves its scans). Ctrl-C at any moment
stops the scan, puts the settings back, and withdraws the tip if it is at the sample. The same command goes on later."""


_TRIED_ON = """The report says what was tried: an instrument, with its scanner and a sample; or a maker's program: the
maker's own software without an instrument, with the scanner that it simulates."""
# an input that repeats a wrong answer (a pipe) must not loop for ever
_TRIES = 5
_STYLES = {"✓": "green", "✗": "bold red", "–": "yellow"}


def commission(
    files: Files,
    report: Annotated[
        Path | None, opt("The report. Default: FILE-commissioning.toml, here.", "--report", metavar="REPORT")
    ] = None,
    runs: Runs = RUNS,
    frame: WithinFrame = "",
    anew: Annotated[bool, opt("Repeat all steps, also passed ones.", "--anew")] = False,  # word: anew
    only: Annotated[str, opt("Only this step, with the questions about the tip: moved-frame.", "--only")] = "",
    speed: CheckSpeed = 20.0,
) -> None:
    """Take a new controller into use, step by step, with the tip withdrawn first.

    Writes a report for people and programs. Ends with 0 if nothing was wrong.
    """
    from afspm.basics.errors import FileError
    from afspm.basics.units import si
    from afspm.cli import commission_pack
    from afspm.testing.commissioning.procedure import REHEARSAL_PATIENCE
    from afspm.testing.commissioning.procedure import commission as walk
    from afspm.testing.commissioning.report import TRIED_ON
    from afspm.testing.translators import CheckOptions
    from afspm.testing.translators.session import is_simulated, prepare

    options = CheckOptions(files, runs=runs, speed=speed, frame_m=si(frame, "m") if frame else None)
    simulated = is_simulated(prepare(options), options)
    if simulated:
        options = replace(options, patience=REHEARSAL_PATIENCE)
    terminal = Terminal()
    terminal.show(_INTRODUCTION)
    file = report or Path(f"{files[0].stem}-{only or 'commissioning'}.toml")
    before = None if anew or only else _before(file)
    if before is not None:
        terminal.show(f"continuing with {file}: steps that passed are not repeated")
    if not simulated:
        terminal.show(_TRIED_ON)
    tried_on = "emulator" if simulated else terminal.choose("Which controller is connected?", TRIED_ON[:2])
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    ended = walk(options, terminal, file, tried_on, before, only=only)
    if ended.lost:
        terminal.show(f"not completed: {ended.lost}")
    for line in ended.progress.not_done():
        terminal.show(line)
    terminal.show(f"\nthe report: {file}")
    to_send = file.with_name(f"{file.stem}-to-send")
    try:
        commission_pack.write(to_send, file, ended.folder, ended.scans)
        terminal.show(f"to send, if you like, without names and places: {to_send} (its README.md lists all)")
    except FileError as error:
        terminal.show(f"no folder to send: {error}")
    terminal.show(f"log, trace and files: {ended.folder}")
    raise typer.Exit(0 if ended.passed else 1)


def _before(file: Path) -> InstrumentReport | None:
    from afspm.testing.commissioning.report import InstrumentReport

    return InstrumentReport.read(file) if file.exists() else None


class Terminal:
    """A dialogue with the user at this terminal. An empty answer is no confirmation."""

    def __init__(self) -> None:
        self._console = plain_console()

    def show(self, text: str) -> None:
        """Print a text; after an empty line at its beginning, the next line is printed as a title."""
        title, _, rest = text.removeprefix("\n").partition("\n") if text.startswith("\n") else ("", "", text)
        if title:
            self._console.print(f"\n{title}", style="bold")
        if rest:
            self._console.print(rest, style=_STYLES.get(rest[:1]))

    def confirm(self, question: str) -> bool:
        for _ in range(_TRIES):
            answer = self._line(f"{question} [y/N] ").strip().casefold()
            if answer in ("y", "yes", "", "n", "no"):
                return answer in ("y", "yes")
            self.show(f"  {answer!r} is neither: type y or n")
        return False

    def text(self, question: str) -> str:
        return self._line(f"{question}: ")

    def choose(self, question: str, options: Sequence[str], default: str = "") -> str:
        """Ask for one of the options, by number, word or its beginning; an empty answer is the default, if any.

        Raises:
            KeyboardInterrupt: no valid answer after several attempts, or the end of the input.
        """
        numbered = ", ".join(f"{number} {option}" for number, option in enumerate(options, 1))
        if default:
            numbered += f"; Enter: {default}"
        for _ in range(_TRIES):
            answer = self._line(f"{question} [{numbered}] ").strip().casefold() or default
            if answer.isdecimal() and 0 < int(answer) <= len(options):
                return options[int(answer) - 1]
            if len(chosen := [one for one in options if answer and one.startswith(answer)]) == 1:
                return chosen[0]
            self.show(f"  {answer!r} is none of them: type a number from 1 to {len(options)}, or the word")
        self.show(f"  no choice after {_TRIES} answers: ended")
        raise KeyboardInterrupt

    def _line(self, question: str) -> str:
        _forget_typed()
        # the end of input counts as Ctrl-C: without a terminal there is no answer to wait for
        with _interruptible():
            try:
                return input(question)
            except EOFError:
                raise KeyboardInterrupt from None


def _forget_typed() -> None:
    # what was typed while afspm was busy answers no question that was not on the screen
    if sys.stdin.isatty():
        if sys.platform == "win32":
            import msvcrt

            while msvcrt.kbhit():
                msvcrt.getwch()
        else:
            import termios

            termios.tcflush(sys.stdin, termios.TCIFLUSH)


@contextmanager
def _interruptible() -> Iterator[None]:
    # during a question no request is under way, so Ctrl-C need not wait for one
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
