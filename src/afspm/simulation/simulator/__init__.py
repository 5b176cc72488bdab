"""A simulated microscope: the physics of `afspm.simulation` behind a controller with all the base actions.

The microscope runs on the experiment clock, so that a night can pass in a minute. Its state survives a kill: the same
tip continues, and a measurement has gone on meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, Literal, TypeVar

from afspm.basics.errors import AfspmError, ConfigError, ErrorCollector, Refused
from afspm.basics.plain_data import Count, PlainMapping
from afspm.basics.units import Duration, PollPeriod, PositiveLength
from afspm.model import ChannelRoles, ControlResponse, Scan, ScanLines, ScopeState, ScopeStatus, Spectrum, names
from afspm.model.variables import VariableRoles
from afspm.simulation import World
from afspm.simulation.background import in_background
from afspm.simulation.faults import INSTRUMENT_FAULTS, Fault, Faults
from afspm.simulation.feedback import FeedbackSettings
from afspm.simulation.instrument import SimulatedInstrument
from afspm.simulation.settings import build
from afspm.simulation.simulator.controller import MEASURED, PanelEvent, SimulatedController
from afspm.simulation.spectra import KINDS
from afspm.simulation.truth import Truth
from afspm.simulation.world import read_settings
from afspm.storage.formats import read
from afspm.translator.driver import Driver
from afspm.translator.driver_base import Action, ControllerLost, ThroughZero, action
from afspm.translator.parameters import FEEDBACK_ON, Value

if TYPE_CHECKING:
    from afspm.transport.process.context import ProcessContext

T = TypeVar("T")

Table = dict[str, object]
"""Settings in the form of the experiment file."""
Rows = dict[str, Table]

FAULT_KINDS: Final[Mapping[str, str]] = {
    **INSTRUMENT_FAULTS,
    "false-landing": "an approach ends too far away, and the tip seems to be at the sample for the duration",
    "late-reply": "an answer is delayed by the duration (real time)",
    "no-reply": "a request is carried out but not answered",
    "error": "the controller refuses a request",
    "restart": "the controller can't be reached for the duration",
    "hang": "the process hangs for the duration (real time)",
    "crash": "the process ends at once",
}
_FAULT = "x-fault"
_FAULT_PARAMETERS = ("x-fault-kind", "x-fault-count", "x-fault-duration")
_AT_FIRST: Table = {
    names.SCAN_TOP_LEFT_X: "-0.5 um",
    names.SCAN_TOP_LEFT_Y: "-0.5 um",
    names.SCAN_SIZE_X: "1 um",
    names.SCAN_SIZE_Y: "1 um",
    names.SCAN_ANGLE: 0.0,
    names.SCAN_RESOLUTION_X: 128,
    names.SCAN_RESOLUTION_Y: 128,
    names.SCAN_SPEED: "2 um/s",
    names.SCAN_DIRECTION: names.UP,
    names.DRIFT_RATE_X: 0.0,
    names.DRIFT_RATE_Y: 0.0,
    names.MOVE_SPEED: "5 um/s",
    names.PROBE_POS_X: 0.0,
    names.PROBE_POS_Y: 0.0,
    names.SAMPLE_SLOPE_X: 0.0,
    names.SAMPLE_SLOPE_Y: 0.0,
    names.TIP_BIAS_VOLTAGE: "100 mV",
    names.SPEC_KIND: "IV",
    names.PULSE_VOLTAGE: "4 V",
    names.PULSE_DURATION: "100 ms",
    names.CRASH_SPEED: "50 nm/s",
    names.CRASH_DEPTH: "5 nm",
    names.ENGAGED: True,
    "x-fault-kind": "late-reply",
    "x-fault-count": 1,
    "x-fault-duration": 1.0,
}


def _controller_action(
    name: str,
    do: Callable[[SimulatedController, float], None],
    *,
    state: ScopeState | None = None,
    refuses: bool = True,
) -> Callable[[Simulator], None]:
    @action(name, state=state)
    def act(self: Simulator) -> None:
        do(self._reached(refuses=refuses), self.clock.now_s())

    return act


def _coarse_action(name: str, direction: tuple[int, int, int]) -> Callable[[Simulator], None]:
    @action(name, state=ScopeState.COARSE_MOTOR, is_coarse=True)
    def act(self: Simulator) -> None:
        self._reached(refuses=True).step(direction, self.coarse_steps, self.coarse_step_m, self.clock.now_s())

    return act


_BOTH_WAYS: Final = ("Current", "Deflection", "Force", "Frequency Shift")
_VARIABLES: Final = VariableRoles.declared(
    {
        "bias": ["Bias"],
        "height": ["Z"],
        "conductance": ["dI/dV"],
        **{name.lower(): [name] for name in _BOTH_WAYS},
        **{f"{name.lower()}, retrace": [f"{name} Retrace"] for name in _BOTH_WAYS},
    }
)


class Simulator(Driver):
    """The simulated microscope.

    Args:
        seed: seed of all random numbers.
        surface: a kind, or a table of `kind` and its settings.
        scanner: a table of settings, or the name of a scanner with the statistics of a real one: "stm-4k".
        tip, tip_changes, drift, feedback, noise, signals, iv, force, z, property_map: a table of settings.
        initial: values of parameters at the start, by their generic names.
        approach_s: duration of engaging and retracting.
        coarse_steps, coarse_step: steps of the coarse motor in one of its actions ("x-coarse-left" …), and the length
            of one.
        faults: faults and their times, each a table of `kind` (`FAULT_KINDS`), `at_s`, `count`, `duration_s`.
        fault_action: enable the action "x-fault", which triggers faults on demand.
        panel: actions of a person at the controller's panel, each a table of `at_s` with `set` or `action`.
        parameters: rows added to the table of parameters, or changed in it.
        channels: names of channels by role.
        actions: generic actions added: `{name = {set = {<parameter> = <value>}}}`.
        poll_period_s: interval between reads of the state, in real seconds, while nothing is due.
        result_timeout_s: longest delay of the file after the end of a scan or spectrum.
        live_lines_s: interval between publications of lines of a running scan; 0: never; by default 0.5 real seconds.
        settle_before_scan_s: wait after a move of the frame, before a scan can begin.
        bias_through_zero: `"jump"`, `"hold"` or `"refuse"` where a bias changes its sign at the sample with a feedback
            on a current, as for all microscopes.
        bias_reference: "sample" alone, which the simulated microscope has, so that a maker's file can be rehearsed.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    maker: ClassVar[str] = "afspm"
    software: ClassVar[str] = "afspm, simulated microscope"
    bias_reference = "sample"
    max_pixels: ClassVar[int] = 2048 * 2048
    simulated: ClassVar[bool] = True
    live_real_s: ClassVar[float | None] = 0.5
    memory_is_all: ClassVar[bool] = True
    never_shows: ClassVar = {
        "another one begun": "a stop and a start between two looks seem one scan",
        "start in the file": "a file has the end; the start follows from the speed",
        "missing rows": "a stopped scan has no file",
        "stop of a scan": "the simulation shows only that no scan runs",
        "stop of a spectrum": "the simulation shows only that no spectrum runs",
    }

    def __init__(
        self,
        *,
        seed: int = 1,
        surface: str | Table = "steps",
        tip: Table | None = None,
        tip_changes: Table | None = None,
        drift: Table | None = None,
        feedback: Table | None = None,
        scanner: str | Table | None = None,
        noise: Table | None = None,
        signals: Table | None = None,
        iv: Table | None = None,
        force: Table | None = None,
        z: Table | None = None,
        property_map: Table | None = None,
        initial: Table | None = None,
        approach_s: Duration = 1.0,
        coarse_steps: Count = 20,
        coarse_step: PositiveLength = 100e-9,
        faults: list[Table] | None = None,
        fault_action: bool = False,
        panel: list[Table] | None = None,
        parameters: Rows | None = None,
        channels: Mapping[str, str | list[str]] | None = None,
        actions: Rows | None = None,
        poll_period_s: PollPeriod = 0.25,
        result_timeout_s: Duration = 10.0,
        live_lines_s: Duration | None = None,
        settle_before_scan_s: Duration = 0.0,
        bias_through_zero: ThroughZero = "jump",
        bias_reference: Literal["sample", "tip"] | None = None,
    ) -> None:
        world: Table = {
            "surface": surface,
            "tip": tip,
            "tip_changes": tip_changes,
            "drift": drift,
            "feedback": feedback,
            "scanner": scanner,
            "noise": noise,
            "signals": signals,
            "iv": iv,
            "force": force,
            "z": z,
            "property_map": property_map,
        }
        self._world_settings = {name: settings for name, settings in world.items() if settings is not None}
        self._seed = seed
        errors = ErrorCollector()
        with errors:
            World.from_settings(self._world_settings, seed, 0.0)
        self._faults_settings = _made(Fault, faults or [], "faults", errors)
        with errors:
            Faults(self._faults_settings, FAULT_KINDS, 0.0)
        self._panel = _made(PanelEvent, panel or [], "panel", errors)
        self._fault_action, self._approach_s = fault_action, approach_s
        self.coarse_steps, self.coarse_step_m = coarse_steps, coarse_step
        self.initial: Mapping[str, Value] = {}
        self.scan_speed_m_s: float | None = None
        self.faults: Faults | None = None
        self.demanded: Fault | None = None
        self._controller: SimulatedController | None = None
        self._truth: Truth | None = None
        loop = _loop_of(self._world_settings)
        with errors:
            super().__init__(
                parameters=self.rows({**self._world_settings, "parameters": parameters}),
                actions=actions,
                poll_period_s=poll_period_s,
                result_timeout_s=result_timeout_s,
                live_lines_s=live_lines_s,
                settle_before_scan_s=settle_before_scan_s,
                bias_through_zero=bias_through_zero,
                bias_reference=bias_reference,
            )
            self.channels = self.channels_of({**self._world_settings, "channels": channels})
            if not fault_action:
                self.table = self.table.without(_FAULT_PARAMETERS)
            if loop is not None and not loop.senses_shift:
                self.table = self.table.without([names.FREQUENCY_SHIFT])
            if loop is not None:  # an invalid feedback leaves the unit of the setpoint unknown
                self._check_values(loop, initial or {}, errors)
        errors.raise_all()

    def _check_values(self, loop: FeedbackSettings, initial: PlainMapping, errors: ErrorCollector) -> None:
        # `initial` and the panel set parameters without a request, so nothing else would check these values
        in_force = {
            FEEDBACK_ON: loop.on,
            names.ZCTRL_PGAIN: loop.proportional_gain,
            names.ZCTRL_IGAIN: loop.integral_gain,
            names.ZCTRL_SETPOINT: loop.first_setpoint,
        }
        at_first = {name: value for name, value in {**_AT_FIRST, **in_force}.items() if name in self.table}
        with errors:
            self._initial = self.table.written({**at_first, **initial}, where="initial")
            self.initial = {name: self._initial[name] for name in initial}
            speed = self._initial.get(names.SCAN_SPEED)
            self.scan_speed_m_s = speed if isinstance(speed, float) else None
        for i, event in enumerate(self._panel):
            with errors:
                self.table.written(event.set or {}, where=f"panel[{i}].set")
            if event.action and event.action not in self.own_actions():
                errors.add(ConfigError(f"there is no action {event.action!r}", where=f"panel[{i}].action"))

    @classmethod
    def technique(cls, settings: PlainMapping) -> str:
        loop = _loop_of(settings)
        return "" if loop is None else "STM" if loop.mode == "current" else "AFM"

    @classmethod
    def declared_channels(cls, settings: PlainMapping) -> ChannelRoles:
        loop = _loop_of(settings)
        names = {"height": ["Height"], "height, retrace": ["Height Retrace"], "current": ["Current"]}
        if loop is not None and loop.mode == "amplitude":
            names |= {"amplitude": ["Amplitude"], "phase": ["Phase"]}
        if loop is not None and loop.senses_shift:
            names |= {"frequency shift": ["Frequency Shift"]}
        return ChannelRoles.declared(names, _VARIABLES)

    @classmethod
    def rows(cls, settings: PlainMapping) -> Rows:
        loop = _loop_of(settings)
        return _merged({} if loop is None else _rows_for(loop.mode), settings.get("parameters") or {})

    def change_tip(self, condition: str) -> None:
        """Change the tip now, also during a scan, to "sharp", "blunt", "double" or "contaminated"."""
        self._reached(refuses=False).instrument.change_tip(condition, self.clock.now_s())

    def run_drawing(self, work: Callable[[], None]) -> None:
        """Compute a scan in a background thread."""
        in_background(work)

    def connect(self) -> None:
        """Switch the instrument on, with its saved state if any, unless it is on already.

        Raises:
            ControllerLost: the fault "restart" is active.
        """
        if self._controller is None:
            self._controller = self._switch_on()
        self._reached(refuses=False)

    def close(self) -> None:
        if self._truth is not None:
            self._truth.close()

    def _switch_on(self) -> SimulatedController:
        # in advance: otherwise the first saved file would be late; beside the start, since it takes half of its time
        in_background(_import_writer)
        kept = self.memory
        if "start_s" not in kept:
            values = {name: self.table[name].to_vendor(value) for name, value in self._initial.items()}
            kept.update(start_s=self.clock.now_s(), values=values, results=[], panel=0)
            kept["faults"] = {}
        start_s = kept["start_s"]
        self.faults = Faults(self._faults_settings, FAULT_KINDS, start_s, kept["faults"])
        truth = self._truth = Truth(self.run_dir / "truth.jsonl", kept)
        instrument = SimulatedInstrument(
            self._world_settings, self._seed, start_s, run=self.run_drawing, note=truth.note
        )
        instrument.setup.approach_s = self._approach_s
        instrument.drawing.wake, instrument.drawing.log = self.wake, self.log
        instrument.drawing.clock = self.clock
        if "instrument" not in kept:
            instrument.note(start_s, "start", {"settings": self._world_settings, "seed": self._seed})
        folder = (self.run_dir / "scans").resolve()
        return SimulatedController(
            instrument, self.table, kept, folder, faults=self.faults, log=self.log, panel=self._panel
        )

    def _reached(self, *, refuses: bool) -> SimulatedController:
        now_s, faults, controller = self.clock.now_s(), self.faults, self._controller
        if controller is None or faults is None or faults.lasts("restart", now_s):
            raise ControllerLost("the simulated controller can't be reached")
        if refuses and faults.strikes("error", now_s):
            raise Refused(ControlResponse.FAILURE, "the controller refused (a simulated fault)")
        return controller

    def status(self) -> ScopeStatus:
        controller = self._reached(refuses=False)
        status = ScopeStatus(controller.state(self.clock.now_s()))
        controller.instrument.drawing.release()
        return status

    def next_change_s(self) -> float | None:
        # neither acts at the panel nor faults: no controller announces them, so polling has to find them
        return None if self._controller is None else self._controller.instrument.ends_s

    def next_event_s(self) -> float | None:
        """Return the experiment time of the next event, acts at the panel and faults included; None if unknown.

        Before this time all answers of the driver stay the same, except new lines of a scan, unless a request changes
        them. This is for benches: a translator that knew this time would not have to poll.
        """
        if self._controller is None or self.faults is None or self._controller.instrument.drawing.goes_on:
            return None
        times = (self._controller.next_event_s(), self.faults.next_s(self.clock.now_s()))
        return min((at_s for at_s in times if at_s is not None), default=math.inf)

    def get(self, vendor: str) -> Value:
        if vendor == names.CONTROLLER:
            from importlib.metadata import version  # imported late, since the supervisor imports this class, too

            return f"simulated microscope of afspm {version('afspm')}"
        controller = self._reached(refuses=False)
        if vendor in MEASURED:
            return self.table[vendor].to_vendor(controller.measured(vendor, self.clock.now_s()))
        if vendor not in self.memory["values"]:
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, f"the simulated controller has no {vendor!r}")
        if vendor == names.ENGAGED:
            return controller.is_engaged(self.clock.now_s())
        if vendor == FEEDBACK_ON:
            return controller.instrument.feedback_reads(self.clock.now_s())
        value: Value = self.memory["values"][vendor]
        return value

    def move_z(self, z_m: float) -> None:
        self._reached(refuses=True).move_z(z_m, self.clock.now_s())

    def set(self, values: Mapping[str, Value]) -> None:
        """Set values; frame and probe move at the move speed."""
        for vendor in values:
            self.get(vendor)
        controller = self._reached(refuses=not set(values) <= set(_FAULT_PARAMETERS))
        controller.set(dict(values), self.clock.now_s())

    def results(self) -> Sequence[str]:
        return self._reached(refuses=False).results()

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        return list(read(result))

    def lines(self, start: int) -> Sequence[ScanLines]:
        return self._reached(refuses=False).lines(start, self.clock.now_s())

    start_scan = _controller_action(names.START_SCAN, SimulatedController.start_scan)
    stop_scan = _controller_action(names.STOP_SCAN, SimulatedController.stop)
    start_spec = _controller_action(names.START_SPEC, SimulatedController.start_spectrum)
    stop_spec = _controller_action(names.STOP_SPEC, SimulatedController.stop)
    pulse = _controller_action(names.PULSE, SimulatedController.pulse, state=ScopeState.BUSY_PARAM)
    crash = _controller_action(names.CRASH, SimulatedController.crash, state=ScopeState.MOVING)
    engage = _controller_action(names.ENGAGE, SimulatedController.engage, state=ScopeState.COARSE_MOTOR)
    retract = _controller_action(
        names.RETRACT, SimulatedController.retract, state=ScopeState.COARSE_MOTOR, refuses=False
    )

    approach = _controller_action(names.APPROACH, SimulatedController.approach, state=ScopeState.COARSE_MOTOR)
    coarse_left = _coarse_action("x-coarse-left", (-1, 0, 0))
    coarse_right = _coarse_action("x-coarse-right", (1, 0, 0))
    coarse_down = _coarse_action("x-coarse-down", (0, -1, 0))
    coarse_up = _coarse_action("x-coarse-up", (0, 1, 0))
    coarse_away = _coarse_action("x-coarse-away", (0, 0, 1))

    @action(_FAULT, while_busy=True)
    def fault(self) -> None:
        """Trigger the fault of the parameters "x-fault-…", after the answer to this request."""
        kind, count, duration_s = (self.memory["values"][name] for name in _FAULT_PARAMETERS)
        self.demanded = Fault(str(kind), 0.0, int(count), float(duration_s))

    def own_actions(self) -> dict[str, Action]:
        found = super().own_actions()
        return found if self._fault_action else {name: a for name, a in found.items() if name != _FAULT}

    def run_process(self, context: ProcessContext) -> int:
        """Run the translator, with injected faults of the translator itself."""
        from afspm.simulation.simulator.faulty import FaultyTranslator
        from afspm.translator.translator import run_translator

        return run_translator(self, context, FaultyTranslator)


