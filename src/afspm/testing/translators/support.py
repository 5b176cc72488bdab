"""The generic actions and parameters that a microscope supports, queried over the wire."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from afspm.model import ControlRequest, ControlResponse, Parameter, names
from afspm.testing.conformance import Failed
from afspm.testing.translators.client import CheckClient, answer_in_words, value_in

ACTIONS = names.BASE_ACTIONS + names.EXTENSION_ACTIONS
PARAMETERS = (*names.BASE_PARAMETERS, *names.EXTENSION_PARAMETERS, names.DRIFT_RATE_X, names.DRIFT_RATE_Y)


@dataclass
class Support:
    """The supported actions and parameters, by generic name.

    Attributes:
        actions: True for a supported action; None if the microscope does not report its support.
        parameters: the initial value of a parameter; None for an unsupported parameter.
        errors: errors in the answers.
        settable: True if a check could set the parameter; None if not tested.
    """

    actions: dict[str, bool | None] = field(default_factory=dict)
    parameters: dict[str, Parameter | None] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    settable: dict[str, bool | None] = field(default_factory=dict)

    def ask_again(self, client: CheckClient) -> None:
        """Read the controller's version again: some controllers report it in their files only."""
        if self.parameters.get(names.CONTROLLER) is not None:
            self.parameters[names.CONTROLLER] = _value(client, names.CONTROLLER, self.errors)

    def missing(self, needs: Iterable[str]) -> list[str]:
        """Return the names in `needs` that the microscope does not support."""
        known = {**self.parameters, **{name: has or has is None for name, has in self.actions.items()}}
        return [name for name in needs if not known.get(name)]

    def has(self, *wanted: str) -> bool:
        """Return whether the microscope supports all these names."""
        return not self.missing(wanted)

    @property
    def controller(self) -> str:
        """The controller's name and version, as reported."""
        reported = self.parameters.get(names.CONTROLLER)
        return "" if reported is None else str(reported.value)


def find_out(client: CheckClient, actions: Iterable[str] = (), parameters: Iterable[str] = ()) -> Support:
    """Query the support of all generic names and of the microscope's own names."""
    # There is no request for a table: published translators answer single queries too, and a query changes nothing.
    found = Support()
    for name in dict.fromkeys((*ACTIONS, *actions)):
        found.actions[name] = _has_action(client, name, found.errors)
    for name in dict.fromkeys((*PARAMETERS, *parameters)):
        found.parameters[name] = _value(client, name, found.errors)
        found.settable[name] = None
    return found


def _has_action(client: CheckClient, name: str, errors: list[str]) -> bool | None:
    response = client.ask(ControlRequest.ACTION_SUPPORT, name)
    if response.code == ControlResponse.CMD_NOT_SUPPORTED:
        return None
    if not response.ok and response.code != ControlResponse.ACTION_NOT_SUPPORTED:
        expected = f"REP_SUCCESS or REP_ACTION_NOT_SUPPORTED to asking for {name}"
        errors.append(str(Failed(expected, answer_in_words(response))))
    return response.ok


def _value(client: CheckClient, name: str, errors: list[str]) -> Parameter | None:
    response = client.ask(ControlRequest.PARAM, Parameter(name))
    if response.code in (ControlResponse.PARAM_NOT_SUPPORTED, ControlResponse.CMD_NOT_SUPPORTED):
        return None
    try:
        if not response.ok:
            expected = f"REP_SUCCESS or REP_PARAM_NOT_SUPPORTED to getting {name}"
            raise Failed(expected, answer_in_words(response))
        return value_in(response, name)
    except Failed as failure:
        errors.append(str(failure))
        return None
