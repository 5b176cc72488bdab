"""Building blocks of the page: sections, tables, enlarging pictures, and times in UTC and local time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC
from html import escape

from afspm.basics import time_of_day, utc_time, zone_offset_s
from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import day, day_and_time, period_text
from afspm.report.style import CSS

_DAY_NS = 86_400 * NS_PER_S


class PageTimes:
    """A formatter of times of a run: in UTC, and in this computer's zone where that differs.

    Args:
        start_ns, end_ns: start and end of the run.

    Attributes:
        zone: the name of the local zone; both names if the clock was changed during the run.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start_ns, self._end_ns = start_ns, end_ns
        self._days = end_ns - start_ns > _DAY_NS
        self.is_local = any(zone_offset_s(time_ns) for time_ns in (start_ns, end_ns))
        self._zones = tuple(_zone(time_ns) for time_ns in (start_ns, end_ns))
        self.zone = ", then ".join(dict.fromkeys(self._zones))

    def utc(self, time_ns: int) -> str:
        """Return a time in UTC, with the day if the run spans several days."""
        time = time_of_day(time_ns, UTC)
        return f"{day(time_ns, UTC)} {time}" if self._days else time

    def both(self, time_ns: int) -> str:
        """Return a time as HTML, with the local time small below."""
        local = f"<small>{time_of_day(time_ns)} {escape(_zone(time_ns))}</small>" if self.is_local else ""
        return f"{self.utc(time_ns)}{local}"

    def whole(self, time_ns: int) -> str:
        """Return day and time in UTC, with the local time in brackets."""
        local = f" ({time_of_day(time_ns)} {_zone(time_ns)})" if self.is_local else ""
        return f"{day_and_time(time_ns, UTC)}{local}"

    def period(self) -> str:
        """Return the period of the run."""
        utc, local = (period_text(self._start_ns, self._end_ns, zone) for zone in (UTC, None))
        if not self.is_local:
            return utc
        before, after = self._zones
        if before != after:
            local = local.replace(" to ", f" {before} to ")
        return f"{utc} ({local} {after})"


def document(title: str, body: str, css: str = "") -> str:
    """Return a whole page in the style of the report; `title` and `body` are HTML already."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{CSS}{css}</style></head><body><main>{body}</main></body></html>\n"
    )


def section(heading: str, content: str) -> str:
    """Return a section of the page; empty without content."""
    if not content:
        return ""
    return f"<section>{f'<h2>{escape(heading)}</h2>' if heading else ''}{content}</section>"


def table(heads: Iterable[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of cells, which are HTML already; empty without rows."""
    if not rows:
        return ""
    head = "".join(f"<th>{escape(one)}</th>" for one in heads)
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(_lines(rows))}</tbody></table></div>'
    )


def figure(
    name: str,
    shown: str,
    caption: str,
    facts: Mapping[str, str],
    *,
    beside: tuple[str, str] = ("", ""),
    style: str,
    ratio: float = 1.0,
    place: str = "",
) -> str:
    """Return the HTML of a figure that fills the page while its name is the anchor in the address.

    Args:
        name: the anchor of the figure on the page.
        shown, caption: HTML of the picture, and of its caption.
        facts: shown beside the enlarged picture: names, and HTML.
        beside: names of the previous and next figure; empty if there is none.
        style: CSS classes.
        ratio: width divided by height.
        place: place in a grid, as CSS.
    """
    entries = "".join(f"<dt>{escape(head)}</dt><dd>{text}</dd>" for head, text in facts.items() if text)
    steps = "".join(
        f'<a href="#{other}">{word}</a>' for word, other in zip(("‹ before", "next ›"), beside, strict=True) if other
    )
    return (
        f'<figure id="{name}" class="{style}" style="--ratio:{ratio:.5g};{place}"><div class="view">'
        f'<a class="back more" href="#close" aria-label="close"></a><a class="open" href="#{name}">{shown}</a>'
        f'<div class="more"><dl>{entries}</dl><div class="steps">{steps}<a href="#close">close</a></div></div></div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _lines(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    for row in rows:
        yield f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>"


def _zone(time_ns: int) -> str:
    # summer time may begin or end during the run
    return utc_time(time_ns).astimezone().strftime("%Z") or "local"
