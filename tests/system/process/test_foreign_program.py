"""The guard of components in other languages."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from afspm.basics.exit_codes import ExitCode

GUARD = [sys.executable, "-m", "afspm.supervisor.foreign"]

# other languages have no Python: these use nothing of ours
ECHO = "import sys; print(sys.stdin.readline().strip(), flush=True); print('eof', repr(sys.stdin.read()), flush=True)"
DEAF = (
    "import signal, threading; print('deaf', flush=True); "
    "signal.signal(signal.SIGTERM, signal.SIG_IGN); threading.Event().wait()"
)


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


@pytest.mark.parametrize("separator", [[], ["--"]])
def test_foreign_program_gets_launch_line_and_end_of_input(start: Any, separator: list[str]) -> None:
    child = start([*GUARD, *separator, *python(ECHO)], '{"name": "x"}')
    child.expect('{"name": "x"}')
    child.let_go()
    child.expect("eof ''")
    assert child.exit_code() == 0


def test_exit_code_of_a_foreign_program_is_passed_on(start: Any) -> None:
    assert start([*GUARD, *python("raise SystemExit(80)")], "{}").exit_code() == ExitCode.ENDED


def test_foreign_program_that_ignores_the_end_is_killed(start: Any) -> None:
    child = start([*GUARD, *python(DEAF)], "{}")
    child.expect("deaf")
    child.let_go()
    assert child.exit_code() == ExitCode.ORPHAN


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
def test_terminated_guard_ends_its_command(start: Any) -> None:
    child = start([*GUARD, *python(DEAF)], "{}")
    child.expect("deaf")
    child.popen.terminate()
    assert child.exit_code() == ExitCode.ORPHAN


TERMINATED_AT_ONCE = """
import os, signal, subprocess, sys
from afspm.supervisor import foreign

class Popen(subprocess.Popen):
    def __init__(self, *args, **settings):
        super().__init__(*args, **settings)
        os.kill(os.getpid(), signal.SIGTERM)

subprocess.Popen = Popen
sys.exit(int(foreign.main(sys.argv[1:])))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
def test_guard_terminated_at_the_start_ends_its_command(start: Any) -> None:
    child = start([*python(TERMINATED_AT_ONCE), *python(DEAF)], "{}")
    assert child.exit_code() == ExitCode.ORPHAN


def test_crash_of_a_foreign_program_is_reported_as_a_crash(start: Any) -> None:
    child = start([*GUARD, *python("import os; os.abort()")], "{}")
    assert child.exit_code() not in (ExitCode.DONE, ExitCode.ENDED, ExitCode.ORPHAN, ExitCode.CONFIG)


@pytest.mark.parametrize("command", [[], ["/no/such/program"]])
def test_program_that_can_not_be_started_is_reported(start: Any, command: list[str]) -> None:
    child = start([*GUARD, *command], "{}")
    assert child.exit_code() == ExitCode.CONFIG
    assert child.error_text.startswith("ERROR ")
