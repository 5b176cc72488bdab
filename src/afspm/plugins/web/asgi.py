"""The interface between server and application, and the check of where a request comes from."""

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
    """Return why a request is not answered, by its Host and Origin; None: it may be.

    A page of somebody else that is open in the same browser must not be able to steer a microscope, nor one that gave
    its own name our address.

    Args:
        only_here: the server listens on loopback only.
        what: is asked, for the reason.
        allowed: origins of other pages that may ask.
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
