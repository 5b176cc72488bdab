"""A first contact with a controller: who answers, and with which settings, by questions alone.

The driver is a maker's shadow (`translator.shadow`): it has no function that sets or starts anything, and its link
sends nothing but questions.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import AfspmError, Refused
from afspm.basics.plain_data import Plain
from afspm.model import ScopeStatus, names
from afspm.translator.driver_base import LOST, DriverBase
from afspm.translator.parameters import ParameterSpec, Value
from afspm.translator.shadow import NotSent

MOST: Final = 5.0
"""The largest proposed setpoint, in times of the one in force."""
_LESS: Final = (4.0, 3.0, 2.0, 1.5, 1.0)


@dataclass(frozen=True)
class ParameterReading:
    """The answer to one question.

    Attributes:
        value: in the unit of `row`; None: there is none, see `fault`.
        took_s: real time.
        fault: why there is no value.
        was_asked: False for a question that the shadow does not send.
    """

    row: ParameterSpec
    value: Value | None
    took_s: float
    fault: str = ""
    was_asked: bool = True


@dataclass
class Contact:
    """The answers of a controller.

    Attributes:
        address: of the controller.
        logged: the log lines of the driver, with their levels: the release, the preamplifier, missing modules.
        connected_s: the real time until the driver was connected; None: it could not be, see `lost`.
        lost: why the controller did not answer, or no longer.
        status: its state; None: unknown.
        answers: by the generic names of parameters.
        reach: the range of the scanner, by the names of places.
        most_setpoint: the largest setpoint that the preamplifier reaches; None: at least `MOST` times the one in force.
    """

    address: str
    logged: list[tuple[int, str]] = field(default_factory=list)
    connected_s: float | None = None
    lost: Exception | None = None
    identity: str = ""
    status: ScopeStatus | None = None
    answers: dict[str, ParameterReading] = field(default_factory=dict)
    reach: Mapping[str, ParameterSpec] = field(default_factory=dict)
    most_setpoint: float | None = None


class _Kept(logging.Handler):
    def __init__(self, logged: list[tuple[int, str]]) -> None:
        super().__init__(logging.INFO)
        self._logged = logged

    def emit(self, record: logging.LogRecord) -> None:
        if (one := (record.levelno, record.getMessage())) not in self._logged:
            self._logged.append(one)


def contact(driver: DriverBase) -> Contact:
    """Connect, ask for the state and all parameters, each alone, and close the connection.

    Args:
        driver: one that `only_reads`.
    """
    assert driver.only_reads
    found, clock = Contact(driver.controller_at), ExperimentClock.real()
    log = logging.Logger("contact", logging.INFO)  # without parents: the lines are shown by the caller
    log.addHandler(_Kept(found.logged))
    memory: Plain = {}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        driver.clock, driver.log, driver.run_dir, driver.memory = clock, log, Path(folder), memory
        driver.wake = lambda: None
        began_s = clock.monotonic_s()
        try:
            driver.connect()
            found.connected_s = clock.monotonic_s() - began_s
            found.identity = driver.identity
            with suppress(NotSent):  # what only handlers in the controller show
                found.status = driver.status()
            for name, row in driver.table.items():
                found.answers[name] = _asked(driver, name, row, clock)
            found.reach = dict(driver.reach())
            found.most_setpoint = _most_setpoint(driver, found)
        except (*LOST, AfspmError) as error:
            found.lost = error
        finally:
            driver.close()
    return found


def _most_setpoint(driver: DriverBase, found: Contact) -> float | None:
    # by asking whether a setpoint would be refused: the driver knows the preamplifier, and nothing is set
    before = {name: one.value for name, one in found.answers.items() if one.value is not None}
    value = before.get(names.ZCTRL_SETPOINT)
    if not isinstance(value, float):
        return None
    for factor in (MOST, *_LESS):
        try:
            driver.refuse_unreachable({names.ZCTRL_SETPOINT: factor * value}, before)
        except Refused:
            continue
        return None if factor == MOST else factor * value
    return None


def _asked(driver: DriverBase, name: str, row: ParameterSpec, clock: ExperimentClock) -> ParameterReading:
    began_s = clock.monotonic_s()
    value: Value | None = None
    fault, was_asked = "", True
    try:
        value = driver.in_force([name])[name]
    except LOST:
        raise
    except Exception as error:  # of a driver, which may raise anything: the fault is shown
        fault, was_asked = str(error), not isinstance(error, NotSent)
    return ParameterReading(row, value, clock.monotonic_s() - began_s, fault, was_asked)
