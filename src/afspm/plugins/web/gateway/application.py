"""The web application of the gateway: routes by subject, and one model for every refusal."""

from __future__ import annotations

import contextlib
import re
from collections.abc import AsyncIterator, Collection
from http import HTTPStatus
from importlib import metadata
from math import ceil

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.responses import Response

from afspm.basics import Plain
from afspm.plugins.web.asgi import AsgiApp, Message, Receive, Send
from afspm.plugins.web.gateway.command_routes import CommandRoutes
from afspm.plugins.web.gateway.guard import GatewayGuard, answer
from afspm.plugins.web.gateway.problems import RefusalCode, RefusalModel, RefusedRequest, of_error
from afspm.plugins.web.gateway.reading_routes import ReadingRoutes
from afspm.plugins.web.gateway.services import GatewayServices
from afspm.plugins.web.passwords import Passwords

PREFIX = "/v1"
ABOUT = """The experiment over HTTP. Every client that may look can read. To command, send a name and its token, request
control, and renew its lease. The scheduler treats each request like one of a component: limits hold, and the record
keeps each action under `<gateway>:<name>`. All values are in SI units."""
_REFUSED: dict[int | str, dict[str, object]] = {
    "4XX": {"model": RefusalModel, "description": "The request was refused, with the reason."},
    "5XX": {"model": RefusalModel, "description": "No answer, or an error of the gateway."},
    422: {"model": RefusalModel, "description": "The request is invalid, or a limit refuses it."},
}


def application(
    services: GatewayServices, passwords: Passwords, *, host: str, origins: Collection[str] = ()
) -> AsgiApp:
    """Return the application, protected by the guard."""

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        services.bell.attach()
        yield

    app = FastAPI(
        title="afspm gateway", version=metadata.version("afspm"), description=ABOUT, lifespan=lifespan,
        docs_url=None, redoc_url=None, responses=_REFUSED, generate_unique_id_function=lambda route: route.name,
    )  # fmt: skip
    for routes in (ReadingRoutes(services), CommandRoutes(services)):
        app.include_router(routes.router(), prefix=PREFIX)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _no_route)

    async def refused(_: Request, error: Exception) -> Response:
        response = answer(refusal := of_error(error))
        if refusal.again_ns is not None:
            clock = services.watch.clock
            response.headers["Retry-After"] = str(max(1, ceil(clock.real_s(refusal.again_ns * 1e-9 - clock.now_s()))))
        return response

    for error in (RefusedRequest, Exception):
        app.add_exception_handler(error, refused)
    # outside of FastAPI: an unauthorised request must not reach a validator
    guarded: AsgiApp = GatewayGuard(_answering_head(app), passwords, host, origins)
    if not origins:
        return guarded
    methods, headers = ("GET", "POST", "PUT", "DELETE"), ("Authorization", "Content-Type", "Last-Event-ID")
    allowing: AsgiApp = CORSMiddleware(
        guarded,
        allow_origins=tuple(origins),
        allow_methods=methods,
        allow_headers=headers,
        expose_headers=("Location", "Retry-After"),
    )
    return allowing


def _answering_head(app: AsgiApp) -> AsgiApp:
    # FastAPI's routes know no HEAD: it is answered as GET, without the body, which may be an endless stream of events
    async def answering(scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                await send({"type": "http.response.body"})

        await app({**scope, "method": "GET"}, receive, send_head)

    return answering


async def _invalid(_: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    wrong = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
    return answer(RefusedRequest(RefusalCode.INVALID, "; ".join(wrong)[:1000]))


async def _no_route(asked: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    code = {
        HTTPStatus.NOT_FOUND: RefusalCode.NOT_FOUND,
        HTTPStatus.METHOD_NOT_ALLOWED: RefusalCode.METHOD_NOT_ALLOWED,
    }.get(HTTPStatus(error.status_code), RefusalCode.INVALID)
    response = answer(RefusedRequest(code, f"{asked.method} {asked.url.path[:200]}: {error.detail}"))
    if code is RefusalCode.METHOD_NOT_ALLOWED:
        response.headers["Allow"] = ", ".join(_methods(asked.app.openapi()["paths"], asked.url.path))
    return response


def _methods(paths: Plain, path: str) -> list[str]:
    # each method of a path is a route of its own
    for template, of_path in paths.items():
        if re.fullmatch(re.sub(r"{\w+}", "[^/]+", template), path):
            methods = [method.upper() for method in of_path]
            return ["HEAD", *methods] if "GET" in methods else methods
    return []
