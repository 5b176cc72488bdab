"""The settings that checks and a commissioning put back at their end."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from afspm.model import ControlRequest, Feedback, Parameter, Response, names
from afspm.testing.translators.runner import SettingsBefore
from afspm.testing.translators.support import Support

VALUES = {names.FEEDBACK_ON: "true", names.TIP_BIAS_VOLTAGE: "0.5"}


class Controller:
    """A controller whose feedback was on, and is off now."""

    def __init__(self, engaged: str | None) -> None:
        self.engaged = engaged
        self.now = {**VALUES, names.FEEDBACK_ON: "false"}
        self.sent: list[object] = []
        newest = {Feedback: Feedback(on=False, setpoint=1e-10)}
        self.observations: Any = SimpleNamespace(newest=newest.get, mark=lambda: 0)

    def quiet(self) -> None: ...

    def come_to_rest(self) -> None: ...

    def settled(self, mark: int) -> None: ...

    def get(self, name: str) -> Parameter:
        return Parameter(name, self.engaged if name == names.ENGAGED else self.now[name])

    def set(self, name: str, value: str, unit: str | None) -> Response:
        self.sent.append((name, value))
        self.now[name] = value
        return Response(0)

    def ask(self, kind: ControlRequest, subject: object) -> Response:
        self.sent.append(subject)
        return Response(0)


@pytest.mark.parametrize(
    ("engaged", "is_away", "is_switched_on"),
    [("false", False, False), ("true", True, False), (None, True, False), ("true", False, True), (None, False, True)],
)
def test_feedback_stays_off_with_a_tip_that_was_withdrawn(
    engaged: str | None, is_away: bool, is_switched_on: bool
) -> None:
    client: Any = Controller(engaged)
    shown: dict[str, Parameter | None] = {} if engaged is None else {names.ENGAGED: Parameter(names.ENGAGED, engaged)}
    parameters = {name: Parameter(name, value) for name, value in VALUES.items()}
    support = Support({}, shown)
    before = SettingsBefore(None, Feedback(on=True, setpoint=2e-10), None, dict(parameters), support)
    client.now[names.TIP_BIAS_VOLTAGE] = "1"
    assert before.restore(client, is_away=is_away) == []
    assert (names.TIP_BIAS_VOLTAGE, "0.5") in client.sent
    assert ((names.FEEDBACK_ON, "true") in client.sent) is is_switched_on
    (feedback,) = [one for one in client.sent if isinstance(one, Feedback)]
    assert (feedback.on, feedback.setpoint) == (True if is_switched_on else None, 2e-10)


def test_feedback_that_was_off_is_not_switched_off_with_a_tip_at_the_sample() -> None:
    client: Any = Controller("true")
    client.now[names.FEEDBACK_ON] = "true"
    client.observations.newest = {Feedback: Feedback(on=True, setpoint=1e-10)}.get
    parameters: dict[str, Parameter] = {names.FEEDBACK_ON: Parameter(names.FEEDBACK_ON, "false")}
    support = Support({}, {names.ENGAGED: Parameter(names.ENGAGED, "true")})
    before = SettingsBefore(None, Feedback(on=False, setpoint=1e-10), None, parameters, support)
    assert before.restore(client) == []
    assert client.sent == []
