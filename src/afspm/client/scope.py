"""`Scope`: the blocking handle on an experiment, for scripts, notebooks and `Component.run`."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TypedDict, TypeVar, Unpack, get_args

from afspm import wire
from afspm.basics import RequestError
from afspm.basics.errors import ControlLost, ExperimentEnded, InvalidValue, Refused
from afspm.basics.plain_data import Plain
from afspm.basics.units import si_or_text
from afspm.client.command_retry import CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.events import Events, PublishedEvent
from afspm.client.experiment_link import ExperimentLink
from afspm.client.experiment_view import ExperimentView, checked_call
from afspm.client.former_targets import FormerTargets, partition
from afspm.client.held_height import HeldHeight
from afspm.client.instrument_targets import InstrumentTargets
from afspm.client.keyed_results import KeyedResults, check_key
from afspm.client.measurement import MeasurementRunner
from afspm.client.measurement_setup import MeasurementSetup
from afspm.client.parameter_text import Value, to_parameter, to_settings, value_in
from afspm.client.sweeping import Measure, ParameterSweep, SweepPoint
from afspm.client.sweeping_at import PlacedSweep, PlacedSweeper
from afspm.client.targets import ScanTarget, SpectrumTarget, Target, xy_of
from afspm.client.withdrawal import APPROACH_S, Withdrawal
from afspm.model import (
    CLOCK_REQUEST,
    GRANT_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    Frame,
    Grant,
    InstrumentReadings,
    Note,
    Parameter,
    Problem,
    ProblemNames,
    Progress,
    Region,
    RelayedMessage,
    ScanSet,
    Spectrum,
    names,
)
from afspm.model.curve_request import CurveSettings, curve_parameters
from afspm.model.events import HasTime
from afspm.model.instruments import InstrumentOrders, is_of_instrument, newest_of
from afspm.model.requests import AS_PLANNED_REQUEST, KEEP_REQUEST, Settings
from afspm.model.sessions import KEYED
from afspm.model.sweep_plan import SweepAxis, SweepOrder, SweepPlan, SweptValues
from afspm.transport.process.parent import StopRequested

__all__ = ["Events", "PublishedEvent", "Scope"]

Place = tuple[float | str, float | str]
TargetT = TypeVar("TargetT", ScanTarget, SpectrumTarget)
SET_BACK_WITHIN_S = 60.0
"""Limit on the wait for control after a failed sweep, real time."""
ANSWER_S = 60.0  # default of readings; calls that wait for control or a measurement have no limit by default


class CurveArguments(TypedDict, total=False):
    """What a request for one spectrum may say of the curve: see `curve_parameters`."""

    sweep: tuple[str, str]
    points: int
    point_time: float | str
    z_offset: float | str
    lock_in: Mapping[str, float | str]


class Scope(ExperimentView):
    """The handle for scans, spectra, settings and actions; each call returns when its work is done.

    A call requests control and releases it afterwards; `with scope.control():` keeps control over several calls.
    Without control, calls wait until control is given. Timeouts are in real seconds; None waits for ever.

    One thread at a time may use a scope; only `interrupt` may be called meanwhile. For two threads, connect twice.

    Every call may raise:
        Refused: the scheduler, a limit or the microscope refused; `reason` gives the reason.
        NoResponse: the time limit has passed, or there is no answer.
        ControlLost: control was not given within the timeout, or was lost in an unbroken block.
        ExperimentEnded: the experiment has ended.

    Args:
        link: connection to the experiment.
        problems: the problems of the experiment by name; None: only those of every experiment.
        state_dir: folder for keyed measurements; None: only in memory.
        between: called after each successful measurement, request (except for control), `wait_until` or `sleep`;
            never within one of them.
        frame: coordinate system of all places.
    """

    def __init__(
        self,
        link: ExperimentLink,
        problems: ProblemNames | None = None,
        state_dir: Path | None = None,
        between: Callable[[], None] = lambda: None,
        frame: Frame = Frame.TIP,
    ) -> None:
        super().__init__(link, problems or ProblemNames(), between)
        self._frame = frame
        self._curve: tuple[Parameter, ...] = ()
        self._kind_of_curves: str | None = None
        self._lent: dict[str, Parameter] = {}
        self._settle_s: float | None = None
        self._sweeps = False
        self._begun: tuple[int, float] | None = None  # finished parts and time at the first `progress`
        self._control = ControlHold(link, self.problems)
        self._commands = CommandRetry(link, self._control)
        self._targets = InstrumentTargets(link, self._control, self._commands)
        self._results = KeyedResults(state_dir, link.name)
        self._withdrawal = Withdrawal(link, self._control, self._commands, self._results)
        self._setup = MeasurementSetup(link.view, self._control, self._commands, self._targets, self._withdrawal)
        self._runner = MeasurementRunner(link, self._control, self._commands, self._setup, self._results)

    # --- measuring ---

    @checked_call
    def scan(
        self,
        region: Region | None = None,
        *,
        shape: tuple[int, int] | None = None,
        settings: Mapping[str, Value] | None = None,
        key: str | None = None,
        repeat: bool = True,
        timeout_s: float | None = None,
    ) -> ScanSet:
        """Take a scan and return all its channels.

        A scan that is interrupted (a problem, MANUAL, a restart of any process) is taken again when control is back;
        `ScanSet.interruptions` gives times and reasons.

        Args:
            region: region to scan; None: the present region.
            shape: (rows, columns); None: the present shape.
            settings: parameters for this scan alone, {"tip-bias-voltage": "0.5 V"}, beside those of the blocks around
                it: see `settings`.
            key: name of the scan, which is then taken only once in this run: after a restart of the component the call
                returns the saved scan. Each measurement of a component needs its own key. A saved scan takes space on
                disk until `forget`.
            repeat: whether to take the scan again if control is lost during the scan; False: raise ControlLost.
        """
        with self._call():
            target = self._carrying(ScanTarget.of(region, shape, self._frame), settings)
            return self._runner.take(target, key, self._link.until(timeout_s), repeat=repeat).scans

    @checked_call
    def spectrum(
        self,
        at: Place | None = None,
        *,
        kind: str | None = None,
        settings: Mapping[str, Value] | None = None,
        key: str | None = None,
        timeout_s: float | None = None,
        **curve: Unpack[CurveArguments],
    ) -> Spectrum:
        """Take a spectrum; interruptions, `settings` and `key` as for `scan`.

            scope.spectrum(("0 nm", "5 nm"), kind="IV", sweep=("-500 mV", "500 mV"), points=201)

        Args:
            at: (x, y) in m or as text, ("1 um", "0 nm"), to move the probe to; None: the present position.
            kind: e.g. "IV" (the parameter `x-spec-kind`); None: the present kind.
            curve: settings of the curve, which are set back after it: `sweep`, `points`, `point_time`, `z_offset` and
                `lock_in`, as in `curve_parameters`. For many curves, use `curves`.
        """
        if curve:
            with self.curves(curve, kind=kind, timeout_s=timeout_s):
                return self.spectrum(at, kind=kind, settings=settings, key=key, timeout_s=timeout_s)
        with self._call():
            target = self._carrying(self._spectrum_target(at, kind), settings)
            return self._runner.take(target, key, self._link.until(timeout_s)).spectrum

    @contextmanager
    def settings(self, settings: Mapping[str, Value], *, settle: float | str | None = None) -> Iterator[None]:
        """Take all measurements of the block with these settings.

            with scope.settings({"tip-bias-voltage": "0.5 V", "scan-speed": "2 um/s"}):
                scope.scan(region)

        Each measurement carries its settings: they are set right before it, and set back before a measurement of
        others that does not state them, at the end of the block, and if this component ends. In a block within a
        block, both hold; the inner one comes first. A value that a person or `set` changes outside of measurements is
        the one to which they are set back. Parameters that change what other numbers mean, or move the tip, can't be
        set for a while: they are set once, and stay.

        Args:
            settings: values by parameter, as for `set`.
            settle: experiment time after a change of bias, setpoint or gains, in s or as text; None: as in [control].

        Raises:
            InvalidValue: a value is not valid, or a parameter is one of another instrument.
        """
        given, outside = to_settings(settings), (self._lent, self._settle_s)
        self._lent = {**self._lent, **given}
        self._settle_s = self._settle_s if settle is None else si_or_text(settle, "s")
        try:
            with self._giving_back(given.keys() - outside[0].keys()):
                yield
        finally:
            self._lent, self._settle_s = outside

    @checked_call
    def set_back(self, *, timeout_s: float | None = ANSWER_S) -> None:
        """Wait until the scheduler has set back all settings that measurements do not need any more.

        A component that solves a problem finds those of others set back before its own measurements and treatments. It
        calls this before it leaves the microscope to a person. What can't be set back is in the log.

        Raises:
            NoResponse: they are not set back within the timeout.
        """
        with self._call():
            self._link.give_back(self._link.until(timeout_s))

    def _carrying(self, target: TargetT, settings: Mapping[str, Value] | None = None) -> TargetT:
        own = (*target.settings, *to_settings(settings or {}).values())
        return replace(target, settings=own, lent=tuple(self._lent.values()), settle_s=self._settle_s)

    @contextmanager
    def _giving_back(self, names: Collection[str]) -> Iterator[None]:
        try:
            yield
        except (ExperimentEnded, StopRequested):
            raise  # the scheduler has noticed, or a stop of the run leaves them to a person
        except BaseException:  # also Ctrl-C, and what the block of the user raises
            if names:
                with suppress(RequestError, ExperimentEnded), self._link.interrupts.deferred():
                    self._commands.give_back(sorted(names), self._link.until(SET_BACK_WITHIN_S))
            raise
        if names:
            with self._call():
                self._commands.give_back(sorted(names), self._link.until(SET_BACK_WITHIN_S))

    @contextmanager
    def curves(
        self,
        settings: CurveSettings,
        *,
        kind: str | None = None,
        timeout_s: float | None = None,
    ) -> Iterator[None]:
        """Take all spectra of the block with these settings, which are set back as those of `settings`.

            with scope.curves({"sweep": ("-500 mV", "500 mV"), "points": 201}, kind="IV"):
                for number, place in enumerate(places):
                    scope.spectrum(place, kind="IV", key=f"curve-{number}")

        Args:
            settings: as in `curve_parameters`; without any, the block does nothing.
            kind: kind of the spectra, since each has settings of its own; None: the present kind.

        Raises:
            InvalidValue: a setting is not valid or does not fit the kind; a block in a sweep, or of another kind in a
                block.
        """
        if not settings:
            yield
            return
        if self._sweeps:
            raise InvalidValue("settings of curves begin before a sweep, not in it", where="curves")
        outside = self._curve, self._kind_of_curves
        with self._call():
            curve_parameters(settings, kind)
            kind = self._fitting(kind or self._present_kind(self._link.until(timeout_s)))
            of_curves = curve_parameters(settings, kind)
        self._curve, self._kind_of_curves = (*outside[0], *of_curves), kind
        try:
            with self._giving_back({one.name for one in of_curves} - {one.name for one in outside[0]}):
                yield
        finally:
            self._curve, self._kind_of_curves = outside

    def _present_kind(self, until_s: float | None) -> str | None:
        response = self._commands.read(ControlRequest.PARAM, Parameter(names.SPEC_KIND), until_s)
        return wire.decode_parameter(response.payload).value if response.ok and response.payload else None

    def _fitting(self, kind: str | None) -> str | None:
        # the kind of a spectrum in a block of `curves`
        if self._kind_of_curves is None or kind in (None, self._kind_of_curves):
            return kind or self._kind_of_curves
        raise InvalidValue(f"a spectrum {kind} in a block with settings of {self._kind_of_curves}", where="kind")

    def _spectrum_target(self, at: object, kind: str | None) -> SpectrumTarget:
        return SpectrumTarget.of(at, self._fitting(kind), self._frame, self._curve)

    @checked_call
    @contextmanager
    def sweep(
        self,
        parameters: Mapping[str, SweptValues],
        *,
        measure: Measure = "scan",
        region: Region | Sequence[Region] | None = None,
        shape: tuple[int, int] | None = None,
        at: Place | Sequence[Place] | None = None,
        kind: str | None = None,
        order: SweepOrder = "snake",
        seed: int = 0,
        repeat: int = 1,
        settle: float | str = 0.0,
        withdraw: bool | Sequence[str] = False,
        key: str | None = None,
        done: int = 0,
        timeout_s: float | None = None,
    ) -> Iterator[Iterator[SweepPoint]]:
        """Take scans and spectra at each combination of the values of some parameters.

            with scope.sweep({"zctrl-setpoint": ["50 pA", "100 pA"], "scan-speed": ["1 um/s", "2 um/s"]}) as points:
                for point in points:
                    print(point.values, point.scans["height"].values.std())

        Each measurement carries the values of its point, as in a block of `settings`: other components may measure
        between two points, with values of their own. If control is lost in a measurement, to a tip repair for instance,
        it is taken again. In the record the parameters are columns of `run.scans` and `run.spectra`. A parameter of
        another instrument, such as a temperature, is set as its target; each point waits until the value has arrived.
        Then control is kept over all points, and the former targets are set at the end of the block, even after an
        error; not after the end of the experiment or a stop of the process.

        Args:
            parameters: values of each parameter: a list, or a range such as {"from": "0.5 um/s", "to": "4 um/s",
                "points": 4, "spacing": "log"}. The first parameter changes least often.
            measure: the measurement at each point: "scan", "spectrum", or "both", first the scans.
            region, shape: region and shape of the scans, as for `scan`; a scan of each region of a list.
            at, kind: position and kind of the spectra, as for `spectrum`; a spectrum at each position of a list.
            order: "snake": from point to point one parameter changes, to a neighbouring value; "listed": nested loops
                over the values as listed, which may come again, as in a hysteresis loop; "random".
            seed: seed of the random order.
            repeat: number of points with the same values, one after the other.
            settle: experiment time after a change of bias, setpoint or gains, in s or as text.
            withdraw: whether the tip is withdrawn while another instrument goes to its target. It then stays withdrawn
                when the instruments are set back at the end. A list of actions moves the tip away besides, as a lateral
                move of a stage needs it; then it is brought back by an `approach`.
            key: name of the sweep, whose measurements are then taken only once in this run, under the keys "<key>-1",
                "<key>-2" …
            done: number of points to skip at the beginning.
        """
        if measure not in get_args(Measure):
            raise InvalidValue(f"a sweep can't measure {measure!r}", where="sweep", hint='"scan", "spectrum" or "both"')
        plan = SweepPlan.of(parameters, order, seed, repeat)
        if withdraw and not any(is_of_instrument(axis.name) for axis in plan.axes):
            raise InvalidValue(
                "the tip is withdrawn while another instrument goes to its target, and none is swept",
                where="withdraw",
                hint="leave it out",
            )
        targets: list[Target] = []
        if measure != "spectrum":
            targets += [self._carrying(ScanTarget.of(one, shape, self._frame)) for one in _regions(region)]
        if measure != "scan":
            targets += [self._carrying(self._spectrum_target(one, kind)) for one in _places(at)]
        if not targets:
            raise InvalidValue(
                "a sweep measures nothing at its points", where="sweep", hint="list a region or position"
            )
        aside = None if not withdraw else () if withdraw is True else tuple(withdraw)
        settle_s = si_or_text(settle, "s")
        targets = [replace(one, aside=aside, settle_s=settle_s) for one in targets]
        key = key and check_key(key)
        of_others, of_microscope = partition(axis.name for axis in plan.axes)
        swept = [*of_others, *of_microscope]
        former = FormerTargets(swept, key, self._link, self._control, self._commands, self._targets, self._results)
        sweep = ParameterSweep(plan, targets, key, former, runner=self._runner, results=self._results)
        until_s = self._link.until(timeout_s)
        # others would measure at a swept temperature
        kept = self._control.hold(until_s=until_s, keeps=True) if of_others else nullcontext()
        with kept, self._giving_back(of_microscope), self._setting_back(former, timeout_s, aside):
            self._sweeps = True
            try:
                yield self._each_in_a_call(sweep.points(done, until_s))
            finally:
                self._sweeps = False
                self._commands.publish_settings((), "")

    @checked_call
    def sweep_at(
        self,
        parameter: str,
        values: SweptValues,
        read: str | Sequence[str],
        *,
        at: Place | None = None,
        settle: float | str = 0.0,
        kind: str | None = None,
        key: str | None = None,
        publish: Callable[[object, str | None], None] | None = None,
        timeout_s: float | None = None,
    ) -> Spectrum:
        """Set a parameter to each value at one place, read others after each set, and return all as a spectrum.

            scope.sweep_at("lab.rf", {"from": "13 GHz", "to": "17 GHz", "points": 101}, read="lab.x", settle="30 ms")

        The parameters are those of the microscope or of other instruments. Each reading is taken after its set: an
        instrument first arrives at its target, then `settle` passes, then each instrument measures. The variables of
        the spectrum have the names of the parameters; the first is the one that was set, with its values in force.
        Afterwards the parameter is set back. If control is lost on the way, the whole sweep is taken again.

        Args:
            values: a list, in this order, in which values may come again; or a range such as {"from": "13 GHz", "to":
                "17 GHz", "points": 101}.
            read: parameters to read after each set.
            at: (x, y) in m or as text, to move the probe to; None: the present position.
            settle: experiment time from each set to its readings, in s or as text.
            kind: kind of the spectrum; by default the name of the parameter that is set.
            key: name of the sweep, which is then taken only once in this run, as for `scan`.
            publish: records the spectrum: `publish=self.publish` in a component with `publishes = ("Spec1d",
                "MeasurementConditions")`. Without it the spectrum is only returned.

        Raises:
            InvalidValue: a value is no number, or the parameters to read are not valid.
        """
        axis, names = SweepAxis.of(parameter, values), (read,) if isinstance(read, str) else tuple(read)
        target = SpectrumTarget.of(at, kind or parameter, self._frame)
        sweep = PlacedSweep(axis, names, target, si_or_text(settle, "s"))
        key = key and check_key(key)
        _, of_microscope = partition([parameter])
        former = FormerTargets(
            [parameter], key, self._link, self._control, self._commands, self._targets, self._results
        )
        sweeper = PlacedSweeper(self._link, self._control, self._commands, self._targets, self._setup, self._results)
        with self._call():
            until_s = self._link.until(timeout_s)
            with self._giving_back(of_microscope), self._control.hold(until_s=until_s, keeps=True):
                with self._setting_back(former, timeout_s):
                    result = sweeper.take(sweep, key, former, until_s)
                if publish is not None:
                    publish(result.conditions, None)
                    publish(result.spectrum, f"Spec1d_{result.spectrum.kind}")
            return result.spectrum

    @checked_call
    @contextmanager
    def hold_z(
        self,
        offset: float | str,
        *,
        bias: float | str | None = None,
        speed: float | str = "100 pm/s",
        abort_current: float | str | None = None,
        abort_frequency_shift: float | str | None = None,
        timeout_s: float | None = None,
    ) -> Iterator[HeldHeight]:
        """Hold the tip in the block at an offset from the height of its setpoint, without feedback.

            with scope.hold_z(offset="-100 pm", bias="1 mV", abort_current="2 nA") as held:
                current_a = held.read("x-current")
                scans = scope.scan(region)

        The feedback is switched off and read as off, then the bias is set, then z is moved. The block may take scans
        and spectra, read values, and move on by `held.move`. At its end, also by an error, the translator sets back z,
        then bias, setpoint and gains, and switches the feedback on. It does so by itself if the component ends or loses
        control, which raises ControlLost at the next call or at the end of the block, and if a bound is reached, which
        raises Refused. Where the way back fails, the feedback stays off, and the tip is withdrawn.

        Args:
            offset: height in m or as text, negative towards the sample, which a limit on `x-held-z-offset` must allow.
            bias: bias while z is held; None: unchanged.
            speed: speed of z.
            abort_current, abort_frequency_shift: absolute values beyond which z is held no more, compared at each poll
                of the controller; None: no bound.

        Raises:
            Refused: the microscope can't hold z, a limit refuses, or z was held no more before the end of the block.
        """
        bounds = {names.HELD_Z_ABORT_CURRENT: abort_current, names.HELD_Z_ABORT_SHIFT: abort_frequency_shift}
        # 0 removes a bound of an earlier block; a microscope without such a value has none
        settings = [(names.HELD_Z_SPEED, speed), *((name, 0.0 if one is None else one) for name, one in bounds.items())]
        parameters = tuple(to_parameter(name, value, None) for name, value in settings)
        until_s = self._link.until(timeout_s)
        held = HeldHeight(parameters, until_s, link=self._link, control=self._control, commands=self._commands)
        with self._control.hold(until_s=until_s, unbroken=True, keeps=True):
            with self._call():
                held.prepare(offset)
            try:
                with self._call():
                    self._setup.lend(tuple(self._lent.values()), (), until_s, self._settle_s)
                    held.begin(offset, bias)
                self._setup.holds_z = True
                yield held
            except (ExperimentEnded, StopRequested, ControlLost):
                raise  # the scheduler has the way back begun
            except BaseException:  # also Ctrl-C, and what the block of the user raises
                with suppress(RequestError):  # the first error says more
                    held.release()
                raise
            finally:
                self._setup.holds_z = False
            with self._call():
                held.release()

    def _each_in_a_call(self, points: Iterator[SweepPoint]) -> Iterator[SweepPoint]:
        while True:
            with self._call():
                point = next(points, None)
            if point is None:
                return
            yield point

    @contextmanager
    def _setting_back(
        self, former: FormerTargets, timeout_s: float | None, aside: tuple[str, ...] | None = None
    ) -> Iterator[None]:
        # aside: the tip is withdrawn for it, and moved away by these actions
        try:
            yield
        except (ExperimentEnded, StopRequested):
            self._log_left_behind(former)
            raise
        except BaseException:  # also Ctrl-C, and what the block of the user raises
            with suppress(RequestError):  # logged; the first error says more
                self._set_back(former, SET_BACK_WITHIN_S, aside)
            raise
        self._set_back(former, timeout_s, aside)

    def _set_back(self, former: FormerTargets, timeout_s: float | None, aside: tuple[str, ...] | None) -> None:
        try:
            with self._call():
                until_s = self._link.until(timeout_s)
                if aside is not None and former.left_behind:
                    self._set_back_withdrawn(former, aside, until_s)
                else:
                    former.set_back(until_s)
        except (RequestError, ExperimentEnded, StopRequested):
            self._log_left_behind(former)
            raise

    def _set_back_withdrawn(self, former: FormerTargets, away: tuple[str, ...], until_s: float | None) -> None:
        while True:
            try:
                with self._control.hold(until_s=until_s, unbroken=True):
                    self._withdrawal.withdraw(until_s, away)
                    former.set_back(until_s)
                    break
            except ControlLost:
                self._control.regain(until_s)  # others may have brought the tip to the sample: from the beginning
        self._withdrawal.leave_withdrawn()
        self._link.log.info("the tip stays withdrawn, while the instruments go back")

    def _log_left_behind(self, former: FormerTargets) -> None:
        if former.left_behind:
            self._link.log.warning("the run ended before parameters were set back to %s", former.left_behind)

    @checked_call
    def forget(self, key: str) -> None:
        """Remove the saved result of a keyed measurement that is no longer needed, to save space in a long series."""
        self._results.forget(check_key(key))

    # --- setting and getting ---

    @checked_call
    def set(
        self,
        parameter: str,
        value: Value,
        unit: str | None = None,
        *,
        wait: bool = False,
        timeout_s: float | None = None,
    ) -> Value:
        """Set a parameter and return its value in force, in the same unit.

        Args:
            value: a number in `unit` (default: SI), a quantity as text ("0.5 V"), True, "on" …
            wait: whether to wait until a parameter of another instrument, such as a temperature, has arrived at
                `value`. The call then returns the measured value. Neither this wait nor that for a first reading,
                of a minute at most, needs control.

        Raises:
            NoResponse: with `wait`, the target was changed meanwhile, was not reached within the timeout, or the
                instrument has had no value for a minute.
        """
        with self._call():
            asked, until_s = to_parameter(parameter, value, unit), self._link.until(timeout_s)
            if wait:
                self._targets.first_reading(asked.name, until_s)
            response = self._commands.in_control(ControlRequest.PARAM, asked, until_s)
            in_force = value_in(response, asked, asked.unit)
            return self._targets.arrival(asked, float(in_force), until_s) if wait else in_force

    @checked_call
    def get(self, parameter: str, unit: str | None = None, *, timeout_s: float | None = ANSWER_S) -> Value:
        """Return a parameter's value in `unit`; without `unit`, in SI for base parameters, else as received.

        The value of another instrument, such as "lockin.x", is at most about a second old (its age at most in s:
        "lockin.x.age"), and never from before the last request that has changed something.
        """
        return self._get(parameter, unit, timeout_s)

    @checked_call
    def read(self, parameter: str, unit: str | None = None, *, timeout_s: float | None = ANSWER_S) -> Value:
        """Let an instrument measure a parameter now, and return the value, in the unit as for `get`.

        A parameter of the microscope is read from its controller, as by `get`.
        """
        return self._get(newest_of(parameter), unit, timeout_s)

    def _get(self, parameter: str, unit: str | None, timeout_s: float | None) -> Value:
        with self._call():
            return self._commands.value(parameter, unit, self._link.until(timeout_s))

    @checked_call
    def set_feedback(
        self,
        *,
        on: bool | None = None,
        proportional_gain: float | None = None,
        integral_gain: float | None = None,
        setpoint: float | None = None,
        timeout_s: float | None = None,
    ) -> None:
        """Set the given fields of the z feedback, and return once they are published; other fields stay unchanged.

        Args:
            on: whether the feedback regulates; if False, the tip is held at its height.
            proportional_gain, integral_gain: gains in the controller's own units.
            setpoint: in the unit of the operating mode: A for a tunnelling current; V, m, Hz or N in force microscopy.

        Raises:
            InvalidValue: a gain or the setpoint is not a finite number.
        """
        with self._call():
            feedback = Feedback(on, proportional_gain, integral_gain, setpoint)
            until_s = self._link.until(timeout_s)
            with self._control.hold(until_s=until_s):
                self._setup.set_feedback(feedback, until_s)

    @checked_call
    def move_probe(self, xy_m: Place, *, timeout_s: float | None = None) -> None:
        """Move the probe to (x, y), in m or as text, ("1 um", "0 nm"); return when it is there."""
        with self._call():
            until_s = self._link.until(timeout_s)
            with self._control.hold(until_s=until_s):
                self._setup.move_probe(xy_of(xy_m), until_s)

    @checked_call
    def set_scan_region(
        self, region: Region, *, shape: tuple[int, int] | None = None, timeout_s: float | None = None
    ) -> None:
        """Set the region of the next scan, and with `shape` (rows, columns) its pixels; return when they are in force.

        Both are sent in one request: after two requests, the frame between them might be refused.
        """
        with self._call():
            until_s = self._link.until(timeout_s)
            with self._control.hold(until_s=until_s):
                self._setup.set_scan(ScanTarget.of(region, shape, self._frame).parameters, until_s)

    @checked_call
    def action(self, name: str, *, timeout_s: float | None = None) -> None:
        """Start an action of the microscope by its name; return when the microscope has accepted it."""
        with self._call():
            self._commands.in_control(ControlRequest.ACTION, name, self._link.until(timeout_s))

    @checked_call
    def withdraw(self, *away: str, timeout_s: float | None = None) -> None:
        """Withdraw the tip, and move it away by the actions `away`, one after the other. Control must be held.

        The microscope shows the tip as withdrawn afterwards. `approach` brings it back.

        Raises:
            Refused: the microscope refuses, or shows the tip at the sample. NoResponse: it is not free in time.
        """
        with self._call():
            self._withdrawal.away(away, self._link.until(timeout_s))

    @checked_call
    def approach(self, *, timeout_s: float = APPROACH_S) -> None:
        """Bring the tip to the sample, and return when it has been read there twice, a second apart.

        The microscope's approach by the coarse motor (`x-approach`) is used, where there is one, otherwise `x-engage`.
        Control must be held.

        Args:
            timeout_s: real time after which the approach is given up; then the tip is withdrawn.

        Raises:
            Refused: the microscope refuses, or the tip is not at the sample; then it is withdrawn.
            NoResponse: the approach was given up.
        """
        with self._call():
            self._withdrawal.approach(self._link.until(timeout_s))

    @checked_call
    def tip_is_clear(self, *, timeout_s: float | None = ANSWER_S) -> None:
        """Say, for a person, that the tip is far enough from the sample for lateral moves, until it approaches again.

        Raises:
            Refused: as `feedback_may_be_off`.
        """
        self._say(names.TIP_IS_CLEAR, timeout_s)

    @checked_call
    def feedback_may_be_off(self, *, timeout_s: float | None = ANSWER_S) -> None:
        """Say, for a person, that the z feedback is off by intention; needs no control, and the mode MANUAL.

        Raises:
            Refused: the mode is not MANUAL, or this client speaks for no person with the role `approve`.
        """
        self._say(names.FEEDBACK_MAY_BE_OFF, timeout_s)

    @checked_call
    def keep_settings(self, *parameters: str) -> None:
        """Let plans measure with the values that a person has set in MANUAL; without parameters, with all of them.

        A plan that states another value measures with the one left, until it ends or `as_planned` is called. Without
        this call it sets its own again.

        Raises:
            Refused: the mode is not MANUAL, no plan would set another value, or this client is a component or agent.
        """
        self._ask_scheduler(KEEP_REQUEST, Settings.of(*map(Parameter, parameters)))

    @checked_call
    def as_planned(self, *parameters: str) -> None:
        """Let plans measure with the values that they state, in spite of what a person or a solver has decided.

        Raises:
            Refused: this client is a component or agent.
        """
        self._ask_scheduler(AS_PLANNED_REQUEST, Settings.of(*map(Parameter, parameters)))

    def _say(self, action: str, timeout_s: float | None) -> None:
        with self._call():
            response = self._commands.send(ControlRequest.ACTION, action, until_s=self._link.until(timeout_s))
            if not response.ok:
                raise refused(ControlRequest.ACTION, response, action)

    @checked_call
    def supports(self, action: str, *, timeout_s: float | None = ANSWER_S) -> bool:
        """Return whether the microscope has an action, such as "x-retract", without starting the action.

        Call it before `action`, which raises Refused for an action that the microscope does not have.
        """
        with self._call():
            response = self._commands.read(ControlRequest.ACTION_SUPPORT, action, self._link.until(timeout_s))
            if response.code in (ControlResponse.ACTION_NOT_SUPPORTED, ControlResponse.CMD_NOT_SUPPORTED):
                return False
            if not response.ok:
                raise refused(ControlRequest.ACTION_SUPPORT, response, action)
            return True

    # --- control ---

    @checked_call
    @contextmanager
    def control(
        self, *, solving: int | str | None = None, timeout_s: float | None = None, unbroken: bool = False
    ) -> Iterator[None]:
        """Wait for control, and keep control over all calls in the block.

        Within the block control may still be lost: to a problem, or to MANUAL. The next call then waits until control
        is back. If the problem to solve has been cleared meanwhile, this call raises ControlLost.

        Args:
            solving: the flagged problem to solve, by name or number.
            unbroken: whether all calls in the block belong together, such as a move of the probe and a pulse there.
                After a loss of control the next call then raises ControlLost, and does nothing: begin the block again,
                since others may have changed anything. `action` raises NoResponse if control was lost before the
                answer: its outcome is unknown. Inside another block, an unbroken block first waits for control.
        """
        number = Problem.NONE if solving is None else self.problems.number(solving)
        until_s = self._link.until(timeout_s)
        with self._control.hold(solving=number, until_s=until_s, unbroken=unbroken, keeps=True):
            yield

    @property
    def in_control(self) -> bool:
        """Return whether this component is in control now."""
        self._catch_up()
        return self._control.held

    @checked_call
    def flag(self, problem: int | str) -> None:
        """Flag a problem, by name or number.

        Until the flag is cleared, only components that solve a flagged problem get control.

        Raises:
            ExperimentEnded: the experiment has ended; the flag is sent all the same, for the record.
        """
        number = self.problems.number(problem)
        try:
            self._ask_scheduler(ControlRequest.ADD_EXP_PRBLM, number)
        except ExperimentEnded:
            self._link.send_only(ControlRequest.ADD_EXP_PRBLM, number)
            raise

    @checked_call
    def clear(self, problem: int | str) -> None:
        """Remove the flag of a problem; a problem without a flag is no error."""
        self._ask_scheduler(ControlRequest.RMV_EXP_PRBLM, self.problems.number(problem))

    def clear_all(self) -> tuple[str, ...]:
        """Remove the flags of all problems, and return their names."""
        flagged = sorted(self.control_state.problems)
        for problem in flagged:
            self.clear(problem)
        return tuple(map(self.problems.name, flagged))

    @checked_call
    def set_mode(self, mode: ControlMode) -> None:
        """Set MANUAL (no component has control) or AUTOMATED.

        Raises:
            InvalidValue: `mode` is not a ControlMode.
        """
        self._ask_scheduler(ControlRequest.SET_CONTROL_MODE, int(mode))

    @checked_call
    def restart(self, process: str) -> None:
        """Restart a process of the experiment, even a process that was given up."""
        self._ask_scheduler(RESTART_REQUEST, process)

    def approval_facts(self) -> Plain:
        """Return the facts on which an approval depends: run, limits, offset of the coordinates, and time."""
        with self._call():
            response = self._link.request(CLOCK_REQUEST)
        if not response.ok:
            raise refused(CLOCK_REQUEST, response, self._link.name)
        facts: Plain = json.loads(response.payload)
        return {name: facts.get(name) for name in ("run", "limits", "offset_m", "now_ns")}

    @checked_call
    def approve(self, grant: Grant) -> None:
        """Approve a plan of an agent, give the agent a grant, or revoke its approvals; needs the role `approve`."""
        self._ask_scheduler(GRANT_REQUEST, grant)

    def end_experiment(self) -> None:
        """End the experiment for all processes; the next call raises ExperimentEnded."""
        self._link.wait_caught_up()  # the signal KILL is sent once: the subscription must stand before the request
        with suppress(ExperimentEnded):  # the signal may come before the answer
            self._ask_scheduler(ControlRequest.END_EXPERIMENT, None)

    @checked_call
    def progress(self, done: int, of: int, *, left_s: float | None = None) -> None:
        """Publish the progress of the component, for display. Never waits.

        Args:
            done, of: number of finished parts, and of all parts.
            left_s: experiment time left; None: estimated from the rate since the first call, without times in MANUAL.
        """
        worked_s = self.worked_s()
        begun, begun_s = self._begun = self._begun or (done, worked_s)
        if left_s is None and done > begun:
            left_s = (worked_s - begun_s) / (done - begun) * (of - done)
        self._link.relay(Progress(self._link.clock.now_ns(), self._link.name, done, of, left_s))

    def worked_s(self) -> float:
        """Return the experiment time since this process has joined, without the time in MANUAL."""
        return self._link.worked_s()

    @checked_call
    def note(
        self, text: str, *, scan: HasTime | None = None, time_ns: int | None = None, key: str | None = None
    ) -> None:
        """Write a note about a scan or a moment (default: now) into the record of the run. Needs no control.

            scope.note("the tip changed here", scan=scans)

        Args:
            text: at most 1000 characters.
            scan: scan of the note: a `ScanSet`, a `Scan`, or a row of `Run.scans`.
            time_ns: moment of the note, experiment time; None: the end of the scan, or now.
            key: name of the note, which is then written only once in this run: after a restart of the component the
                call does nothing. Each note of a component needs its own key; a measurement may have the same.

        Raises:
            InvalidValue: the text is empty, too long, or has control characters other than line feeds and tabs; the
                end of the scan is unknown; or the key was used for another text.
        """
        if scan is not None and scan.time_ns is None:
            raise InvalidValue("the scan has no time of its end", hint="give time_ns instead")
        scan_ns, now_ns = None if scan is None else scan.time_ns, self._link.clock.now_ns()
        about_ns = next(one for one in (time_ns, scan_ns, now_ns) if one is not None)
        note = Note(about_ns, self._link.name, text, scan_ns, now_ns)
        if key is None:
            self._ask_scheduler(RELAY_REQUEST, RelayedMessage(*wire.encode(note)))
            return
        unwritten = self._results.intend_note(check_key(key), note)
        if unwritten is None:
            return
        # the same id and bytes in every life: the scheduler publishes the note once
        request_id = f"{self._link.name}/{KEYED}/{key}/note-{unwritten.written_ns}"
        try:
            self._ask_scheduler(RELAY_REQUEST, RelayedMessage(*wire.encode(unwritten)), request_id)
        except Refused:
            self._results.finish_note(key, is_written=False)
            raise
        self._results.finish_note(key, is_written=True)

    def announce(self, message: object, request_id: str = "") -> None:
        """Ask the scheduler to publish a message whose declaration is `relayed`, and wait until it has done so.

        A message whose answer is lost with the connection is published again.

        Args:
            request_id: id of the request, for a caller that repeats it after an error; by default a new one.

        Raises:
            Refused: the message is not declared as `relayed`, or is longer than 256 KB.
        """
        self._ask_scheduler(RELAY_REQUEST, RelayedMessage(*wire.encode(message)), request_id)

    def report_readings(self, report: InstrumentReadings) -> InstrumentOrders:
        """Report the values of this component's instrument, and return the orders for it.

        Raises:
            Refused: this component is no instrument of the experiment, or the report has parameters of others.
        """
        with self._call():
            response = self._link.request(RELAY_REQUEST, RelayedMessage(*wire.encode(report)))
            if not response.ok:
                raise refused(RELAY_REQUEST, response, self._link.name)
            return wire.decode_instrument_orders(response.payload)

    # --- leaving ---

    def interrupt(self) -> None:
        """Interrupt the call that waits in another thread, as Ctrl-C does; a measurement of the call is stopped."""
        self._link.interrupts.interrupt()

    def close(self) -> None:
        """Leave the experiment, and release control. `with afspm.connect() as scope:` does this by itself.

        A component's scope is closed by its loop.
        """
        with suppress(RequestError, ExperimentEnded, StopRequested):  # the scheduler notices a client that has left
            self._commands.give_back((), self._link.until(self._link.request_timeout_s))
        self._control.leave()
        self._link.leave()
        self._results.close()

    def __enter__(self) -> Scope:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- within ---

    @property
    def tenures(self) -> int:
        """Return the number of grants of control."""
        return self._control.tenures

    def give_back_inherited(self) -> None:
        """Release control that this component held before its restart. Called by the component's loop."""
        self._control.gives_back_inherited = True
        self._control.release_inherited()

    def _before_wait(self) -> None:
        # a script that waits outside of a block does not continue the block of its earlier life: others would wait for
        # ever, and the scheduler would not retract a tip left in danger
        self.give_back_inherited()

    def _ask_scheduler(self, kind: int, subject: object, request_id: str = "") -> None:
        with self._call():
            response = self._link.request(kind, subject, request_id=request_id)
            if not response.ok:
                raise refused(kind, response, self._link.name)


def _regions(given: Region | Sequence[Region] | None) -> Sequence[Region | None]:
    return [given] if given is None or isinstance(given, Region) else given


def _places(given: Place | Sequence[Place] | None) -> Sequence[object]:
    # (x, y), each a number or text, or a list of such pairs
    is_list = given is not None and all(isinstance(one, Sequence) and not isinstance(one, str) for one in given)
    return list(given) if given is not None and is_list else [given]
