"""The report of a run, from a record."""

from __future__ import annotations

import errno
import json
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from record_lab import Night

from afspm import model, wire
from afspm.basics.errors import FileError
from afspm.components.tip_verdict import OF_LINES, LineVerdict, line_verdict_message
from afspm.model import ControlMode, ControlState, ProcessCondition, RegistrationOutcome, ScopeState, names
from afspm.model.events import LogLines
from afspm.model.problems import CONDITIONS
from afspm.night.bad_scans import BAD, VERDICT_MESSAGE
from afspm.night.run import open_run
from afspm.night.timeline import Span
from afspm.night.treatment_ledger import TreatmentLedger, TreatmentPlace
from afspm.record.run_json import EXPERIMENT_FILE, RUN_FILE, UNFINISHED
from afspm.record.store import RecordSettings, RecordStore
from afspm.report import page, pictures, sample, story
from afspm.report.markup import PageTimes
from afspm.report.night_report import REPORT_FILE, write
from afspm.wire.messages import WatchCounts

S = 1_000_000_000
START = 1_700_000_000 * S
REGION = model.Region((0.0, 0.0), (2e-6, 1e-6))
TIP = int(model.Problem.TIP_SHAPE_CHANGED)


def scan(end_s: float, channel: str = "Height Retrace", side: int = 8) -> model.Scan:
    values = np.arange(side * side, dtype=np.float64).reshape(side, side) % 5
    return model.Scan(REGION, channel, "m", values, START + round(end_s * S), f"scan-{end_s:g}.nc")


def entry(
    at_s: float, kind: str, who: str, what: str, response: int | None = None, reason: str = "", **codes: Any
) -> object:
    made = model.JournalEntry(START + round(at_s * S), kind, who, what, response, reason, **codes)
    return model.JournalEntries((made,))


def processes(at_s: float, *states: model.ProcessState) -> tuple[float, object]:
    return at_s, model.ProcessStates(START + round(at_s * S), "lab", states)


def process(name: str, condition: ProcessCondition, since_s: float, starts: int = 1, last: str = "") -> object:
    return model.ProcessState(name, "component", condition, START + round(since_s * S), 0.0, starts, 7, last)


