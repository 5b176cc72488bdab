"""The interface between server and application, and the check of where a request comes from."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Mapping, MutableMapping
from typing import Any
from urllib.parse import urlsplit

from afspm.web.passwords import is_loopback

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
    if only_here and not is_loopback(_host_of(host)):
        return f"this {what} serves only this computer, not {host!r}"
    if origin is not None and origin not in allowed and urlsplit(origin).netloc != host:
        return f"a page of {origin} may not send requests to this {what}"
    return None


def _host_of(netloc: str) -> str:
    try:
        return urlsplit(f"//{netloc}").hostname or ""
    except ValueError:
        return ""
