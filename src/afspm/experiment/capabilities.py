"""Capabilities of a microscope, as far as they are known from its class before the microscope runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from afspm.basics.errors import AfspmError, InvalidValue, Refused
from afspm.experiment.toml_lines import Table
from afspm.model import ChannelRoles, Parameter, Region, names
from afspm.model.bias import BiasReference

if TYPE_CHECKING:
    from afspm.translator.driver import Driver
    from afspm.translator.driver_base import CoarseMove
    from afspm.translator.parameters import ParameterTable, Value


@dataclass(frozen=True)
class MicroscopeCapabilities:
    """Actions and parameters of a microscope, by their generic names.

    Attributes:
        parameters: SI unit of each parameter; None: the unit depends on the operating mode.
        sets: parameters that an action of the experiment file sets, by the action's name.
        table: the microscope's parameter table.
        max_pixels: the largest number of pixels of a scan.
        channels: the channels that the microscope may have, by their roles.
        never_withdrawn: actions that need a withdrawn tip, if the microscope never shows the tip.
        bias: the reference of the bias.
        coarse: the moves of actions that move the coarse motor, by the action's name.
        refused_commands: the reasons and remedies why the microscope refuses commands, by the action's name.
    """

    actions: frozenset[str]
    parameters: Mapping[str, str | None]
    sets: Mapping[str, tuple[Parameter, ...]]
    table: ParameterTable
    channels: ChannelRoles
    max_pixels: int
    bias: BiasReference
    never_withdrawn: tuple[str, ...] = ()
    coarse: Mapping[str, CoarseMove] = field(default_factory=dict)
    refused_commands: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    def refuses(self, parameter: Parameter) -> str:
        """Return the reason of the microscope to refuse a value; empty for a valid value or an unknown parameter."""
        if parameter.name not in self.table or parameter.value is None:
            return ""
        try:
            self.table[parameter.name].parse(parameter.value, parameter.unit)
        except Refused as refused:
            return refused.reason
        return ""

    def refuses_frame(self, region: Region, shape: tuple[int, int]) -> str:
        """Return the reason of the microscope to refuse a frame as a whole; empty for a frame that it can scan.

        A range that only the controller knows, or a setting in force, may forbid the frame later on.
        """
        from afspm.translator.setting_groups import check_together, frame_values, reach_in

        try:
            check_together(frame_values(region, shape), reach_in(self.table), self.max_pixels)
        except Refused as refused:
            return refused.reason
        return ""


def of_class(microscope: type, settings: Table) -> MicroscopeCapabilities | None:
    """Return the capabilities of a `Driver` class with these settings; None if they are not known before the start."""
    from afspm.translator.driver import Driver
    from afspm.translator.driver_base import CoarseMove

    if not issubclass(microscope, Driver):
        return None
    # components beside a shadow are checked as in a run, although none of their requests is sent
    acting = getattr(microscope, "watches", microscope)
    marks = [
        mark for name in dir(acting) if (mark := getattr(getattr(acting, name), "_afspm_action", None)) is not None
    ]
    added = settings.get("actions") or {}
    actions = {mark.name for mark in marks} | set(added)
    coarse = {mark.name: CoarseMove() for mark in marks if mark.needs_withdrawn}
    moves = {name: acting.coarse_move(what) for name, what in added.items() if isinstance(what, Mapping)}
    coarse |= {name: move for name, move in moves.items() if move is not None}
    if acting.holds_z():
        actions |= {*names.OF_HELD_Z_ACTIONS}
    try:
        channels = microscope.channels_of(settings)
        table = microscope.parameter_table(microscope.rows(settings))
        commanded, refused = _commanded_by(microscope, added, table)
        sets = {name: (*_set_by(what, table), *commanded.get(name, ())) for name, what in added.items()}
        never = microscope.never_withdrawn(settings)
        bias = microscope.bias_of(settings, table)
    except (AfspmError, AttributeError):
        return None  # the check of its settings reports the error in the table
    units = {name: table[name].si_unit for name in table}
    most = acting.max_pixels
    return MicroscopeCapabilities(frozenset(actions), units, sets, table, channels, most, bias, never, coarse, refused)


def bias_given(settings: Table) -> BiasReference:
    """Return the reference of the bias in the file, for a microscope of unknown capabilities."""
    given = settings.get("bias_reference")
    return BiasReference(given, may_have_second=True) if given in ("sample", "tip") else BiasReference()


def _set_by(action: object, table: ParameterTable) -> tuple[Parameter, ...]:
    given = action.get("set") if isinstance(action, Mapping) else None
    values = table.written(given, where="actions") if isinstance(given, Mapping) else {}
    return _parameters(values.items(), table)


def _commanded_by(
    microscope: type[Driver], added: Table, table: ParameterTable
) -> tuple[dict[str, tuple[Parameter, ...]], dict[str, tuple[str, str]]]:
    commanded, refused = {}, {}
    for name, action in added.items():
        try:
            values = microscope.values_commanded(action, table) if isinstance(action, Mapping) else ()
            commanded[name] = _parameters(values, table)
        except (InvalidValue, Refused) as error:
            refused[name] = (error.what, error.hint)
    return commanded, refused


def _parameters(values: Iterable[tuple[str, Value]], table: ParameterTable) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, str(value), table[name].si_unit or None) for name, value in values)


def base() -> dict[str, str | None]:
    """Return the base parameters and afspm's extensions with SI units, for a microscope of unknown capabilities."""
    ours = {
        names.PULSE_VOLTAGE: "V",
        names.PULSE_DURATION: "s",
        names.CRASH_SPEED: "m/s",
        names.CRASH_DEPTH: "m",
        names.SPEC_KIND: None,
        **names.OF_CURVES,
        **names.OF_HELD_Z,
        # without a unit at most makers; a limit with another one is an error, rather than never compared
        **dict.fromkeys((names.ZCTRL_PGAIN, names.ZCTRL_IGAIN), ""),
    }
    return {**names.BASE_PARAMETERS, **ours}
