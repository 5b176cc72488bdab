"""The report as one HTML page: without scripts and external files, light and dark, and printable."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC
from html import escape

from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import counted, day, duration_text, quantity
from afspm.drawing import timeline
from afspm.drawing.image_html import data_url
from afspm.model import ScopeState, component_of
from afspm.model.events import SUPERVISOR
from afspm.model.planned_work import PlannedWork
from afspm.night import ROUTINE, Timeline, instrument_curves
from afspm.night.tables import ScanRow
from afspm.report import agents, curves, markup, parameters, proofs, sample, shadow
from afspm.report.curves import SpectrumGroup
from afspm.report.markup import PageTimes, document, section, table
from afspm.report.pictures import FigurePicture, TopographyPicture
from afspm.report.story import MOST_ROWS, RunStory, colours, sentence, states_in_words, timeline_rows

MOST_NAMED = 40


def html(
    story: RunStory,
    shown: Sequence[TopographyPicture],
    spectra: Sequence[SpectrumGroup],
    figures: Sequence[FigurePicture],
    unread: Sequence[str] = (),
) -> str:
    clock = PageTimes(story.start_ns, story.end_ns)
    title = f"{escape(story.name)}, {day(story.start_ns, UTC)}"
    badge = '<span class="badge">SIMULATED</span>' if story.simulated else ""
    places = [position for group in spectra for position in group.positions]
    body = [
        f"<header><h1>{escape(story.name)}{badge}</h1>{_sample_line(story)}{_duration_line(story, clock)}</header>",
        section("", _cards(story) + _work(story)),
        section("Time line", f'<div class="scroll">{_timeline(story)}</div>{_zones(clock)}'),
        section("What afspm would have done", shadow.html(story.shadow, clock)),
        section("Problems and repairs", _problems(story, clock)),
        section("Critical messages", _alarms(story, clock)),
        section("Files that could not be read", table(["scans and spectra"], [[escape(one)] for one in unread])),
        section("What proves the results", proofs.html(story.proofs, story.measured, clock)),
        section("Treatments of the tip", _treatments(story)),
        section("Parameters changed", parameters.html(story.changes, clock)),
        section("Other instruments", _instruments(story)),
        section("Messages of components", _messages(story, clock)),
        section("Agents", agents.html(story.agents, clock)),
        section("Drift", _drift(story, clock)),
        section("Notes", _notes(story, clock)),
        section("On the sample", sample.sample_map(shown, places, story.ledger.places, story.frame)),
        section("Scans", sample.sheet(story, shown, clock)),
        section("Spectra", curves.html(spectra, clock, story.proofs)),
        section("Figures", _unfinished(story) + _figures(figures)),
        section("What the time went into", _shares(story)),
        section("Refusals", _refusals(story, clock)),
        section("Restarts", _restarts(story, clock)),
        f"<footer>{escape(story.folder)}</footer>",
    ]
    return document(title, "".join(body))


_UNDEFINED = ScopeState.UNDEFINED.name.lower()
_NOT_KNOWN = "not known, at the start or end"
_SMALLEST_REST = 0.005  # of the time: shown as 1 %


def _work(story: RunStory) -> str:
    # two rows for each component with a plan
    rows = []
    for one in story.comparisons:
        planned = "planned at most" if one.planned.at_most else "planned"
        rows.append([escape(one.name), planned, *_work_cells(one.planned)])
        rows.append(["", "measured", *_work_cells(one.measured)])
    if not rows:
        return ""
    # the plan leaves computing out, which a fast clock multiplies by its speed
    computing = "" if story.real_s is None else ", and with the real time of computing times the speed of the clock"
    note = (
        "Both durations are in experiment time. The measured one goes from the first scan or spectrum to the end of "
        f"the last, with pauses and repairs{computing}."
    )
    made = table(["component", "", "scans", "spectra", "path", "duration"], rows)
    return f'{made}<p class="note">{note}</p>'


def _work_cells(work: PlannedWork) -> list[str]:
    return [
        "without end" if work.scans is None else str(work.scans),
        str(work.spectra),
        quantity(work.path_m, "m", 3),
        "not known" if work.duration_s is None else duration_text(work.duration_s),
    ]


def _timeline(story: RunStory) -> str:
    local = PageTimes(story.start_ns, story.end_ns).is_local
    curves = instrument_curves(story.overview.instruments, story.bands)
    rows = timeline_rows(story)
    return timeline.timeline_html(rows, story.start_ns, story.end_ns, UTC, local_too=local, curves=curves)


def _zones(clock: PageTimes) -> str:
    local = f" Small, and in the second row: {escape(clock.zone)}, the zone of the computer that wrote this report."
    return f'<p class="note">Times in UTC, as the experiment had them.{local if clock.is_local else ""}</p>'


def _sample_line(story: RunStory) -> str:
    known = [text for name in ("sample", "person", "project") if (text := story.metadata.get(name))]
    return f"<p>{escape(' · '.join(known))}</p>" if known else ""


def _duration_line(story: RunStory, clock: PageTimes) -> str:
    period = f"{clock.period()}, {duration_text(story.lasted_ns / NS_PER_S)}"
    if story.real_s is not None:
        period += f" ({duration_text(story.real_s)} real)"
    end = story.end
    ended = story.ended
    if end is not None and component_of(end.who) != SUPERVISOR:  # otherwise `ended` states why: nothing was left to run
        reason = f": {end.reason}" if end.reason else ""
        ended = f"{end.who} ended the experiment at {clock.whole(end.time_ns)}{reason}"
    return f"<p>{escape(period)}; {escape(ended)}</p>"


def _unfinished(story: RunStory) -> str:
    lines = [f"{name} was {how}: its pictures and tables may be missing." for name, how in story.unfinished.items()]
    return "".join(f'<p class="note">{escape(line)}</p>' for line in lines)


def _figures(figures: Sequence[FigurePicture]) -> str:
    names = ["", *(f"figure-{number}" for number in range(len(figures))), ""]
    made = [
        markup.figure(
            names[k + 1], f'<img src="{data_url(picture.image)}" alt="{escape(picture.name)}">', escape(picture.name),
            {}, beside=(names[k], names[k + 2]), style="drawn", ratio=picture.ratio,
        )
        for k, picture in enumerate(figures)
    ]  # fmt: skip
    return f'<div class="sheet wide">{"".join(made)}</div>' if made else ""


def _cards(story: RunStory) -> str:
    interrupted = f"and {story.interrupted} interrupted" if story.interrupted else ""
    flags = len(story.problems)
    unsolved = sum(span.end_ns is None for span in story.problems)
    flagged = ("problems flagged", flags, f"{unsolved} still flagged at the end" if unsolved else "")
    cards = [
        ("scans", len(story.scans) - story.interrupted, interrupted),
        ("spectra", story.spectra, ""),
        *(_decisions(story) or [flagged]),
        *_registered(story),
        ("refusals", sum(refused.count for refused in story.refusals), ""),
        ("restarts", len(story.restarts), f"given up: {', '.join(story.given_up)}" if story.given_up else ""),
    ]
    made = [
        f'<div class="card"><b>{number}</b><span>{what}</span><small>{escape(note)}</small></div>'
        for what, number, note in cards
    ]
    return f'<p class="lead">{escape(sentence(story))}</p><div class="cards">{"".join(made)}</div>'


def _decisions(story: RunStory) -> list[tuple[str, int, str]]:
    # a shadow flags no problem of the sample or the tip: it decides, and nothing follows
    count, answered = story.shadow.answered
    return [("decisions", count, f"{answered} answered by the person")] if story.shadow.agreement else []


def _registered(story: RunStory) -> list[tuple[str, int, str]]:
    drift = story.overview.drift
    if not drift:
        return []
    registered = sum(point.outcome.is_registered for point in drift)
    return [("scans registered", registered, "" if registered == len(drift) else f"of {len(drift)}: see Drift")]


def _drift(story: RunStory, clock: PageTimes) -> str:
    if not story.overview.drift:
        return ""
    rows = [
        [
            f'<a href="#{sample.name_of(scan)}">{scan.number}</a>',
            escape(scan.key),
            clock.both(scan.time_ns),
            scan.registration.label if scan.registration else "",
            "not known" if scan.position_sd_m is None else quantity(scan.position_sd_m, "m", 2),
            escape(story.why_unregistered(scan)),
        ]
        for scan in story.unregistered[:MOST_ROWS]
    ]
    errors = sum(point.failures for point in story.overview.drift)
    failed = (
        f" The estimator failed over {counted(errors, 'pair')}: an error of its own; see the log." if errors else ""
    )
    summary = f"<p>{escape(story.overview.registration.capitalize())}.{failed}</p>"
    left_out = len(story.unregistered) - len(rows)
    more = f'<p class="note">{left_out} more are in the record.</p>' if left_out else ""
    return summary + table(["scan", "key", "finished", "registration", "standard deviation", "why"], rows) + more


def _shares(story: RunStory) -> str:
    overview, styles = story.overview, colours(story)
    return '<div class="shares">' + "".join(
        [
            _share_table(story, "in control", overview.timelines.control, styles, rest="no component"),
            _share_table(story, "microscope", overview.timelines.scope_state, {}, rest=_NOT_KNOWN),
            _share_table(story, "mode", overview.timelines.mode, {"manual": "manual"}, rest=_NOT_KNOWN),
        ]
    ) + "</div>"  # fmt: skip


def _share_table(story: RunStory, heading: str, lane: Timeline, styles: dict[str, str], *, rest: str) -> str:
    rows = []
    shares = [(label, ns) for label, ns in story.shares(lane) if label != _UNDEFINED]
    rest_ns = story.lasted_ns - sum(ns for _, ns in shares)
    if shares and rest_ns >= _SMALLEST_REST * story.lasted_ns:  # the columns add up to the whole time
        shares.append((rest, rest_ns))
    for label, ns in shares:
        part = 100.0 * ns / max(1, story.lasted_ns)
        style = styles.get(label, "state")
        words = label if styles else states_in_words(label)
        bar = '<svg class="share" viewBox="0 0 100 10" preserveAspectRatio="none">'
        bar += f'<rect class="{style}" width="{part:.2f}" height="10"/></svg>'
        rows.append([escape(words), bar, duration_text(ns / NS_PER_S), f"{part:.0f} %"])
    return table([heading, "", "", ""], rows) if rows else ""


def _problems(story: RunStory, clock: PageTimes) -> str:
    rows = []
    for span in story.problems:
        end_ns = story.end_ns if span.end_ns is None else span.end_ns
        rows.append(
            [
                escape(span.label),
                clock.both(span.start_ns),
                escape(span.by or "not known"),
                escape(", ".join(story.repairs(span)) or "none"),
                escape(", ".join(story.done_meanwhile(span))),
                duration_text((end_ns - span.start_ns) / NS_PER_S),
                "<b>not solved</b>" if span.end_ns is None else clock.both(end_ns),
            ]
        )
    for entry in story.seen_late:
        name = escape(story.problem_name(entry))
        rows.append([name, clock.both(entry.time_ns), escape(entry.who), "", "", "", "<b>seen after the end</b>"])
    routine = "".join(
        f'<p class="note">{escape(span.label)} at {clock.both(span.start_ns)} is {escape(ROUTINE)}.</p>'
        for span in story.overview.routine_spans
    )
    watched = "".join(
        f'<p class="note">{escape(name)} watched {counts.watched} of {counted(counts.complete, "complete scan")}; '
        f"{counted(counts.late_lines, 'line')} came after the end of their scan.</p>"
        for name, counts in story.watched.items()
    )
    nothing = "A shadow sets no problems: see its decisions above." if story.shadow.agreement else "None."
    return (
        (
            table(["problem", "flagged", "by", "in control meanwhile", "treatments", "for", "cleared"], rows)
            or f"<p>{nothing}</p>"
        )
        + routine
        + watched
    )


def _alarms(story: RunStory, clock: PageTimes) -> str:
    rows = [
        [
            clock.both(alarm.line.time_ns),
            escape(alarm.line.name),
            f'<span class="text">{escape(alarm.line.text)}</span>',
            "<b>not known to be over</b>" if alarm.ended_ns is None else clock.both(alarm.ended_ns),
        ]
        for alarm in story.overview.alarms
    ]
    return table(["when", "process", "message", "over"], rows)


def _treatments(story: RunStory) -> str:
    ledger = story.ledger
    if not ledger.treatments and not ledger.feedback_off_s:
        return ""
    rows = [
        ["pulses", f"{ledger.pulses}, voltage × time together {quantity(ledger.pulse_v_s, 'V s')}"],
        ["crashes", f"{ledger.crashes}, depth together {quantity(ledger.crash_depth_m, 'm')}"],
        ["by", escape(", ".join(f"{who} {count}" for who, count in sorted(ledger.by.items()))) or "none"],
        ["within 500 nm of a region scanned before", str(ledger.in_keep_away)],
        ["feedback off", duration_text(ledger.feedback_off_s)],
    ]
    if ledger.unknown:
        rows.append(["with a size that the record does not show", f"{ledger.unknown}, not in these sums"])
    return table(["what", "how much"], rows)


def _instruments(story: RunStory) -> str:
    rows = []
    for name in dict.fromkeys(instrument.name for row in story.beside_instruments for instrument in row.instruments):
        at = [
            (row, instrument)
            for row in story.beside_instruments
            for instrument in row.instruments
            if instrument.name == name
        ]
        known = [
            bound
            for _, instrument in at
            for bound in (instrument.lowest, instrument.value, instrument.highest)
            if bound is not None
        ]
        unit = next((instrument.unit for _, instrument in at if instrument.unit), "")
        outside = [row for row, instrument in at if instrument.outside]
        links = [
            f'<a href="#{sample.name_of(row)}">{row.number}</a>'
            if isinstance(row, ScanRow)
            else f"spectrum {row.number}"
            for row in outside
        ]
        more = "" if len(links) <= MOST_NAMED else f" … {len(links)} in all"
        extent = (min(known), max(known)) if known else None
        rows.append(
            [
                escape(name),
                counted(len(at), "measurement"),
                "unknown" if extent is None else f"{quantity(extent[0], unit)} to {quantity(extent[1], unit)}",
                f"<b>{', '.join(links[:MOST_NAMED])}{more}</b>" if links else "none",
            ]
        )
    return table(["parameter", "known beside", "values meanwhile", "outside a condition"], rows)


def _messages(story: RunStory, clock: PageTimes) -> str:
    rows = [
        [
            escape(one.who),
            escape(one.name),
            str(one.count),
            clock.both(one.time_ns),
            f'<span class="text">{escape(one.text)}</span>',
        ]
        for one in story.overview.announcements()
    ]
    unread = "".join(f'<p class="note">{escape(one)}.</p>' for one in story.overview.unread)
    return table(["component", "message", "how many", "newest", "its fields"], rows) + unread


def _notes(story: RunStory, clock: PageTimes) -> str:
    rows = [
        [
            clock.both(note.time_ns),
            "" if note.scan is None else f"scan {note.scan}",
            escape(note.who),
            f'<span class="text">{escape(note.text)}</span>',
        ]
        for note in story.notes
    ]
    return table(["when", "on", "by", "note"], rows)


def _refusals(story: RunStory, clock: PageTimes) -> str:
    rows = [
        [
            clock.both(refused.first_ns) + (f" … {clock.both(refused.last_ns)}" if refused.count > 1 else ""),
            str(refused.count),
            escape(refused.who),
            escape(refused.what),
            escape(refused.reason),
        ]
        for refused in story.refusals[:MOST_ROWS]
    ]
    left_out = len(story.refusals) - len(rows)
    more = f'<p class="note">{left_out} more are in the record.</p>' if left_out else ""
    return (table(["when", "times", "who", "asked for", "refused because"], rows) or "<p>None.</p>") + more


def _restarts(story: RunStory, clock: PageTimes) -> str:
    rows = [
        [clock.both(restart.time_ns), escape(restart.name), str(restart.starts), escape(restart.last_exit)]
        for restart in story.restarts[:MOST_ROWS]
    ]
    return table(["when", "process", "start number", "had ended"], rows) or "<p>None.</p>"
