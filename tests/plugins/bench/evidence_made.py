"""Evidence made of parts, without a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from afspm.model import ControlRequest, ControlResponse, JournalEntry, Region
from afspm.night import ScanRow
from afspm_bench.evidence import Evidence, Report

MINUTE_NS = 60_000_000_000


def scan_row(number: int, minutes: float, region: Region | None = None) -> ScanRow:
    end_ns = int(minutes * MINUTE_NS)
    here = region or Region((0.0, 0.0), (1e-6, 1e-6))
    return ScanRow(number, end_ns, end_ns - MINUTE_NS // 2, (), here, (64, 64), False, "agent", None, (), "", "")


def request(
    what: str, kind: ControlRequest, code: ControlResponse, minutes: float, *, sent: bool, subject: str = ""
) -> JournalEntry:
    time_ns = int(minutes * MINUTE_NS)
    return JournalEntry(
        time_ns, "request", "agent", what, int(code), request=int(kind), sent_ns=time_ns if sent else None,
        subject=subject,
    )  # fmt: skip


class MadeEvidence(Evidence):
    """Evidence whose record and truth are given."""

    def __init__(
        self,
        *,
        report: Report | None = None,
        scans: list[ScanRow] | None = None,
        requests: list[JournalEntry] | None = None,
        truth: list[dict[str, Any]] | None = None,
        manual: list[tuple[int, int]] | None = None,
        began_ns: int = 0,
    ) -> None:
        super().__init__(Path(), "bench", report, began_ns)
        self.__dict__ |= {"scans": scans or [], "spectra": [], "requests": requests or [], "truth": truth or []}
        self._manual = manual or []

    def manual(self) -> list[tuple[int, int]]:
        return self._manual
