"""Routes for clients with a name: control, measurements, settings, actions, problems, mode, notes and the end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query
from fastapi.security import HTTPBasic, HTTPBearer
from starlette.requests import Request
from starlette.responses import Response as HttpResponse

from afspm.basics import AfspmError, Plain
from afspm.client import ScanTarget, SpectrumTarget, Target, Value, to_settings, xy_of
from afspm.model import WAIT_FOR_CONTROL, ControlMode, ControlState, Region, Response, names
from afspm.plugins.web.gateway.measurements import Measurement
from afspm.plugins.web.gateway.models import (
    KEY,
    ControlAsked,
    ControlModel,
    DoneModel,
    LeaseModel,
    MeasurementModel,
    MeasurementState,
    ModeModel,
    NoteAsked,
    ParameterChange,
    ParameterModel,
    ProblemModel,
    ScanAsked,
    SpectrumAsked,
)
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest, of_error, refused
from afspm.plugins.web.gateway.reading_routes import Parameter
from afspm.plugins.web.gateway.services import GatewayServices
from afspm.plugins.web.gateway.views import parameter_model
from afspm.plugins.web.person_commands import PersonCommands

LONGEST_WAIT_S = 25.0
"""Proxies often cut off requests after 30 s."""
PUBLISHED_WITHIN_S = 1.0
Wait = Annotated[float, Query(ge=0.0, le=LONGEST_WAIT_S, description="longest wait, s")]
Name = Annotated[str, Path(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
_SECURITY = (Depends(HTTPBasic(auto_error=False)), Depends(HTTPBearer(auto_error=False)))
_URGENT = frozenset({names.STOP_SCAN, names.STOP_SPEC, names.RETRACT})
_CONTROL, _LEASE, _SCAN, _SPECTRUM = ControlAsked(), LeaseModel(), ScanAsked(), SpectrumAsked()  # without a body


class CommandRoutes:
    """Routes that send requests to the scheduler, each under the client's name."""

    def __init__(self, services: GatewayServices) -> None:
        self._services = services
        self._bell = services.bell

    def router(self) -> APIRouter:
        router = APIRouter(dependencies=[*_SECURITY, Depends(self._services.who)])
        accepted: Plain = {"status_code": 202, "response_model": MeasurementModel}
        router.post("/control", response_model=ControlModel)(self.request_control)
        router.put("/control", response_model=ControlModel)(self.renew_control)
        router.delete("/control", response_model=DoneModel)(self.release_control)
        router.post("/scans", **accepted)(self.take_scan)
        router.post("/spectra", **accepted)(self.take_spectrum)
        router.get("/measurements/{key}", response_model=MeasurementModel)(self.measurement)
        router.put("/parameters/{name}", response_model=ParameterModel)(self.set_parameter)
        router.post("/actions/{name}", response_model=DoneModel)(self.act)
        router.put("/problems/{name}", response_model=ProblemModel)(self.flag_problem)
        router.delete("/problems/{name}", response_model=ProblemModel)(self.clear_problem)
        router.put("/mode", response_model=ModeModel)(self.set_mode)
        router.post("/notes", response_model=DoneModel)(self.write_note)
        router.post("/end", response_model=DoneModel)(self.end_experiment)
        return router

    # --- control ---

    async def request_control(
        self, asked: Request, wanted: ControlAsked = _CONTROL, wait_s: Wait = 0.0
    ) -> ControlModel:
        """Request control, with a lease. Renew the lease in time: after its end you lose control."""
        problem = self._problem(wanted.solving) if wanted.solving is not None else 0
        until_s = asyncio.get_running_loop().time() + wait_s

        def take(commands: PersonCommands) -> Response:
            response = commands.request_control(problem)
            return commands.renew(wanted.lease_s) if response.ok else response

        while True:
            response = await self._services.do(asked, take)
            left_s = until_s - asyncio.get_running_loop().time()
            if response.ok:
                await self._published(lambda control: control.holder == self._services.who(asked))
                return ControlModel(holder=self._services.who(asked), lease_s=wanted.lease_s)
            if response.code not in WAIT_FOR_CONTROL or left_s <= 0.0 or await asked.is_disconnected():
                raise refused(response)
            await self._control_changed(left_s)

    async def renew_control(self, asked: Request, lease: LeaseModel = _LEASE) -> ControlModel:
        """Renew the lease. The request fails with `not-in-control` once control is lost."""
        # the renewal must not wait behind a measurement that waits for a free microscope
        await self._services.command(asked, lambda commands: commands.renew(lease.lease_s), meanwhile=True)
        return ControlModel(holder=self._services.who(asked), lease_s=lease.lease_s)

    async def release_control(self, asked: Request) -> DoneModel:
        """Release control."""
        await self._services.command(asked, lambda commands: commands.release_control())
        await self._published(lambda control: control.holder != self._services.who(asked))
        return DoneModel()

    # --- measurements ---

    async def take_scan(self, asked: Request, answer: HttpResponse, wanted: ScanAsked = _SCAN) -> MeasurementModel:
        """Begin a scan, in control. The answer comes once the microscope accepts it; then poll the measurement."""
        given = wanted.region
        region = None if given is None else Region(xy_of(given.center_m), xy_of(given.size_m), given.angle_rad)
        shape = None if wanted.shape is None else (wanted.shape[0], wanted.shape[1])
        target = ScanTarget.of(region, shape, self._services.frame)
        return await self._measure(asked, answer, wanted.key, target, wanted.settings)

    async def take_spectrum(
        self, asked: Request, answer: HttpResponse, wanted: SpectrumAsked = _SPECTRUM
    ) -> MeasurementModel:
        """Begin a spectrum, in control. The answer comes once the microscope accepts it; then poll the measurement."""
        target = SpectrumTarget.of(wanted.position_m, None, self._services.frame)
        return await self._measure(asked, answer, wanted.key, target, wanted.settings)

    async def measurement(self, asked: Request, key: Annotated[KEY, Path()], wait_s: Wait = 0.0) -> MeasurementModel:
        """Return a measurement of yours, at its end or when the waiting time is over."""
        who, until_s = self._services.who(asked), asyncio.get_running_loop().time() + wait_s
        while True:
            found = self._services.measurements.find(who, key)
            if found is None:
                raise RefusedRequest(RefusalCode.NOT_FOUND, f"{who} has no measurement {key}")
            left_s = until_s - asyncio.get_running_loop().time()
            if found.state != MeasurementState.RUNNING.value or left_s <= 0.0 or await asked.is_disconnected():
                return found.model()
            await self._bell.wait(min(left_s, 1.0))

    # --- the microscope ---

    async def set_parameter(self, asked: Request, name: Parameter, wanted: ParameterChange) -> ParameterModel:
        """Set a parameter, in control; return the value then in force."""
        value, unit = wanted.value, wanted.unit
        response = await self._services.command(asked, lambda commands: commands.set(name, value, unit))
        return parameter_model(name, response, value)

    async def act(self, asked: Request, name: Name) -> DoneModel:
        """Start an action of the microscope, in control; return once it is accepted. `stop-scan` stops a scan."""
        if name in (names.START_SCAN, names.START_SPEC):
            raise RefusedRequest(RefusalCode.NOT_SUPPORTED, f"request {name} by POST /v1/scans or /v1/spectra")
        await self._services.command(asked, lambda commands: commands.act(name), urgent=name in _URGENT)
        return DoneModel()

    # --- the experiment ---

    async def flag_problem(self, asked: Request, name: Name) -> ProblemModel:
        """Flag a problem."""
        number = self._problem(name)
        await self._services.command(asked, lambda commands: commands.flag(number))
        await self._published(lambda control: number in control.problems)
        return ProblemModel(name=name, flagged=True)

    async def clear_problem(self, asked: Request, name: Name) -> ProblemModel:
        """Clear a problem."""
        number = self._problem(name)
        await self._services.command(asked, lambda commands: commands.clear(number))
        await self._published(lambda control: number not in control.problems)
        return ProblemModel(name=name, flagged=False)

    async def set_mode(self, asked: Request, wanted: ModeModel) -> ModeModel:
        """Set MANUAL, in which no component is in control, or AUTOMATED."""
        mode = ControlMode[wanted.mode]
        await self._services.command(asked, lambda commands: commands.set_mode(mode), urgent=True)
        await self._published(lambda control: control.mode is mode)
        return wanted

    async def write_note(self, asked: Request, wanted: NoteAsked) -> DoneModel:
        """Write a remark into the record, about a scan or the present. The request needs no control."""
        scan_ns = None if wanted.scan is None else int(wanted.scan)
        await self._services.command(asked, lambda commands: commands.note(wanted.text, scan_ns))
        return DoneModel()

    async def end_experiment(self, asked: Request) -> DoneModel:
        """End the experiment for everyone."""
        try:
            await self._services.command(asked, lambda commands: commands.end(), urgent=True)
        except RefusedRequest as error:
            if error.model.code is not RefusalCode.EXPERIMENT_ENDED:  # the end may be published before the answer
                raise
        return DoneModel()

    # --- within ---

    async def _measure(
        self,
        asked: Request,
        answer: HttpResponse,
        key: str | None,
        target: Target,
        settings: Mapping[str, Value] | None,
    ) -> MeasurementModel:
        try:
            stated = to_settings(settings or {})
        except AfspmError as error:
            raise of_error(error) from error
        # in one order: the members of a JSON object have none, and a key sent again must have the same settings
        target = replace(target, settings=tuple(stated[name] for name in sorted(stated)))
        begin = self._services.measurements.take(self._services.who(asked), key, target)
        begun: Measurement = await self._services.do(asked, begin)
        answer.headers["Location"] = f"measurements/{begun.key}"  # relative: a proxy may serve this on another path
        return begun.model()

    def _problem(self, name: str) -> int:
        try:
            return self._services.watch.problems.number(name)
        except AfspmError as error:
            raise RefusedRequest(RefusalCode.NOT_FOUND, str(error)) from error

    async def _published(self, holds: Callable[[ControlState], bool]) -> None:
        # a client must read what it has set; bounded, in case the publication does not arrive
        loop, watch = asyncio.get_running_loop(), self._services.watch
        until_s = loop.time() + PUBLISHED_WITHIN_S
        while (left_s := until_s - loop.time()) > 0.0:
            if watch.overview.control is not None and holds(watch.overview.control):
                return
            await self._bell.wait(left_s)

    async def _control_changed(self, within_s: float) -> None:
        # bounded, in case the change of control does not arrive
        loop, watch = asyncio.get_running_loop(), self._services.watch
        until_s, before = loop.time() + min(within_s, 5.0), watch.overview.control
        while (left_s := until_s - loop.time()) > 0.0 and watch.overview.control is before:
            await self._bell.wait(left_s)
