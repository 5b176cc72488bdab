"""The parts that the page is made of: sections, tables, pictures that enlarge; times in UTC with local ones beside."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC
from html import escape

from afspm.basics.clock import NS_PER_S, utc_time
from afspm.basics.formatting import day, day_and_time, period_text, time_of_day

_DAY_NS = 86_400 * NS_PER_S


class PageTimes:
    """Times of a run as the page tells them: in UTC, and in this computer's zone where that is another.

    Args:
        start_ns, end_ns: of the run.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start_ns, self._end_ns = start_ns, end_ns
        self._days = end_ns - start_ns > _DAY_NS
        self.is_local = any(_offset_s(time_ns) for time_ns in (start_ns, end_ns))
        self.zone = utc_time(start_ns).astimezone().strftime("%Z") or "local"

    def utc(self, time_ns: int) -> str:
        """Return a time in UTC; with the day, where there are several."""
        time = time_of_day(time_ns, UTC)
        return f"{day(time_ns, UTC)} {time}" if self._days else time

    def both(self, time_ns: int) -> str:
        """Return a time as HTML, the local one small below."""
        local = f"<small>{time_of_day(time_ns)} {escape(self.zone)}</small>" if self.is_local else ""
        return f"{self.utc(time_ns)}{local}"

    def whole(self, time_ns: int) -> str:
        """Return day and time, and the local ones."""
        local = f" ({time_of_day(time_ns)} {self.zone})" if self.is_local else ""
        return f"{day_and_time(time_ns, UTC)}{local}"

    def period(self) -> str:
        """Return the time of the run."""
        local = f" ({period_text(self._start_ns, self._end_ns)} {self.zone})" if self.is_local else ""
        return f"{period_text(self._start_ns, self._end_ns, UTC)}{local}"


def section(heading: str, content: str) -> str:
    """Return a part of the page; nothing without content."""
    if not content:
        return ""
    return f"<section>{f'<h2>{escape(heading)}</h2>' if heading else ''}{content}</section>"


def table(heads: Iterable[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of cells that are HTML already; empty without rows."""
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
    """Return a figure that fills the page while its name is in the address.

    Args:
        name: of the figure on the page.
        shown, caption: HTML of the picture, and of the line below it.
        facts: what is told beside it when it is large: names, and HTML.
        beside: names of those before and after it; empty: there is none.
        style: classes; ratio: width by height; place: in a grid, as CSS has it.
    """
    told = "".join(f"<dt>{escape(head)}</dt><dd>{text}</dd>" for head, text in facts.items() if text)
    steps = "".join(
        f'<a href="#{other}">{word}</a>' for word, other in zip(("‹ before", "next ›"), beside, strict=True) if other
    )
    return (
        f'<figure id="{name}" class="{style}" style="--ratio:{ratio:.5g};{place}"><div class="view">'
        f'<a class="back more" href="#close" aria-label="close"></a><a class="open" href="#{name}">{shown}</a>'
        f'<div class="more"><dl>{told}</dl><div class="steps">{steps}<a href="#close">close</a></div></div></div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _lines(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    for row in rows:
        yield f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>"


def _offset_s(time_ns: int) -> float:
    offset = utc_time(time_ns).astimezone().utcoffset()
    return offset.total_seconds() if offset else 0.0
