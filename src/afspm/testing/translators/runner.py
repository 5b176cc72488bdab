"""Run of all checks in order, followed by the restoration of every setting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from afspm.model import ControlRequest, Feedback, Parameter, ProbePosition, Region, ScanParameters, names
from afspm.testing.conformance import CheckResult, Failed, Lost, near
from afspm.testing.translators.client import CheckClient, answer_in_words
from afspm.testing.translators.measuring import CheckMeasurements, FrameSetting, number
from afspm.testing.translators.report import CheckReport
from afspm.testing.translators.session import CheckOptions, CheckSession, opened
from afspm.testing.translators.support import Support
from afspm.testing.translators.translator_suite import TRANSLATOR_SUITE

_LAST = (names.SCAN_SPEED, names.MOVE_SPEED)
"""Settings restored last, since a change of the frame may change them."""
_REPORTED = (
    names.CONTROLLER, names.SAFE_TIP_ON, names.SAFE_TIP_THRESHOLD, names.TIP_Z, names.CURRENT, names.FREQUENCY_SHIFT,
    names.Z_IS_HELD, names.ENGAGED,
)  # fmt: skip
"""Parameters that are measured, or that a person may change meanwhile: no request can set them."""


@dataclass(frozen=True)
class SettingsBefore:
    """The settings before the checks."""

    frame: ScanParameters | None
    feedback: Feedback | None
    probe: ProbePosition | None
    parameters: dict[str, Parameter]
    support: Support

    @classmethod
    def of(cls, client: CheckClient, support: Support) -> SettingsBefore:
        """Return the newest published settings, and the parameter values queried at the start of the session."""
        return cls(
            client.observations.newest(ScanParameters),
            client.observations.newest(Feedback),
            client.observations.newest(ProbePosition),
            {name: value for name, value in support.parameters.items() if value and name not in _REPORTED},
            support,
        )

    def restore(self, client: CheckClient, *, is_away: bool = False) -> list[str]:
        """Stop a running scan or spectrum, and restore all settings.

        The feedback is switched on at most, never off: without it a tip at the sample is in danger. With a tip that is
        away it is left as it is: switched on, it would bring the tip to the sample again.

        Args:
            is_away: whether the tip was withdrawn; otherwise the controller is asked.

        Returns:
            the failures, one per line.
        """
        wrong: list[str] = []
        try:
            client.quiet()
            client.come_to_rest()
            is_away = is_away or (self.support.has(names.ENGAGED) and client.get(names.ENGAGED).value == "false")
            was_on = self.parameters.get(names.FEEDBACK_ON)
            switches_on = not is_away and was_on is not None and was_on.value == "true"
            self._put_back_together(client, wrong, is_away=is_away)
            ordered = sorted(self.parameters, key=lambda name: name in _LAST)
            for name in ordered:
                if name != names.FEEDBACK_ON or switches_on:
                    self._put_back(client, name, wrong)
        # listed in the report instead of raised: the results of the checks must not get lost
        except (Lost, Failed) as error:
            wrong.append(str(error))
        return wrong

    def _put_back_together(self, client: CheckClient, wrong: list[str], *, is_away: bool) -> None:
        # settings of one packet are restored in one request: one by one, they would pass through invalid combinations
        observations = client.observations
        feedback, in_force = self.feedback, observations.newest(Feedback)
        if feedback is not None and (is_away or not feedback.on):
            feedback = replace(feedback, on=None if in_force is None else in_force.on)
        settings = (
            (ControlRequest.SET_SCAN_PARAMS, observations.newest(ScanParameters), self.frame, self._frame()),
            (
                ControlRequest.SET_ZCTRL_PARAMS,
                in_force,
                feedback,
                _changed(feedback, in_force),
            ),
            (ControlRequest.SET_PROBE_POS, observations.newest(ProbePosition), self.probe, self.probe),
        )
        for kind, now, before, subject in settings:
            if before is not None and now != before:
                mark = client.observations.mark()
                response = client.ask(kind, subject)
                if not response.ok:
                    wrong.append(f"REQ_{kind.name}: {answer_in_words(response)}")
                client.settled(mark)

    def _frame(self) -> ScanParameters | None:
        before = self.frame
        if before is not None and isinstance(before.region, Region) and isinstance(before.shape, tuple):
            return FrameSetting(before.region, before.shape).request(self.support)
        return before

    def _put_back(self, client: CheckClient, name: str, wrong: list[str]) -> None:
        before, now = self.parameters[name], client.get(name)
        if _same(before, now):
            return
        mark = client.observations.mark()
        response = client.set(name, str(before.value), before.unit)
        client.settled(mark)
        if not (response.ok and _same(before, client.get(name))):
            was = f"{before.value} {before.unit or ''}".strip()
            wrong.append(f"{name} was {was}, and is {now.value}: {answer_in_words(response)}")


def _changed(before: Feedback | None, now: Feedback | None) -> Feedback:
    # only changed fields: some are read-only
    fields = {} if before is None else vars(before)
    return Feedback(**{name: value for name, value in fields.items() if now is None or value != getattr(now, name)})


def _same(before: Parameter, now: Parameter) -> bool:
    if before.value == now.value and before.unit == now.unit:
        return True
    try:
        return near(number(before, before.unit or ""), number(now, before.unit or ""), 1e-6)
    except Failed:
        return False


@contextmanager
def restored(session: CheckSession, report: CheckReport) -> Iterator[CheckMeasurements]:
    """Restore the settings at the end of the `with` block, even after an error."""
    kit = CheckMeasurements(
        session.client, session.support, session.options.frame_m, excused=session.excused, complaints=session.complaints
    )
    before = SettingsBefore.of(session.client, session.support)

    def take_again() -> None:
        nonlocal before
        now = SettingsBefore.of(session.client, session.support)
        before = replace(now, parameters={name: session.client.get(name) for name in now.parameters})

    kit.set_by_hand = take_again
    try:
        yield kit
    finally:
        report.unrestored = before.restore(session.client, is_away=kit.is_withdrawn)


def run(
    options: CheckOptions,
    begun: Callable[[CheckReport], None] = lambda report: None,
    done: Callable[[CheckResult], None] = lambda result: None,
) -> CheckReport:
    """Run the selected checks, restore the settings, and write `report.json` into the run's folder.

    Args:
        begun: called with the report before the first check.
        done: called with each result.

    Raises:
        ConfigError: the experiment file or the options are wrong; nothing was started.
        KeyboardInterrupt: after all settings were restored and the report of finished checks was written.
    """
    checks = TRANSLATOR_SUITE.checks(options.only)
    report = CheckReport()
    with report.written(), opened(options) as session:
        report.describe(session)
        begun(report)
        with restored(session, report) as kit:
            report.run(checks, kit, done)
            # after the scans, since some controllers report their version in their files only
            session.support.ask_again(session.client)
    return report
