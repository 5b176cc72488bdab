"""`DriverBase`: the interface between the translator and a maker's driver. `Driver` adds the process around it."""

from __future__ import annotations

import logging
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal, Protocol, TypeVar

from afspm.basics.clock import Clock
from afspm.basics.errors import AfspmError, ConfigError, ErrorCollector, InvalidValue, Refused
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.basics.units import Duration, PollPeriod
from afspm.model import ChannelRoles, ControlResponse, Scan, ScanLines, ScopeState, ScopeStatus, Spectrum, names
from afspm.model.bias import BiasOf, BiasReference
from afspm.model.state import MEASURING
from afspm.model.variables import VariableRoles
from afspm.translator.judge import WITNESSES, Stated
from afspm.translator.parameters import ParameterSpec, ParameterTable, Value
from afspm.translator.polling import EAGER_S
from afspm.translator.setting_groups import HeldZSettings, SettingsGroup, reach_in

T = TypeVar("T")


class ControllerLost(AfspmError):
    """The error that the controller is unreachable: the translator refuses requests for this reason and reconnects."""

    code = "controller-lost"


class ControllerSilent(ControllerLost):
    """The error that the controller has accepted a connection, and does not answer."""


def connected(link: T | None, program: str, address: str = "") -> T:
    """Return the connection to a maker's program.

    Raises:
        ControllerLost: the connection is None.
    """
    if link is None:
        raise ControllerLost(f"{program} is not connected", where=address)
    return link


LOST = (ControllerLost, ConnectionError, TimeoutError)
"""The errors of a lost controller, as opposed to errors of a refusal."""


@dataclass(frozen=True)
class Action:
    """A generic action of a microscope.

    Attributes:
        name: the generic name, e.g. "start-scan".
        do: starts the action and returns at once; `Driver.status` shows its effect.
        state: the state of the microscope after the action is accepted, until `status` reports another; None: none
            is published.
        while_busy: True if the action is accepted even while the microscope is not free.
        interrupts: the states that the action interrupts.
        switches_feedback: True if the action may switch the z feedback on or off by itself, and leave it so.
        needs_withdrawn: True if the action is refused unless `x-engaged` shows a withdrawn tip.
    """

    name: str
    do: Callable[[], None]
    state: ScopeState | None = None
    while_busy: bool = False
    interrupts: frozenset[ScopeState] = frozenset()
    switches_feedback: bool = False
    needs_withdrawn: bool = False

    @property
    def only_stops(self) -> bool:
        """True if the action does nothing unless its measurement is running."""
        return self.name in (names.STOP_SCAN, names.STOP_SPEC)


_HELD_Z_ROWS: Final[Mapping[str, Mapping[str, object]]] = {
    names.HELD_Z_OFFSET: {"unit": "m", "range": ["-10 nm", "1 um"]},
    names.HELD_Z_SPEED: {"unit": "m/s", "range": ["1 pm/s", "100 nm/s"]},
    names.HELD_Z_ABORT_CURRENT: {"unit": "A", "range": [0, "1 mA"]},
    names.HELD_Z_ABORT_SHIFT: {"unit": "Hz", "range": [0, "1 MHz"]},
    names.Z_IS_HELD: {"type": "bool", "read_only": True},
}


@dataclass(frozen=True)
class CoarseMove:
    """A move of the coarse motor or stage by a command, as far as the command shows it.

    Attributes:
        direction: the maker's name of the direction; empty if unknown.
        is_lateral: whether it is along the sample; None if unknown.
        steps: the number of steps; None if unknown.
    """

    direction: str = ""
    is_lateral: bool | None = None
    steps: int | None = None


def _not_implemented() -> None:
    raise NotImplementedError


def _prove_nothing() -> None:
    # a real controller is the one at its address
    ...


