"""The microscope as ophyd-async devices for Bluesky plans. Needs the extra `bluesky`.

    RE = RunEngine()
    with init_devices():
        scope = Microscope("runs", parameters=["tip-bias-voltage"])
    RE(bp.scan([scope.scan], scope.scan.center_x, -1e-6, 1e-6, 5))

The scheduler treats a plan like a notebook: the plan waits for control, limits hold, tip repairs come first. A
plan keeps control while the microscope is staged. An aborted plan stops its measurement. A device has `stage_sigs`, the
settings that its measurements carry:

    scope.scan.stage_sigs["tip-bias-voltage"] = "0.5 V"
"""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from afspm import Scope, connect
from afspm.basics import NS_PER_S, imports_of_extra
from afspm.client import Value, from_parameter, to_settings
from afspm.model import Region, names
from afspm.record import field_names

with imports_of_extra("bluesky", __name__):
    from bluesky.protocols import Reading, Triggerable
    from event_model import DataKey
    from ophyd_async.core import (
        AsyncStatus,
        Callback,
        SignalBackend,
        SignalRW,
        StandardReadable,
        StandardReadableFormat,
        soft_signal_rw,
    )

__all__ = ["Microscope"]

T = TypeVar("T")


class _PlanSession:
    """The connection to the experiment, used in its own thread since its calls block."""

    def __init__(self, where: str | Path, name: str) -> None:
        self.source = f"afspm://{Path(where).as_posix()}"
        self._open = partial(connect, where, name)
        # a scope blocks: its calls must not run in the event loop
        self._thread = ThreadPoolExecutor(1, "afspm")
        self._scope: Scope | None = None
        self._running: Future[Any] | None = None

    async def call(self, ask: Callable[[Scope], T]) -> T:
        """Call the scope in its thread and return the result. Cancelling the task interrupts the call."""
        self._running = asked = self._thread.submit(self._ask, ask)
        try:
            return await asyncio.wrap_future(asked)
        except asyncio.CancelledError:
            self.interrupt()
            raise

    def interrupt(self) -> None:
        """End the current call, which stops a measurement."""
        if self._scope is not None and self._running is not None and not self._running.done():
            self._scope.interrupt()

    def _ask(self, ask: Callable[[Scope], T]) -> T:
        # connected on first use, in the thread that uses it
        if self._scope is None:
            self._scope = self._open()
        try:
            return ask(self._scope)
        except KeyboardInterrupt:  # it would end the event loop
            raise InterruptedError("the measurement was stopped") from None


class _ParameterBackend(SignalBackend[float]):
    """A parameter by its generic name, in SI units."""

    def __init__(self, session: _PlanSession, parameter: str) -> None:
        super().__init__(float)
        self._session = session
        self._parameter = parameter
        self._callback: Callback[Reading[float]] | None = None
        self._reading = Reading(value=np.nan, timestamp=0.0)

    def source(self, name: str, read: bool) -> str:
        return f"{self._session.source}/{self._parameter}"

    async def connect(self, timeout: float) -> None:
        await asyncio.wait_for(self.get_reading(), timeout)

    async def put(self, value: float | None) -> None:
        if value is not None:
            self._take(await self._session.call(lambda scope: _timed(scope.set(self._parameter, value))))

    async def get_datakey(self, source: str) -> DataKey:
        unit = names.BASE_PARAMETERS.get(self._parameter)
        return DataKey(source=source, dtype="number", shape=[], units=unit or "")

    async def get_reading(self) -> Reading[float]:
        return self._take(await self._session.call(lambda scope: _timed(scope.get(self._parameter))))

    async def get_value(self) -> float:
        value: float = (await self.get_reading())["value"]
        return value

    async def get_setpoint(self) -> float:
        return await self.get_value()

    def set_callback(self, callback: Callback[Reading[float]] | None) -> None:
        self._callback = callback
        if callback is not None:
            callback(self._reading)

    def _take(self, reading: Reading[Value]) -> Reading[float]:
        self._reading = Reading(value=float(reading["value"]), timestamp=reading["timestamp"])
        if self._callback is not None:
            self._callback(self._reading)
        return self._reading