_SETPOINTS: Final[Rows] = {
    "amplitude": {"unit": "V", "range": ["1 mV", "10 V"]},
    "current": {"unit": "A", "range": ["1 pA", "100 nA"]},
    "frequency-shift": {"unit": "Hz", "range": ["-100 kHz", "-1 mHz"]},
}


def _import_writer() -> None:
    import_module("scipy.io")


def _rows_for(mode: str) -> Rows:
    return {names.ZCTRL_SETPOINT: _SETPOINTS[mode], names.SPEC_KIND: {"choices": list(KINDS)}}


def _merged(*tables: Mapping[str, Mapping[str, object]]) -> Rows:
    merged: Rows = {}
    for table in tables:
        for name, row in table.items():
            # the table of parameters refuses a row that is not a table
            merged[name] = {**merged.get(name, {}), **row} if isinstance(row, Mapping) else row
    return merged


def _loop_of(settings: Mapping[str, object]) -> FeedbackSettings | None:
    # None if the feedback itself is invalid; errors elsewhere in the world don't matter here
    of_it = {name: settings[name] for name in ("surface", "feedback") if settings.get(name) is not None}
    try:
        return read_settings(of_it)[1].feedback
    except AfspmError:
        return None


def _made(kind: type[T], tables: Sequence[Mapping[str, object]], where: str, errors: ErrorCollector) -> list[T]:
    made = []
    for i, table in enumerate(tables):
        with errors:
            made.append(build(kind, table, f"{where}[{i}]"))
    return made
