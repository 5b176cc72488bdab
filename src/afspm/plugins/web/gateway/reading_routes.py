"""Routes for all clients, even without a name: state, parameters, scans, spectra, events."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Header, Path, Query
from numpy.typing import NDArray
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from afspm.basics import iso_utc
from afspm.components import Levelling
from afspm.model import ControlMode, ControlResponse, ControlState, Spectrum, names
from afspm.model import Response as ModelResponse
from afspm.night import ScanSummary, SpectrumSummary
from afspm.plugins.web.gateway import views
from afspm.plugins.web.gateway.models import (
    PARAMETER,
    ActionModel,
    ArrayModel,
    EventKind,
    ParameterModel,
    ProblemModel,
    ScanModel,
    SpectrumFormat,
    SpectrumModel,
    StateModel,
    ValueFormat,
    event_kinds,
)
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest, refused
from afspm.plugins.web.gateway.services import GatewayServices
from afspm.plugins.web.gateway.stream import MOST_STREAMS, server_sent
from afspm.plugins.web.person_commands import PersonCommands

NEWEST = "newest"
FRESH_S = 1.0
MOST_KEPT = 200
_KNOWN = (*names.BASE_PARAMETERS, *names.EXTENSION_PARAMETERS)
_LACKING = (ControlResponse.PARAM_NOT_SUPPORTED, ControlResponse.CMD_NOT_SUPPORTED)
_ACTIONS = (*names.BASE_ACTIONS, *names.EXTENSION_ACTIONS)
Which = Annotated[str, Path(pattern=r"^([0-9]{1,20}|newest)$", examples=[NEWEST], description="an id, or `newest`")]
Parameter = Annotated[str, Path(pattern=PARAMETER, examples=["scan-speed"])]
Limit = Annotated[int, Query(ge=1, le=500)]
After = Annotated[str, Query(pattern=r"^[0-9]{1,19}$", description="only those newer than this id")]
_VALUES: dict[int | str, dict[str, object]] = {
    200: {
        "model": ArrayModel,
        "description": "the values in the format asked for",
        "content": {"application/octet-stream": {}, "image/png": {}},
    }
}
_EVENTS: dict[int | str, dict[str, object]] = {
    200: {
        "description": "Server-sent events: `id`, `event` (a kind) and `data` (an EventModel) until the end.",
        "content": {"text/event-stream": {"schema": {"type": "string"}}},
    }
}


class ParameterCache:
    """Values of parameters, each read from the microscope at most once a second for all clients together."""

    def __init__(self, services: GatewayServices) -> None:
        self._services = services
        self._asked: dict[str, tuple[float, asyncio.Task[ModelResponse]]] = {}
        self._lacking: set[str] = set()

    async def all(self) -> list[ParameterModel]:
        """Return the known parameters that the microscope has."""
        wanted = [name for name in _KNOWN if name not in self._lacking]
        responses = await asyncio.gather(*map(self._response, wanted))
        self._lacking.update(name for name, one in zip(wanted, responses, strict=True) if one.code in _LACKING)
        return [views.parameter_model(name, one) for name, one in zip(wanted, responses, strict=True) if one.ok]

    async def one(self, name: str) -> ParameterModel:
        """Return a parameter. Raises RefusedRequest if the microscope does not return a value."""
        response = await self._response(name)
        if not response.ok:
            raise refused(response)
        return views.parameter_model(name, response)

    async def _response(self, name: str) -> ModelResponse:
        # a program that polls must not keep the microscope busy: one read serves all clients for a second
        now_s = asyncio.get_running_loop().time()
        known = self._asked.get(name)
        if known is None or now_s - known[0] >= FRESH_S:
            while len(self._asked) >= MOST_KEPT:
                del self._asked[next(iter(self._asked))]
            task = asyncio.ensure_future(self._services.read(lambda commands: commands.get(name)))
            known = self._asked[name] = now_s, task
        # shielded: other clients may wait for the same read
        return await asyncio.shield(known[1])


class ReadingRoutes:
    """Routes answered from published messages and the record; parameters and actions are read from the microscope."""

    def __init__(self, services: GatewayServices) -> None:
        self._services = services
        self._watch = services.watch
        self._parameters = ParameterCache(services)

    def router(self) -> APIRouter:
        router = APIRouter()
        for path, answers, model in (
            ("/state", self.state, StateModel),
            ("/parameters", self.parameters, list[ParameterModel]),
            ("/parameters/{name}", self.parameter, ParameterModel),
            ("/actions", self.actions, list[ActionModel]),
            ("/problems", self.problems, list[ProblemModel]),
            ("/scans", self.scans, list[ScanModel]),
            ("/scans/{which}", self.scan, ScanModel),
            ("/spectra", self.spectra, list[SpectrumModel]),
            ("/spectra/{which}", self.spectrum, SpectrumModel),
        ):
            router.get(path, response_model=model)(answers)
        router.get("/scans/{which}/values", responses=_VALUES, response_model=None)(self.scan_values)
        router.get("/spectra/{which}/values", responses=_VALUES, response_model=None)(self.spectrum_values)
        router.get("/events", responses=_EVENTS, response_model=None)(self.events)
        return router

    async def state(self, asked: Request) -> StateModel:
        """Return the state of the experiment and the microscope."""
        services, watch = self._services, self._watch
        person = services.person_of(asked)
        who = services.persons.name_of(person) if person else None
        newest_ns = services.history.newest_ns
        with watch.reading() as overview:
            control = overview.control or ControlState(ControlMode.UNDEFINED)
            return StateModel(
                experiment=services.experiment,
                simulated=services.simulated,
                time=iso_utc(watch.clock.now_ns()),
                mode=control.mode.name,
                holder=control.holder,
                problems=[watch.problems.name(number) for number in control.problems],
                microscope=views.microscope(overview),
                you=who,
                in_control=who is not None and control.holder == who,
                ended=watch.ended,
                silent_s=round(watch.silent_s(), 3),
                last_event=None if newest_ns is None else str(newest_ns),
            )

    async def parameters(self) -> list[ParameterModel]:
        """Return the parameters of the microscope with the values in force."""
        return await self._parameters.all()

    async def parameter(self, name: Parameter) -> ParameterModel:
        """Return a parameter with its value in force."""
        return await self._parameters.one(name)

    async def actions(self) -> list[ActionModel]:
        """Return the known actions that the microscope has."""

        def supported(commands: PersonCommands) -> list[str]:
            return [name for name in _ACTIONS if commands.supports(name).ok]

        return [ActionModel(name=name) for name in await self._services.read(supported)]

    async def problems(self) -> list[ProblemModel]:
        """Return all problems of the experiment, flagged or not."""
        with self._watch.reading() as overview:
            flagged = () if overview.control is None else overview.control.problems
            known = self._watch.problems
            return [ProblemModel(name=name, flagged=known[name] in flagged) for name in known if known[name]]

    async def scans(self, after: After = "0", limit: Limit = 100) -> list[ScanModel]:
        """Return the newest scans, oldest first."""
        with self._watch.reading() as overview:
            found = [one for one in views.scans(overview) if one[0].time_ns > int(after)]
        return [views.scan_model(one) for one in found[-limit:]]

    async def scan(self, which: Which) -> ScanModel:
        """Return a scan without its values."""
        return views.scan_model(self._scan(which))

    async def spectra(self, after: After = "0", limit: Limit = 100) -> list[SpectrumModel]:
        """Return the newest spectra, oldest first."""
        with self._watch.reading() as overview:
            found = [one for one in overview.spectra if one.time_ns > int(after)]
        return [views.spectrum_model(one) for one in found[-limit:]]

    async def spectrum(self, which: Which) -> SpectrumModel:
        """Return a spectrum without its values."""
        return views.spectrum_model(self._spectrum(which))

    async def scan_values(
        self,
        which: Which,
        channel: Annotated[str, Query(max_length=200)] = "",
        format: ValueFormat = ValueFormat.NPY,
        levelling: Levelling = Levelling.PLANE,
    ) -> Response:
        """Return the values of a channel, by default the first; a picture is levelled, other formats are not."""
        channels = self._scan(which)
        wanted = next((one for one in channels if channel in ("", one.channel)), None)
        if wanted is None:
            raise RefusedRequest(RefusalCode.NOT_FOUND, f"the scan has no channel {channel!r}")
        values = await asyncio.to_thread(self._values, wanted)
        return await _values(which, values, [wanted.unit], format, lambda: views.as_png(values, levelling))

    async def spectrum_values(
        self,
        which: Which,
        format: SpectrumFormat = SpectrumFormat.NPY,
    ) -> Response:
        """Return the values of a spectrum, a column for each variable."""
        spectrum = await asyncio.to_thread(self._spectrum_values, self._spectrum(which).time_ns)
        return await _values(which, spectrum.values, list(spectrum.units), ValueFormat(format.value), bytes)

    async def events(
        self,
        kinds: Annotated[list[EventKind] | None, Query(description="by default all")] = None,
        after: Annotated[str | None, Query(pattern=r"^[0-9]{1,19}$", description="as Last-Event-ID")] = None,
        last_event_id: Annotated[
            str | None, Header(pattern=r"^[0-9]{1,19}$", description="sent by EventSource")
        ] = None,
    ) -> Response:
        """Stream the published events: from now on, or after an event."""
        services = self._services
        if services.streams.is_full:
            raise RefusedRequest(RefusalCode.TOO_MANY, f"{MOST_STREAMS} streams of events are open")
        told, newest_ns = last_event_id or after, services.history.newest_ns
        after_ns = int(told) if told else (-1 if newest_ns is None else newest_ns)
        wanted = frozenset(kinds or event_kinds())
        stream = server_sent(services.history, self._watch, services.bell, after_ns, wanted)
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        counted = services.streams.counted(stream)
        return StreamingResponse(counted, media_type="text/event-stream", headers=headers)

    def _scan(self, which: str) -> list[ScanSummary]:
        with self._watch.reading() as overview:
            known = views.scans(overview)
        found = next((one for one in reversed(known) if which in (NEWEST, views.scan_id(one))), None)
        if found is None:
            raise RefusedRequest(RefusalCode.NOT_FOUND, f"there is no scan {which}")
        return found

    def _spectrum(self, which: str) -> SpectrumSummary:
        with self._watch.reading() as overview:
            known = overview.spectra
        found = next((one for one in reversed(known) if which in (NEWEST, str(one.time_ns))), None)
        if found is None:
            raise RefusedRequest(RefusalCode.NOT_FOUND, f"there is no spectrum {which}")
        return found

    def _spectrum_values(self, time_ns: int) -> Spectrum:
        with self._watch.reading():
            spectrum = self._watch.spectra.at(time_ns)
        spectrum = spectrum or self._services.archive.spectrum(time_ns)
        if spectrum is None:
            raise RefusedRequest(RefusalCode.GONE, "the values of this spectrum are not kept here any more")
        return spectrum

    def _values(self, scan: ScanSummary) -> NDArray[np.float64]:
        with self._watch.reading():
            frame = self._watch.frames.kept(scan.time_ns, scan.channel)
        frame = frame or self._services.archive.frame(scan.time_ns, scan.channel)
        if frame is None:
            raise RefusedRequest(RefusalCode.GONE, "the values of this scan are not kept here any more")
        return frame.values


async def _values(
    which: str, values: NDArray[np.float64], units: list[str], wanted: ValueFormat, draw: Callable[[], bytes]
) -> Response:
    # the values of an id never change; a cache must not answer a request for the newest with an earlier scan
    kept = "no-store" if which == NEWEST else "private, max-age=3600"
    headers = {"Cache-Control": kept, "X-Shape": ",".join(map(str, values.shape))}
    match wanted:
        case ValueFormat.PNG:
            return Response(await asyncio.to_thread(draw), media_type="image/png", headers=headers)
        case ValueFormat.BASE64:
            return StreamingResponse(views.as_base64(values, units), media_type="application/json", headers=headers)
    return StreamingResponse(views.as_npy(values), media_type="application/octet-stream", headers=headers)
