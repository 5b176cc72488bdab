"""Values of parameters, asked for at most once a second however many want them."""

from __future__ import annotations

import asyncio

from afspm.model import ControlResponse, Response, names
from afspm.plugins.web.gateway.models import ParameterModel
from afspm.plugins.web.gateway.problems import refused
from afspm.plugins.web.gateway.services import GatewayServices
from afspm.plugins.web.gateway.views import parameter_model

FRESH_S = 1.0
MOST_KEPT = 200
_KNOWN = (*names.BASE_PARAMETERS, *names.EXTENSION_PARAMETERS)
_LACKING = (ControlResponse.PARAM_NOT_SUPPORTED, ControlResponse.CMD_NOT_SUPPORTED)


class ParameterCache:
    """Asks for parameters, one client for all that want the same."""

    def __init__(self, services: GatewayServices) -> None:
        self._services = services
        self._asked: dict[str, tuple[float, asyncio.Task[Response]]] = {}
        self._lacking: set[str] = set()

    async def all(self) -> list[ParameterModel]:
        """Return the known parameters that the microscope has."""
        wanted = [name for name in _KNOWN if name not in self._lacking]
        responses = await asyncio.gather(*map(self._response, wanted))
        self._lacking.update(name for name, one in zip(wanted, responses, strict=True) if one.code in _LACKING)
        return [parameter_model(name, one) for name, one in zip(wanted, responses, strict=True) if one.ok]

    async def one(self, name: str) -> ParameterModel:
        """Return a parameter. Raises RefusedRequest if it can't be read."""
        response = await self._response(name)
        if not response.ok:
            raise refused(response)
        return parameter_model(name, response)

    async def _response(self, name: str) -> Response:
        now_s = asyncio.get_running_loop().time()
        known = self._asked.get(name)
        if known is None or now_s - known[0] >= FRESH_S:
            while len(self._asked) >= MOST_KEPT:
                del self._asked[next(iter(self._asked))]
            task = asyncio.ensure_future(self._services.read(lambda commands: commands.get(name)))
            known = self._asked[name] = now_s, task
        return await asyncio.shield(known[1])