def night() -> list[tuple[float, object]]:
    packets: list[tuple[float, object]] = [
        (1, model.ScopeStatus(ScopeState.FREE)),
        (2, ControlState(ControlMode.AUTOMATED, "series <b>")),
        processes(3, process("judge", ProcessCondition.ALIVE, 3)),  # type: ignore[arg-type]
    ]
    for began_s in (100, 700, 1300):
        packets += [
            (began_s, model.ScopeStatus(ScopeState.SCANNING)),
            (began_s + 90, scan(began_s + 90)),
            (began_s + 91, scan(began_s + 90, "Phase")),
            (began_s + 92, model.ScopeStatus(ScopeState.FREE)),
        ]
    return [
        *packets,
        (1500, ControlState(ControlMode.AUTOMATED, None, (TIP,))),
        (
            1501,
            entry(
                1500,
                "control",
                "judge",
                "flagged",
                event=model.ControlEvent.PROBLEM_FLAGGED,
                problem=int(model.Problem.TIP_SHAPE_CHANGED),
            ),
        ),
        (1510, ControlState(ControlMode.AUTOMATED, "corrector", (TIP,))),
        (1520, entry(1520, "request", "corrector", "x-pulse", 0)),
        (1530, entry(1530, "request", "corrector", "x-pulse", 0)),
        (1540, entry(1540, "request", "corrector", "bias = 20 V", 9, "at most <10> V")),
        (1541, entry(1541, "request", "corrector", "bias = 20 V", 9, "at most <10> V")),
        (1600, ControlState(ControlMode.AUTOMATED, "series <b>")),
        processes(1700, process("judge", ProcessCondition.RESTARTING, 1700, 1, "signal 9")),  # type: ignore[arg-type]
        processes(1702, process("judge", ProcessCondition.ALIVE, 1702, 2, "signal 9")),  # type: ignore[arg-type]
        (2000, model.ScopeStatus(ScopeState.SCANNING)),
        (2010, model.ScanLines(REGION, (8, 8), "Height Retrace", "m", 0, np.ones((3, 8)), START + 2000 * S)),
        (2020, model.ScopeStatus(ScopeState.INTERRUPTED)),
        (2021, model.ScopeStatus(ScopeState.FREE)),
        (3601, model.ScopeStatus(ScopeState.MOVING)),
    ]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return recorded(tmp_path)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of the run, for tests that only read it."""
    return write(recorded(tmp_path_factory.mktemp("report")))


def recorded(into: Path) -> Path:
    folder = into / "night-1"
    folder.mkdir()
    facts = {
        "name": "night",
        "clock": {"origin_s": 0.0, "start_s": START / S, "speed": 60.0},
        "ended": "all components are done",
        "real_s": 121.4,
    }
    (folder / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    store = RecordStore(folder, RecordSettings({"experiment": "night", "simulated": True}))
    packets = []
    for at_s, thing in night():
        name, payload = wire.encode(thing)
        suffix = f"_{thing.channel}" if isinstance(thing, model.Scan) else ""
        packets.append((model.Packet(name + suffix, payload, START + round(at_s * S)), ""))
    store.take(packets)
    store.finish()
    store.close()
    return folder


def with_spectra(into: Path, positions: Sequence[tuple[float, float]]) -> str:
    """The report of a run of force curves, the third of another sweep."""
    store = RecordStore(into, RecordSettings({"experiment": "curves"}))
    for number, position in enumerate(positions):
        z = np.linspace(0.0, 1e-7 + 1e-9 * (number == 2), 50)
        values = np.stack([z, z * (number + 1), z * 2], axis=1)
        names, units = ("Z", "Force <N>", "Force <N> Retrace"), ("m", "N", "N")
        spectrum = model.Spectrum(position, "force", names, units, values, START + number * S, f"{number}.dat")
        store.take([(model.Packet("Spec1d_force", wire.encode(spectrum)[1], START + number * S), "")])
    ended = entry(60, "control", "survey", "ended", event=model.ControlEvent.EXPERIMENT_ENDED, reason="tip <is> gone")
    store.take([(model.Packet("JournalEntries", wire.encode(ended)[1], START + 60 * S), "")])
    store.flush()
    store.close()
    return write(into).read_text(encoding="utf-8")


def told(run: Path) -> story.RunStory:
    with open_run(run) as opened:
        return story.read(opened)


def test_result_shows_its_claim_and_the_facts_left_unproved(tmp_path: Path) -> None:
    facts = {"never_shown": {"tip at the sample": "<no> value"}, "metadata": {"software": "Gxsm"}}
    (tmp_path / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    store = RecordStore(tmp_path, RecordSettings({"experiment": "night"}))
    begin, end = ((model.Parameter("tip-bias-voltage", text, "V"),) for text in ("0.2", "0.3"))
    shown = model.MeasurementConditions(
        START, "", None, None, (), START, "series", begin, end, ("its file states <no> start",)
    )
    image = model.Scan(REGION, "Height", "m", np.eye(8), START)
    for number, thing in enumerate([shown, image, replace(image, time_ns=START + 5 * S)]):  # the last of an older run
        name, payload = wire.encode(thing)
        store.take([(model.Packet(name, payload, START + number), "")])
        if number == 1:
            ended = wire.encode(model.ScopeStatus(ScopeState.FREE))
            store.take([(model.Packet(*ended, START + number), "")])
    store.finish()
    store.close()
    run = open_run(tmp_path)
    first, second = (run.about(row).get("tip", {}) for row in run.scans)
    assert first["settings"] == {"begin": {"tip-bias-voltage": "0.2 V"}, "end": {"tip-bias-voltage": "0.3 V"}}
    assert (first["asked_by"], first["unproved"]) == ("series", ["its file states <no> start"])
    assert second == {}
    text = write(tmp_path).read_text(encoding="utf-8")
    for words in ("What proves the results", "states &lt;no&gt; start", "tip-bias-voltage 0.2 V (at the end 0.3 V)"):
        assert words in text
    assert "Gxsm never shows: tip at the sample (&lt;no&gt; value)." in text
    assert text.count("<dt>asked for by</dt><dd>series</dd>") == 1


def test_component_that_had_not_finished_is_named_beside_the_figures(run: Path) -> None:
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    facts[UNFINISHED] = {"drawing": "stopped 1 min 00 s after the end of the experiment, before it had finished"}
    (run / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    text = write(run).read_text(encoding="utf-8")
    assert "drawing was stopped 1 min 00 s after the end of the experiment, before it had finished" in text
    assert "drawing not finished" in text


class Page(HTMLParser):
    """Collects the addresses that a browser would load, and unclosed elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.open: list[str] = []
        self.pictures = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.loads += [value for key, value in given.items() if key in ("src", "href") and value]
        self.pictures += tag == "img"
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_is_self_contained_and_well_formed(report: Path) -> None:
    text = report.read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    assert page.pictures == 5  # the scans, the interrupted one too, and the newest of their place on the map
    assert [load for load in page.loads if not load.startswith(("data:image/webp;base64,", "#"))] == []
    assert "<script" not in text
    assert re.findall(r"url\(|@import", text) == []


