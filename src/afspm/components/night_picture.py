"""`NightPicture`: a picture of the night on one page, with scans, control and problems over time."""

from __future__ import annotations

import importlib
import json
import threading
from pathlib import Path
from typing import Any, ClassVar

from afspm.basics.plain_data import Plain
from afspm.client.component import Component
from afspm.components import tip_verdict
from afspm.components.line_file import LineFile
from afspm.model import (
    TOPOGRAPHY,
    ChannelName,
    ControlEvent,
    ControlState,
    JournalEntries,
    RescanKind,
    Scan,
    ScanHistory,
    ScopeState,
    ScopeStatus,
)
from afspm.model.problems import CONDITIONS
from afspm.night.night_record import NightRecord, control_entry, mark_entry, scan_entry


class NightPicture(Component):
    """The picture `night.png`, drawn when the experiment ends: the scans in a row, control and problems over time.

    A simulated microscope is marked in the picture. The component subscribes to all packets, and saves each entry at
    once, so that the picture is the same after a kill and restart.

    Args:
        channel: shown channel of each scan, by role or name.
        file: the picture's name in the run folder.
        title: title above the picture.
    """

    file_suffix: ClassVar[str] = ""
    listens: ClassVar = ("",)  # also the journal, which names the problems of conditions

    def __init__(self, channel: ChannelName = TOPOGRAPHY, file: str = "night.png", title: str = "") -> None:
        self.channel, self.file, self.title = channel, file, title
        self._history = ScanHistory()

    def on_start(self) -> None:
        self._file = LineFile(Path(self.run_dir) / "state" / f"{self.name}.night.jsonl")
        self.record = NightRecord.from_lines(self._file.lines())
        # imported now, since there is little time at the end; in a thread, since the loop must not miss a scan
        self._loading = threading.Thread(target=_load_drawing, name="loading", daemon=True)
        self._loading.start()

    def on_control(self, control_state: ControlState) -> None:
        self._history = self._history.step(control_state, self._packet_ns())
        self._add(control_entry(control_state, self._packet_ns()))

    def on_state(self, status: ScopeStatus) -> None:
        self._history = self._history.step(status, self._packet_ns())
        if status.state is ScopeState.INTERRUPTED:
            self._add({"kind": "interrupted", "time_ns": self._packet_ns()})

    def on_scan(self, scan: Scan) -> None:
        if scan.is_of(self.channel) and scan.values.size:
            begun = self._history.of(scan, self._packet_ns())
            self._add(scan_entry(scan, scan.time_ns or self._packet_ns(), begun.began_ns, begun.holder))
        self._history = self._history.step(scan, self._packet_ns())

    def on_message(self, envelope: str, message: Any) -> None:
        self._history = self._history.step(message, self._packet_ns())
        by = envelope.partition("_")[2]
        if envelope.startswith("DriftRescan") and message.kind == RescanKind.OPPOSITE:
            self._add({"kind": "routine", "time_ns": message.timestamp.ToNanoseconds()})
        elif isinstance(message, JournalEntries):
            for entry in message.entries:
                if entry.event is ControlEvent.PROBLEM_FLAGGED and entry.who == CONDITIONS:
                    self._add({"kind": "condition", "time_ns": entry.time_ns, "problem": entry.problem})
        elif envelope.startswith("ActionMsg"):
            self._add(mark_entry(by, message.action, self._packet_ns()))
        elif envelope.startswith(tip_verdict.MESSAGE) and (verdict := tip_verdict.read_verdict(message)) is not None:
            of_ns, score = verdict
            self._add(mark_entry(by, "verdict", self._packet_ns(), score, of_ns))

    def on_end(self) -> None:
        if not self.record.shots:
            self.log.info("no scan, no picture")
            return
        self._loading.join()
        from afspm.report.night_figure import draw

        path = Path(self.run_dir) / self.file
        names = {number: self.scope.problems.name(number) for number in self.record.problems}
        draw(self.record, path, names, title=self.title, simulated=self.simulated)
        self.log.info("the night is drawn: %s", path)

    def _packet_ns(self) -> int:
        time_ns = self.packet.time_ns if self.packet else None
        return self.clock.now_ns() if time_ns is None else time_ns

    def _add(self, entry: Plain) -> None:
        if self.record.add(entry):
            self._file.append([json.dumps(entry, separators=(",", ":"))])


def _load_drawing() -> None:
    importlib.import_module("afspm.report.night_figure").prepare()