class _Measurement(StandardReadable, Triggerable):
    """A measurement at the position in its signals, with an array for each channel or variable.

    Attributes:
        stage_sigs: values by parameter, as numbers in SI or text with a unit. From `stage` to `unstage` each
            measurement carries them as its settings.
    """

    def __init__(self, session: _PlanSession, name: str = "") -> None:
        self._session = session
        self.stage_sigs: OrderedDict[str, Value] = OrderedDict()
        self._staged: dict[str, Value] = {}
        self._keys: dict[str, DataKey] = {}
        self._readings: dict[str, Reading[Any]] = {}
        super().__init__(name)

    async def describe(self) -> dict[str, DataKey]:
        described: dict[str, DataKey] = await super().describe()
        return described | {f"{self.name}-{field}": key for field, key in self._keys.items()}

    async def read(self) -> dict[str, Reading[Any]]:
        readings: dict[str, Reading[Any]] = await super().read()
        return readings | {f"{self.name}-{field}": reading for field, reading in self._readings.items()}

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Begin to measure with the settings in `stage_sigs`. Raises InvalidValue or UnitError for a wrong value."""
        for parameter in to_settings(self.stage_sigs).values():
            from_parameter(parameter, None)  # raises for a wrong unit, before anything is measured
        self._staged = dict(self.stage_sigs)

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Give back what the measurements have lent: the scheduler sets the values of before."""
        staged, self._staged = self._staged, {}
        if staged:
            await self._session.call(partial(_give_back, staged))

    async def describe_configuration(self) -> dict[str, DataKey]:
        described: dict[str, DataKey] = await super().describe_configuration()
        return described | {key: described_as for key, described_as, _ in self._settings()}

    async def read_configuration(self) -> dict[str, Reading[Any]]:
        readings: dict[str, Reading[Any]] = await super().read_configuration()
        return readings | {key: reading for key, _, reading in self._settings()}

    def _settings(self) -> Iterator[tuple[str, DataKey, Reading[Value]]]:
        # the staged settings alone: the documents show what the measurements carry
        for name, parameter in to_settings(self._staged).items():
            value, unit = from_parameter(parameter, None), names.BASE_PARAMETERS.get(name) or parameter.unit or ""
            key = DataKey(source=f"{self._session.source}/{name}", dtype="number", shape=[], units=unit)
            if not isinstance(value, float):
                key["dtype"] = "string" if isinstance(value, str) else "boolean"
            yield f"{self.name}-{name.replace('-', '_')}", key, _timed(value)

    async def _measured(self, ask: Callable[[Scope], T]) -> T | None:
        # None: the plan was aborted, and the measurement stopped
        self._keys, self._readings = {}, {}
        try:
            return await self._session.call(ask)
        except InterruptedError:
            return None

    def _keep(
        self, channels: Sequence[str], units: Sequence[str], arrays: Sequence[NDArray[np.float64]], time_s: float
    ) -> None:
        fields = field_names(channels, (name for name, _ in self.children()))  # a channel may be named as a signal
        self._keys = {
            field: DataKey(
                source=f"{self._session.source}/{channel}", dtype="array", dtype_numpy="<f8", units=unit,
                shape=list(values.shape),
            )
            for field, channel, unit, values in zip(fields, channels, units, arrays, strict=True)
        }  # fmt: skip
        self._readings = {
            field: Reading(value=np.asarray(values), timestamp=time_s)
            for field, values in zip(fields, arrays, strict=True)
        }