@pytest.mark.parametrize(
    "said",
    [
        "SIMULATED",
        "3 scans, 1 interrupted, tip-shape-changed flagged once, 1 restart",
        "1 h 00 min (2 min 01 s real); all components are done",
        "2 × pulse",
        "<b>interrupted</b>",
        "prefers-color-scheme:dark",
        "@media print",
        "signal 9",
        "at most &lt;10&gt; V",
        "series &lt;b&gt;",
    ],
)
def test_page_contains(report: Path, said: str) -> None:
    assert said in report.read_text(encoding="utf-8")


def test_recorded_texts_are_escaped(report: Path) -> None:
    text = report.read_text(encoding="utf-8")
    assert "series <b>" not in text
    assert "<10>" not in text


def test_night_is_drawn_beside_the_report(report: Path) -> None:
    assert (report.parent / pictures.OWN_NIGHT).read_bytes().startswith(b"\x89PNG")


def test_figure_of_a_component_replaces_the_reports_own(run: Path) -> None:
    write(run)  # while it still goes on
    drawn = (run / pictures.OWN_NIGHT).read_bytes()
    (run / pictures.NIGHT).write_bytes(drawn)
    text = write(run).read_text(encoding="utf-8")
    assert not (run / pictures.OWN_NIGHT).exists()
    assert ">night.png</figcaption>" in text
    assert len(pictures.of_figures(run)[0].image) < len(drawn)


def test_report_is_reproducible(run: Path) -> None:
    first = write(run).read_bytes()
    assert write(run).read_bytes() == first
    assert [file.name for file in run.iterdir() if file.name.startswith(".report")] == []


