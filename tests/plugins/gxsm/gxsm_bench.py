"""Bench: the GXSM translator as a process, an emulated GXSM, and a peer on the translator's sockets."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from deadlines import DEADLINE_S
from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.plugins.gxsm.emulator import GxsmEmulator


class Emulated(AtPanel, GxsmEmulator):
    """An emulated GXSM with a person at its panel, that notes its answers."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.answered: list[tuple[str, tuple[object, ...], object]] = []

    def answer(self, method: str, arguments: tuple[object, ...]) -> object:
        found = super().answer(method, arguments)
        self.answered.append((method, arguments, found))
        return found


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.gxsm.Gxsm"
    data_name = "gxsm"

    def __init__(self, folder: Path, stack: ExitStack, speed: float, emulator: dict[str, Any]) -> None:
        if emulator.get("transport") == "shm" and not sys.platform.startswith("linux"):
            pytest.skip("Gxsm4's shared memory is there on Linux alone")
        self.settings = {**PATIENT, "result_timeout_s": 8.0 * speed}
        block = f"afspm_test_{os.getpid()}_{id(self)}"
        super().__init__(folder, stack, speed, {"block": block, **emulator})


def until(made: VendorBench[Any], what: Callable[[], bool]) -> None:
    """Wait for a condition, polled as often as other programs do, so that the emulator gets processor time."""
    until_s = made.clock.monotonic_s() + DEADLINE_S
    pace = Event()
    while not what():
        assert made.clock.monotonic_s() < until_s
        pace.wait(0.005)


ACTING = {"startscan", "stopscan", "set", "moveto_scan_xy"}
"""Functions of GXSM that do something to the tip, beside actions."""


class Calls:
    """The calls that the emulated GXSM answers from now on."""

    def __init__(self, made: VendorBench[Emulated]) -> None:
        self.made = made
        self.answered = made.emulator.answered = []

    def until_scan_is_seen(self) -> None:
        """Wait until the translator's poll has shown the scan: only then the names of its files are asked for."""

        def is_seen() -> bool:
            seen = [
                number
                for number, (method, arguments, found) in enumerate(self.answered)
                if (method, arguments) == ("rtquery", ("s",)) and isinstance(found, tuple) and int(found[0]) & 2
            ]
            return bool(seen) and any(call[:2] == ("chfname", (0,)) for call in self.answered[seen[0] :])

        until(self.made, is_seen)

    @property
    def acting(self) -> list[str]:
        """The calls that do something beside switching Auto Save."""
        return [
            f"{method}{arguments}"
            for method, arguments, _ in self.answered
            if method in ACTING or (method == "action" and "MainAutoSave" not in str(arguments))
        ]


HELD_S = 1e6
"""Delay of a held scan's first line: the scan outlasts the test on however busy a computer."""


def hold_scan(program: Any, *numbers: int) -> None:
    """Hold scans, counted from now, before their first line until `scan_until_line`."""
    start, begun = program.start_scan, itertools.count(1)

    def start_scan() -> None:
        before = program.scan.activity
        start()
        if program.scan.activity is not before and next(begun) in numbers:
            program.scan.activity.paused_s = HELD_S

    program.start_scan = start_scan


def scan_until_line(program: Any, line: int) -> None:
    """Complete these lines of a held scan."""
    scan = program.scan.activity
    scan.paused_s = program.clock.now_s() - scan.start_s - (line + 0.5) * scan.line_s


def scan_to_line(program: Any, line: int) -> None:
    """Complete these lines of a held scan, and no more, however long it takes to stop it."""
    scan_until_line(program, line)
    program.scan.activity.pause(program.clock.now_s())