class ScanDevice(_Measurement):
    """A scan device: `trigger` takes a scan, and a reading gives all its channels, [y, x], both ascending.

    Signals `center_x`, `center_y`, `size_x`, `size_y` (m) and `angle` (rad) set the region, `rows` and `columns` its
    pixels.
    """

    def __init__(self, session: _PlanSession, name: str = "") -> None:
        with self.add_children_as_readables(StandardReadableFormat.UNCACHED_SIGNAL):
            self.center_x = soft_signal_rw(float, units="m")
            self.center_y = soft_signal_rw(float, units="m")
            self.size_x = soft_signal_rw(float, 1e-6, units="m")
            self.size_y = soft_signal_rw(float, 1e-6, units="m")
            self.angle = soft_signal_rw(float, units="rad")
        with self.add_children_as_readables(StandardReadableFormat.CONFIG_SIGNAL):
            self.rows = soft_signal_rw(int, 128)
            self.columns = soft_signal_rw(int, 128)
        super().__init__(session, name)

    @AsyncStatus.wrap
    async def trigger(self) -> None:
        signals = (self.center_x, self.center_y, self.size_x, self.size_y, self.angle)
        x, y, width, height, angle = [await signal.get_value() for signal in signals]
        shape = (await self.rows.get_value(), await self.columns.get_value())
        region = Region((x, y), (width, height), angle)
        scans = await self._measured(lambda scope: scope.scan(region, shape=shape, settings=self._staged))
        if scans is None:
            return
        taken = list(scans.values())
        time_s = (taken[0].time_ns or 0) / NS_PER_S
        self._keep(list(scans), [one.unit for one in taken], [one.values for one in taken], time_s)


class SpectrumDevice(_Measurement):
    """A spectrum device: `trigger` takes a spectrum at `x`, `y` (m), and a reading gives its variables."""

    def __init__(self, session: _PlanSession, name: str = "") -> None:
        with self.add_children_as_readables(StandardReadableFormat.UNCACHED_SIGNAL):
            self.x = soft_signal_rw(float, units="m")
            self.y = soft_signal_rw(float, units="m")
        with self.add_children_as_readables(StandardReadableFormat.CONFIG_SIGNAL):
            self.kind = soft_signal_rw(str, "")
        super().__init__(session, name)

    @AsyncStatus.wrap
    async def trigger(self) -> None:
        at, kind = (await self.x.get_value(), await self.y.get_value()), await self.kind.get_value()
        taken = await self._measured(lambda scope: scope.spectrum(at, kind=kind or None, settings=self._staged))
        if taken is None:
            return
        self._keep(taken.names, taken.units, list(taken.values.T), (taken.time_ns or 0) / NS_PER_S)


class Microscope(StandardReadable):
    """A running experiment's microscope.

    Args:
        where: the folder of the run, of all runs, or the experiment file, as for `afspm.connect`.
        parameters: generic names of the parameters that become signals: "tip-bias-voltage" becomes `tip_bias_voltage`.
            All signals are in SI units.
        client: the name under which the plan holds control.

    Attributes:
        scan: a `ScanDevice`; spectrum: a `SpectrumDevice`.
    """

    def __init__(
        self, where: str | Path = "runs", parameters: Sequence[str] = (), client: str = "bluesky", name: str = ""
    ) -> None:
        self._session = session = _PlanSession(where, client)
        self._held = ExitStack()
        with self.add_children_as_readables(StandardReadableFormat.CONFIG_SIGNAL):
            for parameter in parameters:
                # without ophyd's timeout of 10 s: like a notebook, the plan waits for control while the tip is repaired
                signal = SignalRW(_ParameterBackend(session, parameter), timeout=None)
                setattr(self, parameter.replace("-", "_"), signal)
        self.scan = ScanDevice(session)
        self.spectrum = SpectrumDevice(session)
        super().__init__(name)

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Stage the devices, and wait for control, which is then kept until `unstage`."""
        await self.scan.stage()  # a plan stages the root of its devices alone
        await self.spectrum.stage()
        await self._session.call(lambda scope: self._held.enter_context(scope.control()))

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Stop the present measurement, give its settings back, and release control."""
        self._session.interrupt()
        try:
            await self.scan.unstage()
            await self.spectrum.unstage()
        finally:
            await self._session.call(lambda _: self._held.close())


def _give_back(settings: Mapping[str, Value], scope: Scope) -> None:
    # the end of a block gives back; nothing is set at its begin
    with scope.settings(settings):
        pass


def _timed(value: T) -> Reading[T]:
    return Reading(value=value, timestamp=time.time())
