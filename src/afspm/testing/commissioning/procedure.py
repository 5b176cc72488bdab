"""The procedure: steps in order, a report after each, and a safe state at every end."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from afspm.basics.errors import ConfigError
from afspm.driver import Driver
from afspm.experiment import Role
from afspm.experiment.tracing import trace_overlay
from afspm.model import ControlRequest, Parameter, Response, Scan, names
from afspm.testing.commissioning import maker_claims
from afspm.testing.commissioning.guide import Guide, Prompts
from afspm.testing.commissioning.maker_claims import MakerClaim
from afspm.testing.commissioning.progress import CommissioningProgress
from afspm.testing.commissioning.report import InstrumentReport, steps_of
from afspm.testing.commissioning.steps import WITHDRAWN, Reopened, all_steps, alone
from afspm.testing.conformance import CheckOutcome, CheckResult, Failed, Lost, Skipped, attempt, counted, mark
from afspm.testing.translators.client import value_in
from afspm.testing.translators.report import CheckReport
from afspm.testing.translators.runner import restored
from afspm.testing.translators.session import CheckOptions, CheckSession, opened, prepare
from afspm.translator.controller_lock import is_elsewhere

REHEARSAL_PATIENCE: Final = 10.0
"""Factor of the limits in real time with a simulated microscope: its program shares the computer with afspm, and a busy
computer must not look like a late controller."""
LINES_S: Final = 1.0
"""Experiment seconds between two readings of the lines of a running scan, unless the experiment file says otherwise."""
_NOT_WITHDRAWN = "THE TIP WAS NOT WITHDRAWN ({why}): withdraw it by hand, now."
_NEVER_SHOWN = "The tip was withdrawn. This controller does not show that: look."


@dataclass
class CommissioningResult:
    """The result of a commissioning.

    Attributes:
        progress: the steps.
        claims: the verdicts on the driver's claims, by id.
        file: the file of the report.
        lost: the reason of an early end; empty after all steps.
        folder: the run folder, with the log and the trace.
        scans: one scan in the air and one at the sample, all channels of each, as far as they were taken.
    """

    progress: CommissioningProgress
    file: Path
    lost: str = ""
    folder: Path = Path()
    claims: dict[str, str] = field(default_factory=dict)
    scans: dict[str, list[Scan]] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        return not self.lost and self.progress.passed


def commission(
    options: CheckOptions,
    prompts: Prompts,
    file: Path,
    tried_on: str,
    before: InstrumentReport | None = None,
    *,
    has_panel: bool | None = None,
    only: str = "",
) -> CommissioningResult:
    """Guide a person through all steps.

    Args:
        file: file for the report, written after each step.
        tried_on: see `TRIED_ON`.
        before: the report of an unfinished commissioning of the same controller, to continue.
        only: the name of a step to run alone, with the questions that it needs; empty: all steps.
        has_panel: False skips questions about the panel; None: a simulated microscope has no panel.

    Raises:
        ConfigError: the experiment file is wrong; nothing was started.
        KeyboardInterrupt: the scan was stopped, the tip withdrawn if it was in contact, and all settings restored.
    """
    steps = alone(only) if only else all_steps()
    result = CommissioningResult(CommissioningProgress.resumed(steps, before.results() if before else {}), file)
    result.claims = dict(before.claims) if before else {}
    for is_again in (False, True):
        try:
            with ExitStack() as stack:
                session = stack.enter_context(opened(_traced(options, stack)))
                result.folder = session.folder
                if has_panel is None:
                    has_panel = not session.simulated
                claims = maker_claims.read(session.driver_folder) if session.driver_folder else {}
                kept = result.claims
                settled = {name: one for name, one in claims.items() if one.step}
                result.claims = {name: kept.get(name, maker_claims.NOT_SHOWN) for name in settled}
                _in_session(session, prompts, result, tried_on, claims, has_panel=has_panel)
        except Lost as lost:
            if isinstance(lost, Reopened) and not is_again:
                prompts.show("  You have withdrawn the tip at the panel. afspm connects again, and goes on here.")
                continue
            result.lost = str(lost)
        break
    return result


def _in_session(
    session: CheckSession,
    prompts: Prompts,
    result: CommissioningResult,
    tried_on: str,
    claims: Mapping[str, MakerClaim],
    *,
    has_panel: bool,
) -> None:
    checks = CheckReport()
    checks.describe(session)

    def write() -> None:
        _report(session, checks, result, tried_on).write(result.file)

    try:
        with restored(session, checks) as kit:
            guide = Guide(
                kit,
                prompts,
                session.folder,
                has_panel=has_panel,
                has_tip=session.has_tip,
                has_lines=_interval_of_lines(session.options) is not None,
                program_s=session.program_s,
                counts_clockwise=session.counts_clockwise,
                approaches=session.simulated,
                is_remote=is_elsewhere(session.address),
                rows=session.rows,
                section=session.section,
                scans=result.scans,
                claims=claims,
            )
            walk = _Walk(guide, result, write)
            try:
                walk.through()
            finally:
                walk.withdraw()
                walk.show_unsettled()
    except Reopened:
        checks.unrestored = []  # no step before it sets anything, and without control nothing can be compared
        raise
    finally:
        write()
        for line in checks.unrestored:
            prompts.show(f"not put back: {line}")
        for line in counted(checks.complaints):
            prompts.show(f"logged: {line}")


class _Walk:
    """The run of all steps in order."""

    def __init__(self, guide: Guide, result: CommissioningResult, write: Callable[[], None]) -> None:
        self._guide = guide
        self._progress = result.progress
        self._claims = result.claims
        self._write = write
        self._unsettled: list[str] = []

    def through(self) -> None:
        """Run the remaining steps."""
        while (step := self._progress.next()) is not None:
            result = self._progress.results[step.name] = attempt(step, self._guide)
            symbol, _ = mark(result.outcome)
            named = "" if result.outcome in (CheckOutcome.PASSED, CheckOutcome.FAILED) else f" {result.outcome.value}:"
            self._guide.prompts.show(f"{symbol}{named} {step.title}: {result.line}")
            for line in result.complaints:
                self._guide.prompts.show(f"  {line}")
            self._settle(step.name)
            self._write()
            following = self._progress.next()
            if following is None or not following.contact:
                self.withdraw()

    def _settle(self, step: str) -> None:
        settled = maker_claims.verdicts(self._guide.claims, step, self._guide.seen, self._guide.unprepared)
        for name, verdict in settled.items():
            if verdict == maker_claims.NOT_SHOWN:  # a later step may show it still, such as the withdrawal
                self._unsettled.append(name)
            elif verdict != self._claims.get(name):
                self._claims[name] = verdict
                self._show(name)

    def show_unsettled(self) -> None:
        """Show the claims that the steps of this evening should have settled, and have not."""
        for name in dict.fromkeys(self._unsettled):
            if self._claims[name] == maker_claims.NOT_SHOWN:
                self._show(name)

    def _show(self, name: str) -> None:
        self._guide.prompts.show(f"  {self._claims[name]}: {self._guide.claims[name].claim} ({name})")

    def withdraw(self) -> None:
        """Withdraw a tip that was approached for these steps."""
        if not self._guide.in_contact:
            return
        self._guide.in_contact = False
        kit = self._guide.kit
        try:
            kit.client.come_to_rest()
            kit.act(names.RETRACT)
            kit.is_withdrawn = True
            kit.client.settled(kit.client.observations.mark())
            shown = kit.client.ask(ControlRequest.PARAM, Parameter(names.ENGAGED))
            if shown.ok:
                self._guide.seen[WITHDRAWN] = value_in(shown, names.ENGAGED).value == "false"
                self._settle(maker_claims.step_of(WITHDRAWN))
                _require_away(shown)
            self._guide.prompts.show("The tip was withdrawn." if shown.ok else _NEVER_SHOWN)
        except (Failed, Skipped, Lost) as error:
            self._guide.prompts.show(_NOT_WITHDRAWN.format(why=error))
            if kit.support.has(names.RETRACT):
                failed = CheckResult(names.RETRACT, "Withdrawing the tip", CheckOutcome.FAILED, str(error))
                self._progress.results[names.RETRACT] = failed
        self._write()


def _require_away(shown: Response) -> None:
    # the sign of z against the tip depends on the rig
    if value_in(shown, names.ENGAGED).value != "false":
        expected = f"{names.ENGAGED} false after {names.RETRACT}"
        came = "true: the tip is at the sample, or z counts the other way at this rig, and it never reads withdrawn"
        raise Failed(expected, came)


def _traced(options: CheckOptions, stack: ExitStack) -> CheckOptions:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    overlay = trace_overlay(prepare(options).resolved, folder)
    traced = options if overlay is None else replace(options, files=[*options.files, overlay])
    return _with_lines(_with_tip_away(traced, folder), folder)


def _with_tip_away(options: CheckOptions, folder: Path) -> CheckOptions:
    # a rehearsal begins as an evening does, unless its file says where the tip is
    resolved = prepare(options).resolved
    name = next((name for name in resolved.emulators if name not in options.without), "")
    abilities = resolved.with_role(Role.TRANSLATOR)[0].capabilities()
    shows_tip = abilities is not None and names.ENGAGED in abilities.parameters
    if not name or not shows_tip or "withdrawn" in resolved.processes[name].settings:
        return options
    overlay = folder / "withdrawn.toml"
    overlay.write_text(f"[{name}]\nwithdrawn = true\n", encoding="utf-8")
    return replace(options, files=[*options.files, overlay])


def _with_lines(options: CheckOptions, folder: Path) -> CheckOptions:
    (translator,) = prepare(options).resolved.with_role(Role.TRANSLATOR)
    driver = translator.component
    gives = driver is not None and issubclass(driver, Driver) and driver.lines is not Driver.lines
    if not gives or "live_lines_s" in translator.settings:
        return options
    overlay = folder / "lines.toml"
    overlay.write_text(f'[{translator.name}]\nlive_lines_s = "{LINES_S:g} s"\n', encoding="utf-8")
    watched = replace(options, files=[*options.files, overlay])
    try:
        prepare(watched)
    except ConfigError:  # a driver may need another setting for them
        return options
    return watched


def _interval_of_lines(options: CheckOptions) -> object:
    (translator,) = prepare(options).resolved.with_role(Role.TRANSLATOR)
    return translator.settings.get("live_lines_s", getattr(translator.component, "live_real_s", None)) or None


def _report(session: CheckSession, checks: CheckReport, result: CommissioningResult, tried_on: str) -> InstrumentReport:
    support = session.support
    lacking = [name for name, value in support.parameters.items() if value is None]
    lacking += [name for name, has in support.actions.items() if has is False]
    return InstrumentReport(
        maker=session.maker or "unknown",
        driver=session.translator,
        release=support.controller or "not reported",
        tried_on=tried_on,
        evidence="afspm commission",
        began=checks.began,
        afspm=checks.afspm,
        operations=result.progress.operations(),
        steps=steps_of(result.progress),
        claims=result.claims,
        unsupported=lacking,
        unrestored=checks.unrestored,
        logged=counted(checks.complaints),
    )
