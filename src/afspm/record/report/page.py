"""The report as one HTML page: no script, nothing from elsewhere, light and dark, and fit to be printed."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC
from html import escape
from pathlib import Path

from afspm.clock import NS_PER_S
from afspm.drawing import timeline
from afspm.formatting import area_text, day, duration_text, period_text, time_of_day, typeset
from afspm.record.report.pictures import Small
from afspm.record.report.story import MOST_ROWS, RunStory, colours, sentence, states_in_words, timeline_rows
from afspm.record.timeline import Timeline

_DAY_NS = 86_400_000_000_000
_LEGEND = (
    "The bar below a scan has the colour of who was in control; framed: a problem was flagged, or it was interrupted."
)


def html(story: RunStory, shown: Sequence[Small], figures: Sequence[Path]) -> str:
    """The whole page."""
    title = f"{escape(story.name)}, {day(story.start_ns, UTC)}"
    badge = '<span class="badge">SIMULATED</span>' if story.simulated else ""
    body = [
        f"<header><h1>{escape(story.name)}{badge}</h1><p>{escape(_when(story))}</p></header>",
        _section("", _cards(story)),
        _section(
            "Time line",
            f'<div class="scroll">{_timeline(story)}</div>'
            + '<p class="note">Times in UTC, as the experiment had them.</p>',
        ),
        _section("What the time went into", _shares(story)),
        _section("Problems and repairs", _problems(story)),
        _section("Notes", _notes(story)),
        _section("Scans", _sheet(story, shown)),
        _section("Figures", "".join(map(_figure, figures))),
        _section("Refusals", _refusals(story)),
        _section("Restarts", _restarts(story)),
        f"<footer>{escape(story.folder)}</footer>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{CSS}</style></head><body><main>{''.join(body)}</main></body></html>\n"
    )


def _timeline(story: RunStory) -> str:
    return timeline.timeline_html(timeline_rows(story), story.start_ns, story.end_ns, UTC)


def _when(story: RunStory) -> str:
    told = f"{period_text(story.start_ns, story.end_ns, UTC)}, {duration_text(story.lasted_ns / NS_PER_S)}"
    if story.speed != 1.0:
        told += f" ({duration_text(story.lasted_ns / NS_PER_S / story.speed)} real)"
    return f"{told}; {story.ended}"


def _cards(story: RunStory) -> str:
    interrupted = f"and {story.interrupted} interrupted" if story.interrupted else ""
    flags = len(story.problems)
    unsolved = sum(span.end_ns is None for span in story.problems)
    cards = [
        ("scans", len(story.scans) - story.interrupted, interrupted),
        ("spectra", story.spectra, ""),
        ("problems flagged", flags, f"{unsolved} still flagged at the end" if unsolved else ""),
        ("refusals", sum(one.count for one in story.refusals), ""),
        ("restarts", len(story.restarts), f"given up: {', '.join(story.given_up)}" if story.given_up else ""),
    ]
    made = [
        f'<div class="card"><b>{number}</b><span>{what}</span><small>{escape(note)}</small></div>'
        for what, number, note in cards
    ]
    return f'<p class="lead">{escape(sentence(story))}</p><div class="cards">{"".join(made)}</div>'


def _shares(story: RunStory) -> str:
    seen, styles = story.overview, colours(story)
    return '<div class="shares">' + "".join(
        [
            _share_table(story, "in control", seen.controls, styles),
            _share_table(story, "microscope", seen.states, {}),
            _share_table(story, "mode", seen.modes, {"manual": "manual"}),
        ]
    ) + "</div>"  # fmt: skip


def _share_table(story: RunStory, heading: str, lane: Timeline, styles: dict[str, str]) -> str:
    rows = []
    for label, ns in story.shares(lane):
        part = 100.0 * ns / max(1, story.lasted_ns)
        style = styles.get(label, "state")
        words = label if styles else states_in_words(label)
        bar = '<svg class="share" viewBox="0 0 100 10" preserveAspectRatio="none">'
        bar += f'<rect class="{style}" width="{part:.2f}" height="10"/></svg>'
        rows.append([escape(words), bar, duration_text(ns / NS_PER_S), f"{part:.0f} %"])
    return _table([heading, "", "", ""], rows) if rows else ""


def _problems(story: RunStory) -> str:
    rows = []
    for span in story.problems:
        end_ns = story.end_ns if span.end_ns is None else span.end_ns
        rows.append(
            [
                escape(span.label),
                _clock(story, span.start_ns),
                escape(span.by or "not known"),
                escape(", ".join(story.repairs(span)) or "nobody"),
                escape(", ".join(story.done_meanwhile(span))),
                duration_text((end_ns - span.start_ns) / NS_PER_S),
                "<b>not solved</b>" if span.end_ns is None else _clock(story, end_ns),
            ]
        )
    for entry in story.seen_late:
        name = escape(story.problem_name(entry))
        rows.append([name, _clock(story, entry.time_ns), escape(entry.who), "", "", "", "<b>seen after the end</b>"])
    return (
        _table(["problem", "flagged", "by", "in control meanwhile", "done to the tip", "for", "cleared"], rows)
        or "<p>None.</p>"
    )


def _notes(story: RunStory) -> str:
    rows = [
        [
            _clock(story, note.time_ns),
            "" if note.scan is None else f"scan {note.scan}",
            escape(note.who),
            f'<span class="text">{escape(note.text)}</span>',
        ]
        for note in story.notes
    ]
    return _table(["when", "on", "by", "note"], rows)


def _sheet(story: RunStory, shown: Sequence[Small]) -> str:
    if not shown:
        return "<p>None.</p>"
    styles = colours(story)
    left_out = len(story.scans) - len(shown)
    note = f'<p class="note">{left_out} more are not shown.</p>' if left_out else ""
    note += f'<p class="note">{_LEGEND}</p>'
    return f'<div class="sheet">{"".join(_thumb(small, story, styles) for small in shown)}</div>{note}'


def _thumb(small: Small, story: RunStory, styles: dict[str, str]) -> str:
    row = small.row
    width, height = row.region.size_m if row.region else (1.0, 1.0)
    picture = (
        f'<img src="{_data(small.png)}" alt="" style="aspect-ratio:{width / height:.4g}">'
        if small.picture is not None
        else '<div class="none">no values</div>'
    )
    size = typeset(area_text(row.region.size_m)) if row.region else ""
    is_bad = row.interrupted or bool(row.problems)
    mark = " <b>interrupted</b>" if row.interrupted else ""
    style = styles.get(row.holder or "", "state")
    holder = f"{row.holder or 'nobody'} in control"
    title = ", ".join(filter(None, (f"scan {row.number}", small.channel, size, holder, *row.problems, row.filename)))
    return (
        f'<figure class="{"bad" if is_bad else ""}" title="{escape(title)}">{picture}<i class="{style}"></i>'
        f"<figcaption>{row.number} · {_clock(story, row.time_ns)}{mark}</figcaption></figure>"
    )


def _figure(path: Path) -> str:
    return (
        f'<figure class="figure"><img src="{_data(path.read_bytes())}" alt="{escape(path.stem)}">'
        f"<figcaption>{escape(path.name)}</figcaption></figure>"
    )


def _refusals(story: RunStory) -> str:
    rows = [
        [
            _clock(story, one.first_ns) + (f" … {_clock(story, one.last_ns)}" if one.count > 1 else ""),
            str(one.count),
            escape(one.who),
            escape(one.what),
            escape(one.reason),
        ]
        for one in story.refusals[:MOST_ROWS]
    ]
    left_out = len(story.refusals) - len(rows)
    more = f'<p class="note">{left_out} more are in the record.</p>' if left_out else ""
    return (_table(["when", "times", "who", "asked for", "refused because"], rows) or "<p>None.</p>") + more


def _restarts(story: RunStory) -> str:
    rows = [
        [_clock(story, one.time_ns), escape(one.name), str(one.starts), escape(one.last_exit)]
        for one in story.restarts[:MOST_ROWS]
    ]
    return _table(["when", "process", "start number", "had ended"], rows) or "<p>None.</p>"


def _section(heading: str, content: str) -> str:
    if not content:
        return ""
    return f"<section>{f'<h2>{escape(heading)}</h2>' if heading else ''}{content}</section>"


def _table(heads: Iterable[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already; empty without rows."""
    if not rows:
        return ""
    head = "".join(f"<th>{escape(one)}</th>" for one in heads)
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(_lines(rows))}</tbody></table></div>'
    )