_KNOWN = {
    action.name: action
    for action in (
        Action(names.START_SCAN, _not_implemented, ScopeState.SCANNING),
        Action(names.START_SPEC, _not_implemented, ScopeState.SPEC),
        Action(names.STOP_SCAN, _not_implemented, None, while_busy=True, interrupts=frozenset({ScopeState.SCANNING})),
        Action(names.STOP_SPEC, _not_implemented, None, while_busy=True, interrupts=frozenset({ScopeState.SPEC})),
        # a retract must be possible at any time
        Action(names.RETRACT, _not_implemented, None, while_busy=True, interrupts=MEASURING),
    )
}

Method = TypeVar("Method", bound=Callable[[Any], None])


def action(
    name: str,
    *,
    state: ScopeState | None = None,
    while_busy: bool | None = None,
    switches_feedback: bool = False,
    is_coarse: bool = False,
) -> Callable[[Method], Method]:
    """Mark a method of a `Driver` as the generic action `name`.

    Args:
        state: the state of the microscope after the action is accepted; None: as for the base action of this name, or
            unchanged for other actions.
        while_busy: True if the action is accepted even while the microscope is not free; None: as for the base action
            of this name, or False for other actions.
        switches_feedback: True if the action may switch the z feedback by itself, and leave it so: its state
            after it counts as wished. Otherwise a feedback found off is a person's doing.
        is_coarse: True if the action moves the coarse motor: it needs a withdrawn tip, and a mover in the experiment
            file.
    """
    known = _KNOWN.get(name, Action(name, _not_implemented))
    mark = replace(
        known,
        state=known.state if state is None else state,
        while_busy=known.while_busy if while_busy is None else while_busy,
        switches_feedback=switches_feedback,
        needs_withdrawn=is_coarse,
    )

    def marked(method: Method) -> Method:
        method._afspm_action = mark  # type: ignore[attr-defined]
        return method

    return marked


class Introduction(Protocol):
    """The authentication at the start of a connection; not traced, since it proves a secret.

    Attributes:
        is_over: True once both sides have proven that they know the secret.
    """

    is_over: bool

    def reply_to(self, line: bytes) -> str:
        """Return the controller's answer to a line; empty to disconnect."""


ThroughZero = Literal["jump", "hold", "refuse"]


@dataclass(frozen=True)
class CommonSettings:
    """The settings that every driver takes: see `DriverBase`."""

    actions: PlainMapping
    poll_period_s: float
    result_timeout_s: float
    live_lines_s: float | None
    trace: bool
    settle_before_scan_s: float
    bias_through_zero: ThroughZero


