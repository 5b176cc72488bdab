"""What `afspm doctor` says of a contact with a controller, and the class that only reads it."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping

from afspm.basics.errors import AfspmError
from afspm.basics.formatting import quantity
from afspm.experiment import class_loader
from afspm.model import names
from afspm.translator.contact import Contact, contact
from afspm.translator.controller_lock import ControllerTaken, commanding
from afspm.translator.driver_base import DriverBase
from afspm.translator.parameters import ParameterSpec, Value
from afspm.transport import diagnosis
from afspm.transport.diagnosis import Diagnosis, Severity

SHOWN = (
    *(names.TIP_BIAS_VOLTAGE, names.SAMPLE_BIAS, names.ZCTRL_SETPOINT, names.FEEDBACK_ON, names.ENGAGED, names.CURRENT),
    *(names.TIP_Z, names.SAFE_TIP_ON, names.SAFE_TIP_THRESHOLD, "scan-size-x", "scan-size-y", "scan-angle"),
    names.SCAN_SPEED,
)
"""The parameters that a person compares with the panel; `--all` shows all of them."""


def asked(
    kind: type[DriverBase], settings: Mapping[str, object], *, everything: bool = False
) -> tuple[Contact | None, list[Diagnosis]]:
    """Ask a controller by the shadow of its driver.

    Args:
        everything: whether there is a diagnosis of each parameter.

    Returns:
        the answers, None if the controller was not asked; the diagnoses, with the reason then.
    """
    if not kind.shadow:
        what = f"{kind.__name__} has no shadow, a driver that only reads: its controller is not asked"
        return None, [Diagnosis("controller", Severity.WARNING, kind.__name__, what, "see docs/how-to/shadow.md")]
    try:
        driver = class_loader.load(kind.shadow).once(**settings)
    except AfspmError as error:
        what = f"its controller is not asked: {error.what}"
        return None, [Diagnosis("controller", Severity.WARNING, kind.__name__, what, error.hint)]
    at = driver.controller_at
    try:
        with commanding(at, "afspm doctor"):
            found = contact(driver)
    except ControllerTaken as taken:
        return None, [diagnosis.fine("controller", at, f"it is not asked: {taken.what}")]
    return found, [*told(found, everything=everything)]


def text_of(row: ParameterSpec, value: Value) -> str:
    """Return a value in SI with a prefixed unit."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return quantity(value, row.si_unit) if isinstance(value, float) and row.si_unit else row.quantity(value)


def told(found: Contact, *, everything: bool = False) -> Iterator[Diagnosis]:
    """Yield a line for each answer, and each fault with its remedy."""
    at = found.address
    if found.connected_s is not None:
        state = "" if found.status is None else f"; its state is {found.status.state.name}"
        yield diagnosis.fine("controller", at, f"answers, after {found.connected_s:.2g} s{state}")
    for level, text in found.logged:
        severity = Severity.FINE if level < logging.WARNING else Severity.WARNING
        what, _, remedy = text.partition("; ")
        yield Diagnosis("controller", severity, at, what, remedy)
    if found.identity:
        yield diagnosis.fine("files", at, found.identity)
    for name, spec in found.reach.items():
        if spec.range is not None:
            low, high = (text_of(spec, end) for end in spec.range)
            yield diagnosis.fine("range", name, f"{low} to {high}")
    asked_names = [name for name, one in found.answers.items() if one.was_asked]
    for name in asked_names:
        one = found.answers[name]
        if one.value is None:
            yield Diagnosis("reading", Severity.WARNING, name, f"can't be read: {one.fault}")
        elif everything or name in SHOWN:
            yield diagnosis.fine("reading", name, f"{text_of(one.row, one.value)} ({1000 * one.took_s:.0f} ms)")
    took_s = sum(one.took_s for one in found.answers.values())
    left = len(found.answers) - len(asked_names)
    if found.answers:
        rest = f", and {left} are left out, which a reader beside a run does not ask" if left else ""
        hint = "" if everything else " (`--all` shows each)"
        yield diagnosis.fine("reading", at, f"{len(asked_names)} parameters were read in {took_s:.2g} s{hint}{rest}")
    if found.lost is not None:
        error = found.lost
        what = error.what if isinstance(error, AfspmError) else str(error)
        remedy = error.hint if isinstance(error, AfspmError) else ""
        begun = "no contact" if found.connected_s is None else "the contact was lost"
        yield Diagnosis("controller", Severity.ERROR, at, f"{begun}: {what}", remedy)
