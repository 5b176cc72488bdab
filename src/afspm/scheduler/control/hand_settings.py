"""The settings that a person leaves in force at the end of MANUAL mode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace
from afspm.model import Feedback, Parameter, Request

_FEEDBACK = {"on": "feedback", "proportional_gain": "P gain", "integral_gain": "I gain", "setpoint": "setpoint"}


@dataclass(frozen=True)
class HandSettings:
    """Settings that were changed in MANUAL mode: parameters by requests, the z feedback also at the panel.

    Attributes:
        parameters: value, with its unit, by name.
        before: the feedback in force when MANUAL began, and now.
    """

    parameters: Mapping[str, str] = field(default_factory=dict)
    before: Feedback | None = None
    now: Feedback | None = None

    def requested(self, request: Request) -> HandSettings:
        """Take a request that was carried out in MANUAL mode."""
        parameter = request.subject
        if not isinstance(parameter, Parameter) or parameter.value is None:
            return self
        value = f"{parameter.value} {parameter.unit or ''}".rstrip()
        return replace(self, parameters={**self.parameters, parameter.name: value})

    def published(self, feedback: Feedback, *, is_manual: bool) -> HandSettings:
        """Take the feedback that is in force."""
        return replace(self, now=feedback, before=self.before if is_manual and self.before else feedback)

    def handed_back(self) -> tuple[HandSettings, tuple[str, ...]]:
        """Return the settings that stay in force, in words; the mode is automated again."""
        told = [f"{name} = {value}" for name, value in self.parameters.items()]
        for name, word in _FEEDBACK.items():
            value = getattr(self.now, name, None)
            if value is not None and value != getattr(self.before, name, None):
                told.append(f"{word} = {value:g}" if name != "on" else f"{word} {'on' if value else 'off'}")
        return HandSettings(before=self.now, now=self.now), tuple(told)
