"""Scans and spectra requested by clients: each is begun once for its key, and tracked to its end.

Each measurement is saved before its start: a restarted gateway continues, using the scheduler's replay.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from inspect import GEN_CREATED, getgeneratorstate
from pathlib import Path

from afspm import Memory
from afspm.basics import Plain
from afspm.client import BEGUN_WITHIN_S, Cycle, CycleOutcome, ScanTarget, Target, target_from
from afspm.model import ControlResponse, Response, Scan, ScopeStatus, Spectrum
from afspm.model.sessions import KEYED
from afspm.plugins.web.gateway.models import MeasurementModel, MeasurementState
from afspm.plugins.web.gateway.problems import RefusalCode, RefusalModel, RefusedRequest, refused
from afspm.plugins.web.person_commands import PersonCommands
from afspm.plugins.web.watch import Watch

MOST_KEPT = 10_000
"""Measurements that are remembered, newest first: a client may begin an older key again."""
_RUNNING, _DONE, _FAILED = (one.value for one in MeasurementState)
_WHY = {
    CycleOutcome.INTERRUPTED: (RefusalCode.INTERRUPTED, "it was stopped before its end"),
    CycleOutcome.VANISHED: (RefusalCode.NO_RESULT, "the microscope is free again without a result"),
    CycleOutcome.ANOTHER: (
        RefusalCode.NO_RESULT,
        "another measurement than requested was taken: does another program set the microscope?",
    ),
}


@dataclass
class Measurement:
    """A scan or spectrum requested by a client, as saved on disk.

    Attributes:
        who: the client's name, as the scheduler knows it.
        plan: the target in JSON's types.
        attempt: number of the last attempt; requests with the same id are executed once.
        since_ns: older results belong to earlier measurements.
        refusal: fields of a `RefusalModel`, for a failed measurement.
        is_certain: False while the microscope may or may not have carried out the last attempt.
    """

    who: str
    key: str
    plan: Plain
    attempt: int = 0
    since_ns: int = -1
    state: str = _RUNNING
    result: str | None = None
    refusal: dict[str, object] | None = None
    is_certain: bool = True

    @property
    def request_id(self) -> str:
        return f"{self.who}/{KEYED}/{self.key}/{self.attempt}"

    def model(self) -> MeasurementModel:
        state = MeasurementState(self.state)
        refusal = None if self.refusal is None else RefusalModel.model_validate(self.refusal)
        return MeasurementModel(id=self.key, kind=self.plan["what"], state=state, result=self.result, refusal=refusal)


@dataclass
class _Following:
    """The progress of a measurement that was requested from the scheduler."""

    measurement: Measurement
    target: Target
    cycle: Cycle
    since_s: float
    result_ns: int = 0

    def take(self, thing: object, time_ns: int) -> None:
        """Process a published message."""
        if isinstance(thing, ScopeStatus):
            self.cycle.on_state(thing.state, time_ns)
        elif isinstance(thing, Scan if isinstance(self.target, ScanTarget) else Spectrum):
            self.cycle.on_result(thing, time_ns)
            if self.cycle.results and self.cycle.results[0] is thing:  # a scan is known by its first channel
                self.result_ns = thing.time_ns or time_ns


class Measurements:
    """The measurements of all clients. Thread-safe.

    Args:
        file: file that keeps the measurements over a restart; None: measurements end with this process.
        now_s: clock in real, monotonic seconds.
    """

    def __init__(self, file: Path | None, watch: Watch, now_s: Callable[[], float]) -> None:
        self._memory = Memory(file)
        self._watch = watch
        self._now_s = now_s
        self._lock = threading.RLock()
        self._kept: dict[tuple[str, str], Measurement] = {}
        self._followed: dict[tuple[str, str], _Following] = {}
        for facts in self._memory.get("measurements", ()):
            one = Measurement(**facts)
            self._kept[one.who, one.key] = one
            if one.state == _RUNNING:
                self._follow(one, resumed=True)

    def find(self, who: str, key: str) -> Measurement | None:
        """Return a client's measurement by its key; None without one."""
        with self._lock:
            if (one := self._followed.get((who, key))) is not None:
                self._settle_if_never_begun(one)
            return self._kept.get((who, key))

    def take(self, who: str, key: str | None, target: Target) -> Callable[[PersonCommands], Measurement]:
        """Return a function that begins a measurement in the person's thread, or raises RefusedRequest.

        A measurement already begun under its key is not begun again, unless it failed. A key of another target is
        refused.
        """
        return lambda commands: self._begin(commands, who, key or secrets.token_hex(8), target)

    def on_packet(self, thing: object, time_ns: int) -> None:
        """Process a published message."""
        with self._lock:
            for key, one in list(self._followed.items()):
                one.take(thing, time_ns)
                if one.cycle.outcome is not None:
                    del self._followed[key]
                    self._settle(one, one.cycle.outcome)

    # --- within ---

    def _begin(self, commands: PersonCommands, who: str, key: str, target: Target) -> Measurement:
        plan = target.facts()
        # the key with another target would return another measurement than requested
        with self._lock:
            known = self.find(who, key)
            if known is not None and known.plan != plan:
                raise RefusedRequest(RefusalCode.KEY_USED, f"the key {key} is of another measurement")
            if known is not None and known.state != _FAILED:
                return known
        if isinstance(target, ScanTarget):
            refusal = commands.prepare_scan(target.region, target.shape)
        else:
            refusal = commands.prepare_spectrum(target.at_m)
        if refusal is not None:
            raise refused(refusal)
        one = known or Measurement(who, key, plan)
        attempts = self._attempts(one)
        response = commands.act_when_free(target.action, partial(next, attempts), target.settings)
        if getgeneratorstate(attempts) == GEN_CREATED:  # a setting was refused: the key stays free for other values
            raise refused(response)
        return self._begun(one, response)

    def _attempts(self, one: Measurement) -> Generator[str]:
        # a caller takes the next id only after a refusal of the attempt before
        while True:
            yield self._next_attempt(one)
            one.is_certain = True

    def _next_attempt(self, one: Measurement) -> str:
        # on disk before its use; an attempt of unknown outcome is repeated under its own id
        with self._watch.reading() as overview:
            newest_ns = overview.newest_ns
        with self._lock:
            if one.is_certain or not one.attempt:
                one.attempt, one.since_ns = one.attempt + 1, newest_ns
            one.state, one.result, one.refusal, one.is_certain = _RUNNING, None, None, False
            self._kept[one.who, one.key] = one
            self._follow(one, resumed=False)
            self._save()
        return one.request_id

    def _begun(self, one: Measurement, response: Response) -> Measurement:
        key = (one.who, one.key)
        with self._lock:
            followed = self._followed.get(key)
            # the measurement may begin, or even end, before the answer arrives
            is_seen = followed is None or followed.cycle.begun
            if response.ok or is_seen:
                one.is_certain = True
                self._save()
                return one
            error = refused(response)
            one.is_certain = response.code != ControlResponse.NO_RESPONSE
            if one.is_certain:
                del self._followed[key]
            one.state, one.refusal = _FAILED, error.model.model_dump(mode="json")
            self._save()
        raise error

    def _follow(self, one: Measurement, *, resumed: bool) -> None:
        target = target_from(one.plan)
        cycle = Cycle(target.busy, target.fits, since_ns=one.since_ns, resumed=resumed)
        self._followed[one.who, one.key] = _Following(one, target, cycle, self._now_s())

    def _settle_if_never_begun(self, one: _Following) -> None:
        if not one.cycle.begun and one.measurement.is_certain and self._now_s() - one.since_s > BEGUN_WITHIN_S:
            del self._followed[one.measurement.who, one.measurement.key]
            self._settle(one, CycleOutcome.VANISHED)

    def _settle(self, one: _Following, outcome: CycleOutcome) -> None:
        measurement = one.measurement
        measurement.is_certain = True
        if outcome is CycleOutcome.COMPLETED:
            measurement.state, measurement.refusal = _DONE, None
            measurement.result = str(one.result_ns)
        else:
            error = RefusedRequest(*_WHY[outcome])
            measurement.state, measurement.refusal = _FAILED, error.model.model_dump(mode="json")
        self._save()

    def _save(self) -> None:
        while len(self._kept) > MOST_KEPT:
            oldest = next(key for key, one in self._kept.items() if key not in self._followed)
            del self._kept[oldest]
        # no `asdict`: it copies each plan, which takes half a second for many measurements
        self._memory["measurements"] = [dict(vars(one)) for one in self._kept.values()]
        self._memory.save()
