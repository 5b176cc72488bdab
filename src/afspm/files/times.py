"""Times as files have them."""

from __future__ import annotations

from datetime import datetime, tzinfo


def local_ns(text: str, layout: str, zone: tzinfo | None) -> int:
    """Of a date and time of the controller's clock, ns since the Unix epoch.

    Raises:
        ValueError: it is not of that layout (as of `datetime.strptime`).
    """
    return clock_ns(datetime.strptime(text.strip(), layout), zone)  # noqa: DTZ007  (the zone comes next)


def clock_ns(time: datetime, zone: tzinfo | None) -> int:
    """The same of a time without a zone."""
    moment = time.astimezone() if zone is None else time.replace(tzinfo=zone)
    return round(moment.timestamp() * 1e6) * 1000