def test_report_of_a_resumed_run_begins_with_its_first_part(run: Path) -> None:
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    facts["clock"]["start_s"] += 1000.0
    (run / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    assert told(run).start_ns == START + S


def test_without_a_record_there_is_no_report(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no record"):
        write(tmp_path)
    assert not (tmp_path / REPORT_FILE).exists()


@pytest.mark.parametrize("what", ["afspm.report.pictures.draw", "pathlib.Path.replace"])
def test_unwritable_folder_is_named(run: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(what, full)
    with pytest.raises(FileError, match="can't be written: No space left on device"):
        write(run)
    assert not list(run.glob(".report*"))


def test_scan_without_its_file_is_listed_without_a_picture(run: Path) -> None:
    next((run / "scans").iterdir()).unlink()
    assert "no values" in write(run).read_text(encoding="utf-8")


def test_equal_refusals_are_listed_once_with_their_number(run: Path) -> None:
    (refused,) = told(run).refusals
    assert (refused.count, refused.who, refused.last_ns - refused.first_ns) == (2, "corrector", S)


def test_treatment_with_a_repeated_request_is_drawn_and_counted_once(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({"experiment": "night"}))
    asked: dict[str, Any] = {
        "request": int(model.ControlRequest.ACTION),
        "subject": names.PULSE,
        "sent_ns": START + 1550 * S,
    }
    none, done = int(model.ControlResponse.NO_RESPONSE), int(model.ControlResponse.SUCCESS)
    answers = ((1555, none, False), (1560, done, True), (1561, done, False))
    things = night() + [
        (at_s, entry(at_s, "request", "corrector", names.PULSE, response, late=late, **asked))
        for at_s, response, late in answers
    ]
    for at_s, thing in sorted(things, key=lambda one: one[0]):
        message, payload = wire.encode(thing)
        suffix = f"_{thing.channel}" if isinstance(thing, model.Scan) else ""
        store.take([(model.Packet(message + suffix, payload, START + round(at_s * S)), "")])
    store.finish()
    store.close()
    with open_run(tmp_path) as opened:
        read = story.read(opened)
        marks = pictures.night_of(opened, read, []).marks
    assert [(mark.time_ns - START) // S for mark in marks] == [1520, 1530, 1555]
    (problem,) = read.problems
    assert read.done_meanwhile(problem) == ["3 × pulse"]


def test_critical_messages_are_listed_with_their_end(tmp_path: Path) -> None:
    folder = tmp_path / "night-1"
    folder.mkdir()
    store = RecordStore(folder, RecordSettings({"experiment": "night"}))
    lines = (
        ("recorder", "CRITICAL", "nothing can be recorded: <full>"),
        ("microscope", "CRITICAL", "can't restore scan-speed"),
        ("recorder", "INFO", "no longer true: nothing can be recorded"),
    )
    for at_s, line in enumerate(lines):
        time_ns = START + at_s * 60 * S
        name, payload = wire.encode(LogLines((model.LogLine(time_ns, *line),)))
        store.take([(model.Packet(name, payload, time_ns), "")])
    store.finish()
    store.close()
    text = write(folder).read_text(encoding="utf-8")
    section = text.partition("<h2>Critical messages</h2>")[2].partition("</section>")[0]
    rows = re.findall("<tr>(.*?)</tr>", section)[1:]
    assert "nothing can be recorded: &lt;full&gt;" in rows[0]
    assert "22:15" in rows[0]
    assert "not known to be over" in rows[1]
    assert "2 critical messages" in text


def test_problem_is_listed_with_its_repairers(run: Path) -> None:
    (problem,) = told(run).problems
    assert (problem.by, problem.lasted_ns(0 if problem.end_ns is None else problem.end_ns)) == ("judge", 100 * S)
    assert told(run).repairs(problem) == ["corrector"]


def test_duration_excludes_figures_drawn_after_the_end(run: Path) -> None:
    store = RecordStore(run, RecordSettings({}))
    ended = model.JournalEntry(
        START + 3601 * S, "control", "series", "ended", event=model.ControlEvent.EXPERIMENT_ENDED
    )
    drawn = LogLines((model.LogLine(START + 9000 * S, "night_picture", "INFO", "the night is drawn"),))
    for at_s, thing in ((3602, model.JournalEntries((ended,))), (9000, drawn)):
        name, payload = wire.encode(thing)
        store.take([(model.Packet(name, payload, START + at_s * S), "")])
    store.flush()
    store.close()
    story = told(run)
    assert story.overview.newest_ns == START + 9000 * S
    assert (story.end_ns, story.real_s) == (START + 3601 * S, 121.4)


def framed(run: Path) -> list[int]:
    """The numbers of the scans that the page frames."""
    text = write(run).read_text(encoding="utf-8")
    return [int(number) for number in re.findall(r'<figure id="scan-(\d+)" class="scan bad"', text)]


def test_legend_of_the_scans_explains_no_mark_without_drift(report: Path) -> None:
    text = report.read_text(encoding="utf-8")
    assert "share one range of heights.</p>" in text
    assert "only estimated" not in text


def test_scan_before_a_flag_and_interrupted_scan_are_framed(run: Path) -> None:
    assert framed(run) == [3, 4]


def test_page_and_picture_of_the_night_frame_the_same_scans_by_their_verdicts(run: Path) -> None:
    store = RecordStore(run, RecordSettings({}))
    with open_run(run) as opened:
        whole = {row.number: row.time_ns for row in opened.scans}
    for number, score in ((1, BAD), (2, BAD), (2, 1.0), (3, 0.5)):  # the last verdict counts
        message: Any = wire.message_type(VERDICT_MESSAGE)(channel="Height Retrace")
        message.timestamp.FromNanoseconds(whole[number])
        message.spatials.add(score=score)
        packet = model.Packet(f"{VERDICT_MESSAGE}_judge", message.SerializeToString(), whole[number] + int(score * S))
        store.take([(packet, "tcp://127.0.0.1:9009")])
    store.flush()
    store.close()
    assert framed(run) == [1, 4]
    with open_run(run) as opened:
        read = story.read(opened)
        record = pictures.night_of(opened, read, pictures.of_scans(opened, read.scans))
    assert record.bad_ns() == {whole[1], whole[4]}


def test_problem_of_a_condition_frames_no_scan(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({"experiment": "cold"}))
    warm = 100
    flagged: dict[str, Any] = {"event": model.ControlEvent.PROBLEM_FLAGGED, "problem": warm}
    things = [
        (1, ControlState(ControlMode.AUTOMATED, "series")),
        (10, model.ScopeStatus(ScopeState.SCANNING)),
        (80, scan(80)),
        (82, model.ScopeStatus(ScopeState.FREE)),
        (90, ControlState(ControlMode.AUTOMATED, None, (warm,))),
        (91, entry(90, "control", CONDITIONS, "flagged too-warm", **flagged)),
    ]
    store.take([(model.Packet(*wire.encode(thing), START + at_s * S), "") for at_s, thing in things])
    store.flush()
    store.close()
    assert framed(tmp_path) == []
    with open_run(tmp_path) as opened:
        read = story.read(opened)
        record = pictures.night_of(opened, read, pictures.of_scans(opened, read.scans))
    assert record.problems == [warm]
    assert record.bad_ns() == frozenset()


def test_row_with_a_changed_tip_is_a_dashed_line_in_its_scan(run: Path) -> None:
    store = RecordStore(run, RecordSettings({}))
    with open_run(run) as opened:
        marked = next(row for row in opened.scans if row.number == 3)
    assert marked.began_ns is not None
    assert marked.shape is not None
    assert marked.region is not None
    since = marked.shape[0] // 2
    verdict = LineVerdict(marked.region, marked.shape, "Height", marked.began_ns, since + 1, since, False, 0.9, True)
    payload = line_verdict_message(verdict).SerializeToString()
    store.take([(model.Packet(f"{OF_LINES}_line_watch", payload, marked.began_ns + S), "")])
    store.flush()
    store.close()
    text = write(run).read_text(encoding="utf-8")
    assert text.count('class="change"') == 1
    figure = text[text.index('<figure id="scan-3"') :].partition("</figure>")[0]
    assert f'class="change" style="bottom:{100.0 * since / marked.shape[0]:.3f}%"' in figure
    assert f"row {since}, by the lines" in figure


def test_times_of_more_than_a_day_have_the_day(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({"experiment": "days"}))
    for at_s in (0, 30 * 3600):
        thing = scan(at_s)
        store.take([(model.Packet("Scan2d_1_x", wire.encode(thing)[1], START + at_s * S), "")])
    store.flush()
    store.close()
    text = write(tmp_path).read_text(encoding="utf-8")
    assert "1 · 2023-11-14 22:13:20" in text
    assert "2 · 2023-11-16 04:13:20" in text


def test_problem_seen_after_the_end_is_listed_and_not_a_refusal(run: Path) -> None:
    store, flag = RecordStore(run, RecordSettings({})), model.ControlRequest.ADD_EXP_PRBLM
    ended = model.JournalEntry(START, "control", "series", "ended", event=model.ControlEvent.EXPERIMENT_ENDED)
    seen = [model.JournalEntry(START + n, "request", "judge", "flags", 1, request=flag, problem=1) for n in (1, 2)]
    entries = model.JournalEntries((ended, *seen))
    store.take([(model.Packet("JournalEntries", wire.encode(entries)[1], START + 5000 * S), "")])
    store.flush()
    store.close()
    story = told(run)
    assert [(one.who, story.problem_name(one)) for one in story.seen_late] == [("judge", "tip-shape-changed")]
    assert "judge" not in [one.who for one in story.refusals]
    assert "tip-shape-changed seen after the end" in write(run).read_text(encoding="utf-8")


def test_time_in_control_is_summed_by_holder(run: Path) -> None:
    shares = dict(told(run).shares(told(run).overview.timelines.control))
    assert shares["corrector"] == 90 * S
    assert shares["series <b>"] == (1498 + 2001) * S


# users A: columns that end at 31, 66 and 59 % left open where the rest is
def test_shares_of_the_time_add_up_to_the_whole(report: Path) -> None:
    text = report.read_text()
    tables = text[text.index('<div class="shares">') :].split("</div>", 1)[0].split("</table>")[:-1]
    sums = [sum(map(int, re.findall(r"(\d+) %", one))) for one in tables]
    assert sums
    assert all(98 <= one <= 102 for one in sums), sums


def test_selection_of_many_scans_has_the_bad_and_some_between(run: Path) -> None:
    with open_run(run) as opened:
        row = opened.scans[0]
    many = [replace(row, number=k, time_ns=k) for k in range(1000)]
    shown = pictures.chosen(many, kept_ns={777})
    assert len(shown) == pictures.MOST
    assert {0, 777, 999} <= {one.number for one in shown}
    assert [one.number for one in shown] == sorted(one.number for one in shown)


def fields_of(row: object) -> dict[str, object]:
    return {name: getattr(row, name) for name in row.__slots__}  # type: ignore[attr-defined]


def test_indistinguishable_intervals_are_one_bar(run: Path) -> None:
    night = told(run)
    night.overview.timelines.scope_state.spans.clear()
    for k in range(20_000):  # in an hour: several for each pixel
        begin = night.start_ns + k * 180_000_000
        night.overview.timelines.scope_state.spans.append(Span("scanning", begin, begin + 100_000_000))
    assert page.html(night, (), (), ()).count("<span") < 1000


def test_empty_record_has_a_report(tmp_path: Path) -> None:
    RecordStore(tmp_path, RecordSettings({"experiment": "empty"})).close()
    text = write(tmp_path).read_text(encoding="utf-8")
    assert Page(text).open == []
    assert "0 scans" in text


def test_spectra_are_shown_with_mean_and_spread_and_one_by_one_in_their_grid(tmp_path: Path) -> None:
    text = with_spectra(tmp_path, [(x * 1e-9, y * 1e-9) for y in range(2) for x in range(3)])
    assert Page(text).open == []
    assert "force: 6" in text
    assert text.count("<polygon") == 1  # the spread of the one variable
    assert "on the way back" in text
    assert "Force &lt;N&gt; / nN" in text
    assert "grid-template-columns:repeat(3," in text
    assert 'id="spectrum-1-4"' in text
    assert "grid-row:1;grid-column:1" in text  # the fourth is the first of the upper row
    assert text.count("spectrum at (") == 6


def test_spectra_that_form_no_grid_are_shown_in_their_order(tmp_path: Path) -> None:
    text = with_spectra(tmp_path, [(0.0, 0.0), (1e-9, 7e-9), (5e-9, 2e-9)])
    assert "force: 3" in text
    assert "grid-row" not in text


def test_page_names_author_and_reason_of_the_end(tmp_path: Path) -> None:
    text = with_spectra(tmp_path, [(0.0, 0.0)])
    assert "survey ended the experiment at 2023-11-14 22:14:20 UTC: tip &lt;is&gt; gone" in text


def test_local_time_stands_beside_utc_where_it_is_another(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not hasattr(time, "tzset"):
        pytest.skip("this system has one zone")
    assert "local" not in write(run).read_text(encoding="utf-8") or time.timezone
    monkeypatch.setenv("TZ", "XYZ-5:30")
    time.tzset()
    try:
        text = write(run).read_text(encoding="utf-8")
    finally:
        monkeypatch.undo()
        time.tzset()
    assert "2023-11-14 22:13 to 23:13 UTC (2023-11-15 03:43 to 04:43 XYZ)" in text
    assert "22:38:20<small>04:08:20 XYZ</small>" in text  # a problem was flagged
    assert ">local</b>" in text


def test_local_times_have_the_zone_in_force_at_the_end_of_summer_time(monkeypatch: pytest.MonkeyPatch) -> None:
    if not hasattr(time, "tzset"):
        pytest.skip("this system has one zone")
    evening, morning = (
        round(datetime.fromisoformat(f"2026-10-{text}:00+00:00").timestamp()) * S for text in ("24T20:00", "25T07:00")
    )
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    try:
        clock = PageTimes(evening, morning)
        twice = [clock.both(evening + round(hours * 3600) * S) for hours in (4.5, 5.5)]
        period, zone = clock.period(), clock.zone
    finally:
        monkeypatch.undo()
        time.tzset()
    assert twice == ["00:30:00<small>02:30:00 CEST</small>", "01:30:00<small>02:30:00 CET</small>"]
    assert "(2026-10-24 22:00 CEST to 2026-10-25 08:00 CET)" in period
    assert zone == "CEST, then CET"


def test_map_shows_pictures_at_their_position_the_newest_on_top(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({"experiment": "map"}))
    places = [((0.0, 0.0), 4e-6), ((1e-6, 1e-6), 1e-6), ((1e-6, 1e-6), 1e-6)]
    for number, (center, side) in enumerate(places, 1):
        values = np.random.default_rng(number).normal(size=(8, 8))
        scan = model.Scan(
            model.Region(center, (side, side), 0.1), "Z", "m", values, START + number * S, f"{number}.sxm"
        )
        store.take([(model.Packet("Scan2d_Z", wire.encode(scan)[1], START + number * S), "")])
    store.flush()
    store.close()
    text = write(tmp_path).read_text(encoding="utf-8")
    sample = text[text.index('<div class="map"') : text.index("newest scan on top")]
    assert re.findall(r'href="#scan-(\d)"', sample) == ["1", "3"]
    left, top, width = (float(x) for x in re.findall(r"left:([\d.]+)%;top:([\d.]+)%;width:([\d.]+)%", sample)[1])
    assert left > 50.0 > top
    assert width == pytest.approx(100 / 4.7, abs=2.0)
    assert "rotate(-5.730deg)" in sample
    assert "µm" in sample


def test_sums_of_treatments_name_what_they_sum(run: Path) -> None:
    ledger = TreatmentLedger(pulses=3, pulse_v_s=1.05, crashes=2, crash_depth_m=1e-8)
    with open_run(run) as opened:
        text = page.html(replace(story.read(opened), ledger=ledger), [], [], [])
    assert "<td>3, voltage × time together 1.05 V s</td>" in text
    assert "<td>2, depth together 10 nm</td>" in text


def test_map_marks_near_treatments_and_lists_those_far_away() -> None:
    def mapped(*treated: tuple[str, tuple[float, float]]) -> str:
        places = [TreatmentPlace(*one) for one in treated]
        return sample.sample_map([], [(0.0, 0.0), (1e-6, 1e-6)], places, model.Frame.TIP)

    beside = mapped((names.PULSE, (2e-6, 0.0)), (names.CRASH, (2e-6, 1e-6)))
    assert re.findall(r'<u [^>]*title="(\w+ at [^"]*)">(.)</u>', beside) == [
        ("pulse at (2, 0) µm", "+"),
        ("crash at (2, 1) µm", "×"),
    ]
    assert "; + pulse; × crash.</p>" in beside
    assert "Outside" not in beside
    far = mapped((names.PULSE, (8e-6, 0.0)), (names.PULSE, (9e-6, -1e-6)), (names.CRASH, (0.5e-6, 0.5e-6)))
    assert far.count("<u ") == 1
    assert "; × crash. Outside the map: 2 pulses between (8, −1) µm and (9, 0) µm.</p>" in far
    assert "Outside the map: 1 crash at (8, 0) µm." in mapped((names.CRASH, (8e-6, 0.0)))


def test_invalid_figure_is_left_out(run: Path) -> None:
    (run / "half.png").write_bytes(b"\x89PNG but no more")
    assert "half.png" not in write(run).read_text(encoding="utf-8")


def test_poorly_registered_scans_are_listed_with_their_uncertainty(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({"experiment": "survey", "frame": "sample"}))
    outcomes = (RegistrationOutcome.REGISTERED, RegistrationOutcome.FAILED, RegistrationOutcome.REGISTERED)
    for number, outcome in enumerate(outcomes):
        message: Any = wire.message_type("DriftMapping")(
            matrix=[1, 0, 0, 0, 1, 0], center=[0, 0], covariance=[9e-16, 0, 0, 4e-16], outcome=int(outcome),
            failures=2 * (not outcome.is_registered), matched=outcome.is_registered, reason="<oh>",
        )  # fmt: skip
        began_s = 100 * number
        message.timestamp.FromNanoseconds(START + (began_s + 40) * S)
        things = [
            (began_s, model.ScopeStatus(ScopeState.SCANNING)),
            (began_s + 80, message),
            (began_s + 81, scan(began_s + 80)),
            (began_s + 82, model.ScopeStatus(ScopeState.FREE)),
        ]
        store.take([(model.Packet(*wire.encode(thing), START + at_s * S), "") for at_s, thing in things])
    store.flush()
    store.close()
    assert story.sentence(told(tmp_path)) == "3 scans, registered 2 of 3 scans, 1 failed"
    text = write(tmp_path).read_text(encoding="utf-8")
    Page(text)
    assert "Registered 2 of 3 scans, 1 failed. The estimator failed over 2 pairs" in text
    (row,) = re.findall(r"<tr>(?:(?!</tr>).)*#scan-2(?:(?!</tr>).)*</tr>", text)
    assert "failed" in row
    assert "30 nm" in row
    assert "&lt;oh&gt;" in row
    assert "± 30 nm, failed, by dead reckoning: &lt;oh&gt;" in text
    assert "± 30 nm, registered" in text
    assert "is only estimated, from earlier drift: <b>failed</b>: an error, a time limit" in text
    assert "<b>refused</b>:" not in text, "no scan has this mark"


def test_first_thermal_drift_is_shown_as_routine(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings({"experiment": "survey"}))
    asked: Any = wire.message_type("DriftRescan")(kind=int(model.RescanKind.OPPOSITE))
    asked.timestamp.FromNanoseconds(START + 10 * S)
    things = [
        (1, ControlState(ControlMode.AUTOMATED, "series")),
        (10, ControlState(ControlMode.AUTOMATED, "rescanner", (int(model.Problem.THERMAL_DRIFT),))),
        (11, asked),
        (12, model.ScopeStatus(ScopeState.SCANNING)),
        (80, scan(80)),
        (82, model.ScopeStatus(ScopeState.FREE)),
        (90, ControlState(ControlMode.AUTOMATED, "series")),
    ]
    store.take([(model.Packet(*wire.encode(thing), START + at_s * S), "") for at_s, thing in things])
    store.flush()
    store.close()
    found = told(tmp_path)
    assert not found.problems
    assert [row.problems for row in found.scans] == [()], "its picture is not framed"
    with open_run(tmp_path) as opened:
        assert pictures.night_of(opened, found, pictures.of_scans(opened, found.scans)).problems == []
    text = write(tmp_path).read_text(encoding="utf-8")
    assert "is normal at the start" in text
    assert "thermal-drift flagged" not in text


def test_planned_work_stands_beside_the_measured_work(run: Path) -> None:
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    plan = {"scans": 4, "spectra": 0, "path_m": 1.28e-4, "pixels": 256, "duration_s": 1800.0}
    (run / "run.json").write_text(
        json.dumps({**facts, "planned": {"series <b>": plan, "tuner": None}}), encoding="utf-8"
    )
    text = write(run).read_text(encoding="utf-8")
    Page(text)
    head = "<td>series &lt;b&gt;</td><td>planned</td><td>4</td><td>0</td><td>128 µm</td><td>30 min</td>"
    measured = "<td></td><td>measured</td><td>3</td><td>0</td><td>96 µm</td><td>22 min</td>"
    assert "<th>path</th><th>duration</th>" in text
    assert f"<tr>{head}</tr><tr>{measured}</tr>" in re.sub(r"\s*\n\s*", "", text)
    assert "tuner" not in text, "it has no estimate to compare"


def test_readings_of_an_instrument_lie_on_the_time_line_with_their_band(tmp_path: Path) -> None:
    folder = recorded(tmp_path)
    (folder / EXPERIMENT_FILE).write_text(
        '[conditions.cold]\n"cryo.temperature" = { from = "4.15 K", to = "4.25 K" }\n', encoding="utf-8"
    )
    with open_run(folder) as run:
        shown = story.read(run)
    for at_s, value in ((100, 4.2), (1000, 4.2), (1200, 4.4), (1400, 4.2), (3000, 4.21)):
        reading = model.InstrumentReading("cryo.temperature", value, "K")
        report = model.InstrumentReadings(START + at_s * S, "cryo", (reading,))
        shown.overview.take("InstrumentReadings", report, report.time_ns, "")
    html = page.html(shown, [], [], [])
    drawn = html[html.index("Time line") : html.index("Problems and repairs")]
    assert "cold allows 4.15 K to 4.25 K" in drawn
    assert 'class="allowed"' in drawn
    assert 'class="outside"' in drawn
    assert drawn.index("lane curve") < drawn.index("lane-axis")


def test_report_shows_how_many_scans_a_watch_judged(run: Path) -> None:
    store = RecordStore(run)
    for at_s, counted in ((190, (1, 0, 0)), (1390, (3, 2, 1))):
        counts = WatchCounts(complete=counted[0], watched=counted[1], late_lines=counted[2])
        packet = model.Packet("WatchCounts_watch", counts.SerializeToString(), START + at_s * S)
        store.take([(packet, "watch")])
    store.finish()
    store.close()
    text = write(run).read_text(encoding="utf-8")
    assert "watch watched 2 of 3 complete scans; 1 line came after the end of their scan." in text
    assert "1 complete scan;" not in text


def test_run_with_a_class_that_is_no_longer_there_opens_and_has_a_report(
    tmp_path: Path, night: Night, store: RecordStore
) -> None:
    store.take(night.whole_scan(1))
    table = '[peers]\ncomponent = true\nclass = "afspm.plugins.published.peers.PublishedPeers"\n'
    (tmp_path / EXPERIMENT_FILE).write_text(table, encoding="utf-8")
    facts = {"name": "lab", "processes": {"peers": {"role": "component", "class": "afspm.plugins.published.peers"}}}
    (tmp_path / RUN_FILE).write_text(json.dumps(facts), encoding="utf-8")
    with open_run(tmp_path) as run:
        assert len(run.scans) == 1
    assert write(tmp_path).is_file()