def _lines(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    for row in rows:
        yield f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>"


def _data(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _clock(story: RunStory, time_ns: int) -> str:
    """With the day, where there are several."""
    several = story.lasted_ns > _DAY_NS
    return f"{day(time_ns, UTC)} {time_of_day(time_ns, UTC)}" if several else time_of_day(time_ns, UTC)


# P. Tol's bright scheme: told apart by everybody, red kept for problems
CSS = (
    timeline.CSS
    + """
:root{--lane:var(--panel);--quiet:var(--soft)}
:root{--paper:#fff;--ink:#1b1b1b;--soft:#666;--rule:#ddd;--panel:#f5f5f5;--state:#888;--problem:#c9304a;
--manual:#d9a400;--c0:#4477aa;--c1:#228833;--c2:#aa3377;--c3:#3a9fc0;--c4:#9a8a1c;color-scheme:light dark}
@media(prefers-color-scheme:dark){:root{--paper:#16181b;--ink:#e8e8e8;--soft:#a0a0a0;--rule:#34383d;--panel:#1f2327;
--state:#8a8f96;--problem:#ff6b81;--manual:#f0c040;--c0:#79a8dc;--c1:#5cbf6c;--c2:#e07ab8;--c3:#7fd0ea;--c4:#d6c65a}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:15px/1.45 system-ui,sans-serif}
main{max-width:1080px;margin:0 auto;padding:1.2rem}
h1{font-size:1.7rem;margin:.2rem 0}h2{font-size:1.15rem;margin:2rem 0 .6rem;border-bottom:1px solid var(--rule)}
header p,.note,footer,figcaption,small{color:var(--soft)}
.badge{margin-left:.8rem;padding:.1rem .5rem;border-radius:.3rem;background:var(--problem);color:var(--paper);
font-size:.9rem;vertical-align:middle;letter-spacing:.08em}
.lead{font-size:1.05rem}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(9rem,1fr));gap:.6rem}
.card{background:var(--panel);border-radius:.5rem;padding:.7rem .9rem;display:flex;flex-direction:column}
.card b{font-size:1.6rem;line-height:1.2}
.lanes{min-width:640px}.lane span.state{background:var(--state)}.lane span.problem{background:var(--problem)}
.lane span.manual{background:var(--manual)}.lane span.c0{background:var(--c0)}.lane span.c1{background:var(--c1)}
.lane span.c2{background:var(--c2)}.lane span.c3{background:var(--c3)}.lane span.c4{background:var(--c4)}
rect.state{fill:var(--state)}rect.problem{fill:var(--problem)}rect.manual{fill:var(--manual)}
rect.c0{fill:var(--c0)}rect.c1{fill:var(--c1)}rect.c2{fill:var(--c2)}rect.c3{fill:var(--c3)}rect.c4{fill:var(--c4)}
i{display:block;height:4px;margin-top:2px}i.state{background:var(--state)}i.c0{background:var(--c0)}
i.c1{background:var(--c1)}i.c2{background:var(--c2)}i.c3{background:var(--c3)}i.c4{background:var(--c4)}
.shares{display:grid;grid-template-columns:repeat(auto-fit,minmax(20rem,1fr));gap:1rem}
.share{width:100%;min-width:3.5rem;height:10px;background:var(--panel);display:block}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%}th{text-align:left;font-weight:600;color:var(--soft)}
td,th{padding:.25rem .6rem .25rem 0;border-bottom:1px solid var(--rule);vertical-align:top;
font-variant-numeric:tabular-nums}
.text{white-space:pre-wrap;overflow-wrap:anywhere}
.shares td:nth-child(n+3){white-space:nowrap}.shares td:nth-child(2){width:40%}
.sheet{display:grid;grid-template-columns:repeat(auto-fill,minmax(92px,1fr));gap:.6rem;align-items:start}
.sheet figure{margin:0;break-inside:avoid}.sheet img{width:100%;display:block;image-rendering:pixelated}
.sheet figcaption{font-size:.72rem;line-height:1.25}.sheet figcaption b{color:var(--problem)}
.bad img,.bad .none{outline:2px solid var(--problem)}
.none{aspect-ratio:1;background:var(--panel);color:var(--soft);display:grid;place-items:center;font-size:.75rem}
.figure{margin:1rem 0;break-inside:avoid}.figure img{max-width:100%;background:#fff;padding:.4rem;border-radius:.4rem}
footer{margin-top:2rem;font-size:.85rem}
@media print{main{max-width:none;padding:0}section{break-inside:auto}h2{break-after:avoid}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""
)