class DriverBase(ABC):
    """A microscope behind its controller. Write the abstract methods and an `@action` for each action::

        class Mine(Driver):
            def __init__(self, *, address: str = "127.0.0.1:1234"): super().__init__(); self.controller_at = address
            def connect(self): self.link = Link(self.controller_at); self.prove()
            def status(self): return ScopeStatus(ScopeState.SCANNING if self.link.busy() else ScopeState.FREE)
            def get(self, vendor): return self.link.read(vendor)
            def set(self, values): self.link.write(values)
            def results(self): return sorted(self.folder.glob("*.dat"))
            def load(self, result): return read_dat(result)

            @action(names.START_SCAN)
            def start_scan(self): self.link.send("scan")

    and beside it `parameters.toml`, the table of parameters by their generic names. All methods are called from one
    thread and must return soon: a method starts a long activity, and `status` shows its end. An exception becomes the
    response to the request, with its text as the reason.

    Args:
        parameters: rows added to the table or changed in it by the experiment file.
        channels: names of channels by role, in place of those in `channel_roles`, and under "other" those without one;
            a role of curves, such as force, comes before those in `variable_roles`.
        actions: generic actions added by the experiment file: `{name = {set = {<parameter> = <value>}}}` sets
            parameters, `{name = {command = "<text>"}}` sends a text to the controller (`command`); an action may have
            both keys. With `for = "50 ms"` the microscope is busy for this time, and then the former values are
            restored. An action that may leave the z feedback switched says `switches_feedback = true`; one that would
            break a tip at the sample says `withdrawn = true`.
        poll_period_s: time between two polls of the controller while nothing is due, in real seconds; the state is read
            more often when a measurement is about to end, as learned from earlier measurements.
        result_timeout_s: longest time from the end of a scan or spectrum to its complete file, in experiment seconds;
            at least twice `program_s` of real time.
        live_lines_s: time between two publications of a running scan's lines, in experiment seconds; 0: never; None: by
            `live_real_s`.
        bias_reference: the electrode whose bias is the number at the panel (`tip-bias-voltage`), where that depends on
            the wiring: "sample" or "tip". With it there is the parameter `sample-bias`.
        settle_before_scan_s: wait after a request that moves the frame, in experiment seconds: the microscope counts as
            moving until the scanner has settled, so that no scan begins.
        bias_through_zero: what follows where a request lets the bias change its sign at the sample, with a feedback on
            a current: "jump": it is set; "hold": z is held without feedback for it, since the feedback drives the tip
            towards the sample near 0 V; "refuse": it is refused.
        trace: record all exchanges with the controller in `controller.trace.jsonl` of the run's folder.

    Attributes:
        clock, log: of the experiment; set before `connect`.
        run_dir: the folder of this run.
        wake: makes the translator poll the controller now; may be called from any thread.
        for_a_while: sets parameters by their generic names, in SI, and restores them after a time in experiment
            seconds: for actions that consist of settings. The microscope is busy meanwhile.
        adjustable: parameters that may be set during a scan, even where a row forbids it: [control] adjustable.
        controller_at: the address of the controller. The constructor sets it and `connect` reads it, since an
            experiment with an emulator puts the emulator's address there. Only one run at a time commands it. Empty:
            other processes can't reach the controller.
        identity: words that distinguish the controller from others of this computer, such as its session's folder.
            `connect` sets them, if one controller may have several addresses.
        prove: call it in `connect` once the connection is made, before the first question: it raises ControllerLost if
            an emulated controller does not belong to this run.
        groups: the parameters that the controller has in a form that a table can't describe.
        lacking: actions that this controller turned out not to have, with the reason; set it when connecting.
        memory: a dict of JSON values, saved with every executed request and every result, and restored after a restart.
        channels: the channels that the microscope may have, by their roles.
        bias: the reference of the bias.
        common: the settings above except `parameters` and `channels`, as given.
    """

    parameters_file: ClassVar[Path]
    limits_file: ClassVar[Path | None] = None
    """A file with default limits for this model of microscope, in the form of [limits]; None: there are none."""
    channel_roles: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({})
    """The maker's names of channels by role, as in `Scan.channel`; under "other" those without a role."""
    variable_roles: ClassVar[VariableRoles | None] = None
    """The maker's names of the variables of curves by role; None: found by names that makers are known to use."""
    bias_reference: ClassVar[BiasOf] = ""
    """The electrode whose bias is the number at the maker's panel, if the maker says so; empty if it does not, or if
    that depends on the wiring."""
    translated: ClassVar[Collection[str]] = ()
    """The parameters that `read` and `write` of the class translate, rather than `get` and `set` by a row."""
    eager_poll_s: ClassVar[float] = EAGER_S
    """Real seconds between two polls when a scan may end at any moment."""
    max_pixels: ClassVar[int] = 4096 * 4096
    live_real_s: ClassVar[float | None] = None
    """Real seconds between publications of a running scan's lines if `live_lines_s` is not given; None: never."""
    maker: ClassVar[str] = ""
    """The company or project that makes the controller, for the files of a run."""
    software: ClassVar[str] = ""
    """The controller's program, for the files of a run."""
    counts_clockwise: ClassVar[bool] = False
    """True if the controller's panel shows angles clockwise; afspm's are counter-clockwise."""
    simulated: ClassVar[bool] = False
    """True if no real tip can break, so that the experiment's clock may differ from real time."""
    memory_is_all: ClassVar[bool] = False
    """True if all state of the (simulated) microscope is in `memory`: an action missing there was not executed."""

    shadow: ClassVar[str] = ""
    """The class that only reads this controller, "package.module.Class" (see `shadow`); empty: there is none."""

    has_tip: ClassVar[bool] = True
    """False for a microscope that scans by a beam: before a check or a commissioning, nothing is asked about a tip."""

    never_shows: ClassVar[Mapping[str, str] | None] = None
    """The witnesses of a measurement (`WITNESSES`) that the controller never shows, with the reasons, except those
    that are parameters, which the table has or lacks. None: the driver does not say."""

    coarse_commands: ClassVar[str] = ""
    """A regular expression, found in each command as text that moves the coarse motor or stage: such an action of the
    experiment file needs a withdrawn tip, whether or not the file says so. Empty: no such command is known."""

    start_engages: ClassVar[bool] = False
    """True if the start of a scan brings a withdrawn tip to the sample."""

    settles_s: ClassVar[float] = 0.5
    """Experiment seconds after a spectrum or an action in which the controller may still hold the z feedback, or values
    that it changed by itself: a reading within them proves nothing."""

    leaves_tip_s: ClassVar[float] = 0.0
    """Experiment seconds after a scan in which a moved tip is no act by hand, for a controller that shows late where a
    scan has left the tip."""

    cant_hold_z: ClassVar[str] = "its driver knows no documented function that sets z while the feedback is off"
    """Why z can't be held, where `move_z` is not overridden."""

    only_reads: ClassVar[bool] = False
    """True for a shadow, which only reads the controller."""

    asks_once: ClassVar[bool] = False
    """True for a shadow that only asks, and need not see when measurements begin and end."""

    program_s: ClassVar[float] = 0.0
    """Real seconds that the controller's program may need for work beside measuring, such as saving a file. They do not
    depend on the speed of the experiment's clock."""

    clock: Clock
    log: logging.Logger
    run_dir: Path
    wake: Callable[[], None]
    for_a_while: Callable[[Mapping[str, Value], float], None]
    controller_at: str = ""
    identity: str = ""
    lacking: Mapping[str, str] = MappingProxyType({})
    groups: Sequence[SettingsGroup] = ()
    memory: Plain

    def __init__(
        self,
        *,
        parameters: Mapping[str, Mapping[str, object]] | None = None,
        channels: Mapping[str, str | list[str]] | None = None,
        actions: Mapping[str, Mapping[str, object]] | None = None,
        poll_period_s: PollPeriod = 0.1,
        result_timeout_s: Duration = 10.0,
        live_lines_s: Duration | None = None,
        trace: bool = False,
        settle_before_scan_s: Duration = 0.0,
        bias_through_zero: ThroughZero = "jump",
        bias_reference: Literal["sample", "tip"] | None = None,
    ) -> None:
        if live_lines_s is not None and type(self).lines is DriverBase.lines:
            raise ConfigError(f"{type(self).__name__} does not publish lines of a running scan", where="live_lines_s")
        self.table = self.parameter_table(parameters or {})
        # a microscope that can't move its tip alone has no rows for it later on, and the same scanner
        self._reach = reach_in(self.table)
        self.channels = self.channels_of({"channels": channels})
        self.bias = self.bias_of({"bias_reference": bias_reference}, self.table)
        self.common = CommonSettings(
            dict(actions or {}),
            poll_period_s,
            result_timeout_s,
            live_lines_s,
            trace,
            settle_before_scan_s,
            bias_through_zero,
        )
        self.adjustable: frozenset[str] = frozenset()
        self.prove: Callable[[], None] = _prove_nothing
        self._last_written: dict[str, Value] = {}
        self.held_z = HeldZSettings() if self.holds_z() else None
        """The settings of a held z; None where z can't be held."""

    @classmethod
    def holds_z(cls) -> bool:
        """Return whether z can be held: the driver overrides `move_z`."""
        return not cls.only_reads and cls.move_z is not DriverBase.move_z

    def move_z(self, z_m: float) -> None:
        """Set z in m, as `x-tip-z` is read: positive away from the sample. Called while the feedback is off alone.

        Override where the controller has a documented function for it, and give the table a row `x-tip-z`, which is
        read-only and measured. A reading may differ from the setting by its `resolution`.
        """
        raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, self.cant_hold_z)

    def patience_s(self, of_s: float) -> float:
        """Return the longest wait, in experiment seconds, for a step that takes the controller at most `of_s`.

        The wait is at least `program_s` of real time: with a fast clock an emulated controller needs more experiment
        time.
        """
        return max(of_s, self.program_s / self.clock.real_s(1.0))

    @classmethod
    def rows(cls, settings: PlainMapping) -> Mapping[str, Mapping[str, object]]:
        """Return the rows that these settings add to the table or change."""
        return settings.get("parameters") or {}

    @classmethod
    def parameter_table(cls, changed: Mapping[str, Mapping[str, object]]) -> ParameterTable:
        """Return the parameters of this kind of microscope, with the rows that the experiment file adds or changes.

        Raises:
            ConfigError: a row has an impossible value.
        """
        where = "the experiment file"
        table, translated = ParameterTable.from_toml(cls.parameters_file), {*cls.translated, *_HELD_Z_ROWS}
        if cls.holds_z():
            table = table.extended(_HELD_Z_ROWS, where="afspm")
        table = table.extended(changed, where=where, translated=translated)
        errors = ErrorCollector()
        for name in [name for name in changed if name not in translated]:
            try:
                cls.check_row(table[name])
            except InvalidValue as error:
                errors.add(ConfigError(error.what, where=f"{where}, parameters.{name}", hint=error.hint))
        errors.raise_all()
        return table

    @classmethod  # noqa: B027 (most controllers take any name)
    def check_row(cls, row: ParameterSpec) -> None:
        """Raise InvalidValue for a row of the experiment file that the controller can't have.

        Override where the vendor's names are known, or where a name would set a quantity beside its limits.
        """

    @classmethod
    def commanded(cls, action: Mapping[str, object]) -> Sequence[tuple[str, Value]]:
        """Return the parameters that the command of an action sets, with values in the vendor's units.

        Override where it is known, so that limits judge such an action.

        Raises:
            InvalidValue: the controller has no such command, or an action may not use it.
        """
        return ()

    @classmethod
    def values_commanded(cls, action: Mapping[str, object], table: ParameterTable) -> list[tuple[str, Value]]:
        """Return the parameters that the command of an action sets, with values in SI; a sweep sets two of one.

        Raises:
            InvalidValue: see `commanded`. Refused: a value is out of range.
        """
        given = cls.commanded(action) if "command" in action else ()
        return [(name, table[name].checked(table[name].from_vendor(value))) for name, value in given]

    @classmethod
    def without_witness(cls, settings: PlainMapping) -> dict[str, str]:
        """Return what the controller never shows of a measurement with these settings, with the reasons."""
        table = cls.parameter_table(cls.rows(settings))
        missing = {name: [one for one in shown_by if one not in table] for name, shown_by in WITNESSES.items()}
        unread = {name: f"{', '.join(some)} can't be read" for name, some in missing.items() if some}
        return unread | dict(cls.never_shows or {})

    @classmethod
    def needs_withdrawn(cls, action: Mapping[str, object]) -> bool:
        """Return whether an action of the experiment file needs a withdrawn tip."""
        return bool(action.get("withdrawn", cls.coarse_move(action) is not None))

    @classmethod
    def coarse_move(cls, action: Mapping[str, object]) -> CoarseMove | None:
        """Return the move of an action of the experiment file that is known to move the coarse motor or stage."""
        command = str(action.get("command", "")).strip()
        is_known = bool(cls.coarse_commands and re.search(cls.coarse_commands, command))
        is_safe = action.get("withdrawn") is False  # a person's word for a command
        return CoarseMove() if is_known and not is_safe else None

    @classmethod
    def never_withdrawn(cls, settings: PlainMapping) -> tuple[str, ...]:
        """Return the actions of these settings that need a withdrawn tip, if the microscope never shows the tip."""
        if names.ENGAGED in cls.parameter_table(cls.rows(settings)):
            return ()
        given = (settings.get("actions") or {}).items()
        return tuple(name for name, what in given if isinstance(what, Mapping) and cls.needs_withdrawn(what))

    @classmethod
    def declared_channels(cls, settings: PlainMapping) -> ChannelRoles:
        """Return the channels that a microscope of this kind may have with these settings."""
        return ChannelRoles.declared(cls.channel_roles, cls.variable_roles)

    @classmethod
    def channels_of(cls, settings: PlainMapping) -> ChannelRoles:
        """Return the channels that the microscope may have, with the names of the experiment file.

        Raises:
            ConfigError: the file names a role that there is not.
        """
        return cls.declared_channels(settings).changed(settings.get("channels") or {})

    @classmethod
    def bias_of(cls, settings: PlainMapping, table: ParameterTable) -> BiasReference:
        """Return the reference of the bias, by the maker or else by the settings.

        Raises:
            ConfigError: they differ.
        """
        given: BiasOf = settings.get("bias_reference") or ""
        declared = cls.bias_reference
        if given and declared and given != declared:
            what = f"the panel of {cls.software or cls.__name__} has the bias of the {declared}, not of the {given}"
            raise ConfigError(what, where="bias_reference", hint="leave it out")
        return BiasReference(declared or given, names.SAMPLE_BIAS in table)

    @classmethod
    def introductions(cls) -> Callable[[str], Introduction] | None:
        """Return a factory of introductions by address, for the replay of a trace; None without a secret.

        Raises:
            OSError, ValueError: the secret can't be read.
        """
        return None

    @classmethod
    def technique(cls, settings: Mapping[str, object]) -> str:
        """Return STM or AFM if the settings determine the technique; otherwise an empty text."""
        return ""

    @classmethod
    def excused(cls, controller: str) -> Mapping[str, str]:
        """Return the conformance checks that a controller cannot pass, with the reasons.

        Args:
            controller: name and version of the controller, as in `x-controller`.
        """
        return {}

    @abstractmethod
    def connect(self) -> None:
        """Connect to the controller. Called at the start, and again after a `ControllerLost`."""

    def close(self) -> None:  # noqa: B027 (many have nothing to close)
        """Close the connection to the controller; the tip does not move."""

    @abstractmethod
    def status(self) -> ScopeStatus:
        """Return the present state of the controller."""

    @abstractmethod
    def get(self, vendor: str) -> Value:
        """Return the value of a parameter, by the vendor's name, in the vendor's unit."""

    @abstractmethod
    def set(self, values: Mapping[str, Value]) -> None:
        """Set parameters together by the vendor's names, in the vendor's units; all or none if possible."""

    @abstractmethod
    def results(self) -> Sequence[str]:
        """Return the finished scans and spectra, oldest first, usually as names of the controller's files.

        The translator remembers, also after a restart, which results it has published.
        """

    @abstractmethod
    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        """Read a result: all channels of a scan, or a spectrum, with the settings of the measurement.

        Raises:
            FileError: the file is incomplete; `load` is called again until `result_timeout_s` is over.
        """

    def stated(self, result: str) -> Stated:
        """Return what the files of a result say of their measurement. Override where they state times."""
        return Stated()

    def followed(self) -> bool | None:
        """Return the outcome of a measurement whose end `status` missed, because the next followed at once.

        Override where a panel can repeat scans. Called after `results`, which must list the measurement by then.

        Returns:
            once for each such measurement: True if it was complete, False if it was interrupted; None without one.
        """
        return None

    def reports_end(self) -> bool:
        """Return whether the driver calls `wake` at the end of the measurement that runs now.

        Override where the controller reports the end: then it is not polled more often towards the expected end.
        """
        return False

    def stopped_by_hand(self) -> str:
        """Return how the controller shows that a person ended the measurement just interrupted; "" if unknown.

        Override where such an end differs from an end by the controller itself. Called once for an interruption that no
        request caused; the controller has answered all the time.
        """
        return ""

    def withdrew_tip(self) -> str:
        """Return why the controller itself has withdrawn the tip, and what to do; "" if it has not.

        Override for a controller that withdraws the tip by itself, for example by a safe tip: the last reading of
        `x-engaged` or `status` decides. No person has withdrawn the tip then.
        """
        return ""

    def current_a(self) -> float | None:
        """Return the tunnelling current that the feedback holds, in A; None if the controller does not show it.

        Override where it does: a pulse or crash then ends once the feedback holds the current at its setpoint.
        """
        return None

    serves_several: ClassVar[bool] = False
    """True if a new connection is answered while another one is silent: a withdrawal then does not wait for the look
    before it."""

    @property
    def withdraws_aside(self) -> bool:
        """Whether `withdraw_elsewhere` can be tried while the working connection is silent or lost."""
        return False

    def withdraw_elsewhere(self) -> bool:
        """Withdraw the tip over a connection kept for this alone; return False if there is none.

        Called if `x-retract` is asked for and the controller is lost.

        Raises:
            ControllerLost: this connection, too, is silent or lost.
        """
        return False

    @classmethod
    def lost_without(cls, settings: PlainMapping) -> Sequence[str]:
        """Return what a real controller with these settings can't do, each with its remedy, as sentences."""
        return ()

    def is_last_written(self, name: str, value: Value) -> bool:
        """Return whether the run has set this parameter last, and to this value."""
        return name in self._last_written and self.table[name].same(self._last_written[name], value)

    def lines(self, start: int) -> Sequence[ScanLines]:
        """Return the complete lines of a running scan after the first `start`, in the order of scanning.

        Override where the controller provides lines during the scan (`live_lines_s`).

        Returns:
            for each channel the same lines, rows and columns ascending; empty without new lines.
        """
        return ()

    def command(self, text: str) -> None:
        """Send a text command of the experiment file to the controller, unchanged.

        Raises:
            Refused: ACTION_NOT_SUPPORTED: the driver does not override this method.
        """
        raise Refused(ControlResponse.ACTION_NOT_SUPPORTED, f"{type(self).__name__} does not take commands as text")

    def next_change_s(self) -> float | None:
        """Return the experiment time of the next known change; None if unknown."""
        return None

    def read(self, wanted: Collection[str]) -> dict[str, Value]:
        """Return the values of parameters by their generic names, in SI; the result may contain other parameters.

        Override only where neither the table nor `groups` can describe the controller's form.
        """
        found: dict[str, Value] = {}
        for group in self._all_groups:
            if not set(group.names).isdisjoint(wanted):
                found |= group.read()
        return found | self.read_rows([name for name in wanted if name not in found])

    @property
    def _all_groups(self) -> Sequence[SettingsGroup]:
        return self.groups if self.held_z is None else (*self.groups, self.held_z)

    def read_rows(self, wanted: Sequence[str]) -> dict[str, Value]:
        """Read parameters that need only the table."""
        return {name: self.table[name].from_vendor(self.get(self.table[name].vendor)) for name in wanted}

    def write(self, values: Mapping[str, Value]) -> None:
        """Set parameters by generic names, in SI: each group together and in order, then the rest."""
        left = dict(values)
        for group in self._all_groups:
            asked = {name: left.pop(name) for name in group.names if name in left}
            if asked:
                group.write(asked)
        if left:
            self.write_rows(left)

    def write_rows(self, values: Mapping[str, Value]) -> None:
        """Set parameters that need only the table."""
        self.set({self.table[name].vendor: self.table[name].to_vendor(value) for name, value in values.items()})

    def wait_for(self, condition: Callable[[], bool], at_most_s: float) -> bool:
        """Poll the controller until a condition holds. Return False after `at_most_s` of real time.

        There is no pause between polls: each takes as long as the controller's answer.
        """
        until_s = self.clock.monotonic_s() + at_most_s
        while not (holds := condition()) and self.clock.monotonic_s() < until_s:
            pass
        return holds

    def pulse_bias(self) -> None:
        """Apply a bias pulse of `x-pulse-voltage` for `x-pulse-duration` by setting the bias and restoring it."""
        wanted = self.in_force([names.PULSE_VOLTAGE, names.PULSE_DURATION])
        self.for_a_while({names.TIP_BIAS_VOLTAGE: wanted[names.PULSE_VOLTAGE]}, float(wanted[names.PULSE_DURATION]))

    def same(self, name: str, a: Value, b: Value, among: Mapping[str, Value]) -> bool:
        """Return whether two values of a parameter are equal within the controller's precision.

        Override only where a `resolution` in the table can't describe the precision, and accept what `super().same`
        accepts: the experiment file may give any row a `resolution`.

        Args:
            among: the values that were read together with `a`.
        """
        return self.table[name].same(a, b)

    def reach(self) -> Mapping[str, ParameterSpec]:
        """Return the range of the scanner: rows of the table for the places of the probe and of a frame's centre.

        Each frame is compared with it, with all corners. Override where the controller reports its range.
        """
        return self._reach

    def refuse_unreachable(  # noqa: B027 (most have nothing to ask)
        self, values: Mapping[str, Value], before: Mapping[str, Value]
    ) -> None:
        """Raise Refused for values that the controller would take as set, and could not bring about.

        Args:
            before: the values in force, at least of these parameters.

        Called after the table's ranges have been checked, before anything is set. Override where the controller
        reports present bounds.
        """

    def in_force(self, wanted: Collection[str]) -> dict[str, Value]:
        """Return the values of `read`, each replaced by the last set value if equal within the precision.

        Raises:
            InvalidValue: the controller returned a number that is not finite, which can't be published.
        """
        found, written = self.read(wanted), self._last_written
        for name in wanted:
            value = found[name]
            if isinstance(value, float) and not math.isfinite(value):
                raise InvalidValue(f"the controller returned {value} for {name}")
        return {
            name: written[name]
            if name in written and self.same(name, found[name], written[name], found)
            else found[name]
            for name in wanted
        }

    def reported(self, wanted: Collection[str]) -> dict[str, Value]:
        """Return the values of `in_force` that the controller reports, without the others."""
        try:
            return self.in_force(wanted)
        except (InvalidValue, Refused) as error:
            self.log.debug("%s can't be read: %s", ", ".join(wanted), error)
        alone = [self.reported([name]) for name in wanted] if len(wanted) > 1 else []
        return {name: value for values in alone for name, value in values.items()}

    def put_in_force(self, values: Mapping[str, Value]) -> None:
        """Write values and remember them for `in_force`.

        The feedback is switched on after all other values are written, and off before them: it must not act on old
        values.
        """
        rest = {name: value for name, value in values.items() if name != names.FEEDBACK_ON}
        parts = [rest] if rest else []
        if names.FEEDBACK_ON in values:
            on = values[names.FEEDBACK_ON]
            parts.insert(len(parts) if on else 0, {names.FEEDBACK_ON: on})
        for part in parts:
            self.write(part)
        self._last_written.update(values)

    def own_actions(self) -> dict[str, Action]:
        """Return the methods marked with `@action`, by name."""
        found = {}
        for attribute in dir(type(self)):
            mark = getattr(getattr(type(self), attribute), "_afspm_action", None)
            if isinstance(mark, Action):
                found[mark.name] = replace(mark, do=getattr(self, attribute))
        return found
