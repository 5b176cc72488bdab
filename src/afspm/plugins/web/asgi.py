"""The interface between server and application, and the check of a request's origin."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Mapping, MutableMapping
from typing import Any
from urllib.parse import SplitResult, urlsplit

from afspm.plugins.web.passwords import is_loopback

Message = MutableMapping[str, Any]
Send = Callable[[Message], Awaitable[None]]
Receive = Callable[[], Awaitable[Message]]
AsgiApp = Callable[[Message, Receive, Send], Awaitable[None]]


def wrong_origin(
    headers: Mapping[str, str], *, only_here: bool, what: str = "dashboard", allowed: Collection[str] = ()
) -> str | None:
    """Return the reason for refusing a request, from its Host and Origin; None for an allowed request.

    Pages of other sites in the same browser must not steer a microscope. On loopback, pages whose host name resolves to
    this server's address are refused, too (DNS rebinding).

    Args:
        only_here: the server listens on loopback only.
        what: the name of the server, for the reason.
        allowed: origins of other pages that may send requests.
    """
    host, origin = headers.get("host", ""), headers.get("origin")
    asked = _parts(f"//{host}")
    if asked is None:
        return f"{host[:100]!r} can't be the name of a computer"
    if only_here and not is_loopback(asked.hostname or ""):
        return f"this {what} serves only this computer, not {host[:100]!r}"
    if origin is not None and origin not in allowed:
        page = _parts(origin)
        if page is None or page.netloc != host:
            return f"a page of {origin[:100]} may not send requests to this {what}"
    return None


def _parts(url: str) -> SplitResult | None:
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018  # raises, as the others do
    except ValueError:
        return None
    return parts
