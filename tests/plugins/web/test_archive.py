from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from afspm import wire
from afspm.basics import ExperimentClock
from afspm.components.tip_verdict import OF_LINES, LineVerdict, line_verdict_message
from afspm.model import (
    ControlMode,
    ControlState,
    JournalEntries,
    JournalEntry,
    LogLine,
    Packet,
    ProblemNames,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Region,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
)
from afspm.model.events import LogLines
from afspm.plugins.web.archive import Archive
from afspm.plugins.web.dashboard.content import trouble
from afspm.plugins.web.watch import Watch
from afspm.record import REPLAY_OF
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordSettings, RecordStore

S = 1_000_000_000


def test_an_archive_without_a_record_finds_nothing(tmp_path: Path) -> None:
    assert Archive(None).frame(S, "Height") is None
    assert Archive(tmp_path).frame(S, "Height") is None


def test_the_past_is_read_from_the_record(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings())
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    things: list[tuple[str, object]] = [
        ("ControlState", ControlState(ControlMode.AUTOMATED, "series")),
        ("ScopeStateMsg", ScopeStatus(ScopeState.SCANNING)),
        ("ProcessStates", ProcessStates(3 * S, "here", (ProcessState("series", "c", ProcessCondition.ALIVE, 3 * S),))),
        ("Scan2d_1000.0_Height", Scan(region, "Height", "m", np.zeros((4, 4)), 4 * S)),
        ("ScopeStateMsg", ScopeStatus(ScopeState.FREE)),
        ("ProcessStates", ProcessStates(6 * S, "here", (ProcessState("series", "c", ProcessCondition.ENDED, 6 * S),))),
    ]
    store.take((Packet(name, wire.encode(thing)[1], at * S), SCHEDULER) for at, (name, thing) in enumerate(things, 1))
    past = Archive(tmp_path).past(ProblemNames({"drop-on-the-table": 9}))
    store.close()
    assert past is not None
    assert [(span.label, span.start_ns // S) for span in past.process_history.timelines["series"].spans] == [
        ("alive", 3), ("ended", 6),
    ]  # fmt: skip
    assert [span.label for span in past.timelines.scope_state.spans] == ["scanning", "free"]
    assert [(scan.channel, scan.holder) for scan in past.scans] == [("Height", "series")]
    assert past.problems["drop-on-the-table"] == 9
    watch = Watch(ExperimentClock.real(), past=past)
    watch.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), 5 * S)  # which the scheduler has kept
    watch.take("ControlState", ControlState(ControlMode.AUTOMATED, None), 8 * S)
    assert [(span.label, span.start_ns // S) for span in watch.overview.timelines.scope_state.spans] == [
        ("scanning", 2),
        ("free", 5),
    ]
    assert watch.overview.timelines.control.now is None


def test_a_recorded_frame_has_the_row_since_which_the_lines_show_another_tip(tmp_path: Path) -> None:
    store = RecordStore(tmp_path, RecordSettings())
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    verdict = LineVerdict(region, (4, 4), "Height", 2 * S, 3, 2, False, 0.9, True)
    payloads = [
        ("Scan2d_1000.0_Height", wire.encode(Scan(region, "Height", "m", np.zeros((4, 4)), S))[1]),
        (f"{OF_LINES}_line_watch", line_verdict_message(verdict).SerializeToString()),
        ("Scan2d_1000.0_Height", wire.encode(Scan(region, "Height", "m", np.ones((4, 4)), 4 * S))[1]),
    ]
    store.take((Packet(name, payload, at * S), SCHEDULER) for at, (name, payload) in enumerate(payloads, 1))
    store.flush()
    store.close()
    archive = Archive(tmp_path)
    frames = [archive.frame(time_ns, "Height") for time_ns in (S, 4 * S)]
    assert [frame and frame.changed_row for frame in frames] == [None, 2]


def test_a_run_without_a_record_and_a_replay_have_no_past(tmp_path: Path) -> None:
    recorded, replay = tmp_path / "recorded", tmp_path / "replay"
    for folder in (recorded, replay):
        folder.mkdir()
    RecordStore(recorded, RecordSettings()).close()
    (replay / "run.json").write_text(json.dumps({REPLAY_OF: str(recorded)}))
    assert Archive(recorded).past(ProblemNames()) is not None
    assert Archive(replay).past(ProblemNames()) is None
    assert Archive(None).past(ProblemNames()) is None
    (recorded / "journal.sqlite").write_bytes(b"no journal at all" * 100)
    assert Archive(recorded).past(ProblemNames()) is None


def test_a_watch_rings_on_a_change_and_measures_silence() -> None:
    watch = Watch(ExperimentClock.real())
    rung = []
    watch.on_change(lambda: rung.append(watch.changes))
    assert not watch.connected
    watch.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), S)
    assert rung == [1]
    assert watch.connected
    assert watch.silent_s() < 60.0
    assert watch.wait_free(0.0)
    assert not watch.wait_for(lambda overview: overview.control is not None, 0.01)


class _Later(ExperimentClock):
    """A clock that advances a minute with each reading."""

    looks = 0

    def monotonic_s(self) -> float:
        type(self).looks += 1
        return 60.0 * self.looks


def test_a_silent_run_is_reported_with_its_known_reason() -> None:
    said = {"": "", "it was cut off; `…` goes on with it": " It was cut off; `…` goes on with it."}
    for cut_off, told in said.items():
        watch = Watch(_Later(), cut_off=lambda text=cut_off: text)  # type: ignore[misc]
        watch.take("ScopeStateMsg", ScopeStatus(ScopeState.FREE), S)
        assert trouble(watch) == f"The experiment has been silent for 1 min 00 s: this page is that old.{told}"


def test_eight_hours_of_messages_take_bounded_memory() -> None:
    """A line a second in two channels, a scan every 5 minutes, states, log and journal: 200 000 messages."""
    watch, region = Watch(ExperimentClock.real()), Region((0.0, 0.0), (1e-6, 1e-6))
    watch.frames = type(watch.frames)(memory_bytes=4 << 20)
    rows = np.zeros((1, 256))
    sizes = []
    for second in range(8 * 3600):
        now_ns, row = (second + 1) * S, second % 256
        for channel in ("Height", "Phase"):
            began_ns = (second - row + 1) * S
            lines = ScanLines(region, (256, 256), channel, "m", row, rows, began_ns)
            watch.take("ScanLines", lines, now_ns, f"ScanLines_{channel}")
            if row == 255:
                scan = Scan(region, channel, "m", np.zeros((256, 256)), now_ns)
                watch.take("Scan2d", scan, now_ns, f"Scan2d_{channel}")
        state = ScopeState.SCANNING if row < 255 else ScopeState.FREE
        watch.take("ScopeStateMsg", ScopeStatus(state), now_ns)
        watch.take("LogLines", LogLines((LogLine(now_ns, "series", "INFO", "x" * 80),)), now_ns)
        watch.take("JournalEntries", JournalEntries((JournalEntry(now_ns, "request", "series", "x", 1),)), now_ns)
        if second % 7200 == 7199:
            overview = watch.overview
            sizes.append((watch.frames.kept_bytes, len(overview.log), len(overview.entries), len(overview.refusals)))
    assert sizes[1:] == [sizes[1]] * 3
    assert sizes[-1][0] <= 4 << 20
