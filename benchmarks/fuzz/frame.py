"""The frame of the fuzzers: an emulator in a thread gets random calls, and must still answer correctly afterwards."""

from __future__ import annotations

import logging
import random
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from afspm.basics.clock import ExperimentClock
from afspm.simulation.emulation.emulator import Emulator

CHECKED_EVERY: Final = 200
_TOLD: Final = 40
"""So many calls before the end are told when an emulator is found unfit."""
_SPEED: Final = 300.0
_SESSION: Final = "session"

Emulated = TypeVar("Emulated", bound=Emulator)


class Unfit(AssertionError):
    """An emulator ended, no longer answers, failed at a request, or wrote outside its folder."""


@dataclass(frozen=True)
class Outcome:
    """The counts of a fuzzer's run.

    Attributes:
        answered: calls with a result; refused: with an error of the vendor's; silent: without an answer.
    """

    answered: int
    refused: int
    silent: int


class Fuzzer(ABC, Generic[Emulated]):
    """One vendor's random calls. Write the abstract methods; all are called from one thread.

    Args:
        emulator: to call, on any free port.
        chance: the source of all random numbers.
    """

    def __init__(self, emulator: Emulated, chance: random.Random) -> None:
        self.emulator = emulator
        self.chance = chance

    @abstractmethod
    def connect(self, address: str) -> None:
        """Connect to the emulator, also again after a connection was lost."""

    @abstractmethod
    def call(self) -> tuple[str, bool | None]:
        """Make one call, of any kind.

        Returns:
            The call as a text; and whether it was answered with a result, refused with an error, or (None) not
                answered,
            which is right for some.
        """

    @abstractmethod
    def check(self) -> None:
        """Make an ordinary call, on a connection of its own.

        Raises:
            Unfit, OSError: the answer is wrong or missing.
        """

    @abstractmethod
    def close(self) -> None:
        """Close all connections."""

    def integer(self, *usual: int) -> int:
        """Return mostly one of the usual values, else one at a border."""
        if usual and self.chance.random() < 0.8:
            return self.chance.choice(usual)
        return self.chance.choice((0, 1, 2, 3, 6, 7, 24, 127, 128, 255, 500, 65535, 2**31 - 1, -1, -2, -(2**31)))

    def number(self, *usual: float) -> float:
        """Return mostly one of the usual values, else an unusual one."""
        if usual and self.chance.random() < 0.7:
            return self.chance.choice(usual)
        nan, huge, small = float("nan"), 3e38, 1e-38
        odd = (0.0, -0.0, 1.0, -1.0, small, -small, huge, -huge, nan, float("inf"), -float("inf"), 1e-9, -1e-9)
        return self.chance.choice(odd) * self.chance.choice((1.0, 1.0, self.chance.random()))

    def text(self, *usual: str) -> str:
        """Return mostly one of the usual values, else for example an impossible file name."""
        if usual and self.chance.random() < 0.6:
            return self.chance.choice(usual)
        odd = (
            "",
            ".",
            "..",
            "../outside",
            "a/b",
            "/tmp/afspm-fuzz/x",
            "a\\b",
            "nul\0byte",
            "C:\\x",
            "ä€",
            "%s%n",
            "x" * 400,
        )
        return self.chance.choice(odd)


def fuzz(kind: type[Fuzzer[Any]], emulator: Emulator, folder: Path, count: int, seed: int = 1) -> Outcome:
    """Run `count` calls.

    Args:
        folder: an empty one, in which the emulator has a folder of its own.

    Raises:
        Unfit: with the seed and the last calls.
    """
    fuzzer = kind(emulator, random.Random(seed))
    told: deque[str] = deque(maxlen=_TOLD)
    counts = {True: 0, False: 0, None: 0}
    mishaps = _Mishaps()
    log = logging.getLogger(f"emulated {emulator.vendor}")
    log.addHandler(mishaps)
    try:
        with emulator.running(folder / _SESSION, ExperimentClock.starting_now(speed=_SPEED)) as address:
            fuzzer.connect(address)
            try:
                for number in range(1, count + 1):
                    called, answered = fuzzer.call()
                    told.append(called)
                    counts[answered] += 1
                    if number % CHECKED_EVERY == 0 or number == count:
                        fuzzer.check()
                    if mishaps.texts:
                        raise Unfit(mishaps.texts[0])
            finally:
                fuzzer.close()
        outside = [path.name for path in folder.iterdir() if path.name != _SESSION]
        if outside:
            raise Unfit(f"{outside} were written outside the folder")
    except (Unfit, OSError) as error:
        last = "\n  ".join(told)
        raise Unfit(f"{emulator.vendor}, seed {seed}, call {sum(counts.values())}: {error!r}\n  {last}") from error
    finally:
        log.removeHandler(mishaps)
    return Outcome(counts[True], counts[False], counts[None])


class _Mishaps(logging.Handler):
    """Keeps the errors that an emulator logs: unexpected ones, since expected errors are answers."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.texts: list[str] = []
        self.setFormatter(logging.Formatter("%(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(self.format(record))
