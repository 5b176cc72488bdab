"""`MakerProgram`: a maker's control program, which starts, ends and saves scans and curves."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from afspm.basics.clock import Clock
from afspm.basics.errors import AfspmError
from afspm.simulation.activities import ScanActivity, SpectrumActivity
from afspm.simulation.emulation.controller_clock import ControllerClock
from afspm.simulation.emulation.pending_writes import PendingWrites
from afspm.simulation.faults import INSTRUMENT_FAULTS, Faults
from afspm.simulation.instrument import InstrumentBusy, SimulatedInstrument, busy_with

NamedFile = tuple[str, bytes]
"""The name of a file and its content."""


class MakerProgram(ABC):
    """A maker's control program, without its protocol. Not thread-safe.

    Args:
        folder: folder for saved files.
        start_s: duration of the ramp to the first line, experiment time.
        file_s: delay between the end and the first half of a file; the second half follows after the same delay.
        file_clock: clock of the controller's computer. Default: the experiment's clock.

    Attributes:
        rig: the instrument.
        file_clock: clock of the controller's computer.
        repeats: True if another scan starts after each complete scan.
        saves_partial: True if an interrupted scan is saved.

    Raises:
        TypeError: the emulator's `fault_kinds` lack a fault of `fault_kinds` here.
    """

    fault_kinds: ClassVar[Mapping[str, str]] = INSTRUMENT_FAULTS
    """The faults that the program injects by itself. The emulator declares them: `{**MakerProgram.fault_kinds, …}`."""

    def __init__(
        self,
        rig: SimulatedInstrument,
        faults: Faults,
        clock: Clock,
        folder: Path,
        log: logging.Logger,
        *,
        start_s: float,
        file_s: float,
        file_clock: ControllerClock | None = None,
    ) -> None:
        if missing := [kind for kind in self.fault_kinds if kind not in faults.known]:
            lacks = f"the emulator's fault_kinds lack {', '.join(missing)}"
            raise TypeError(f"{lacks}: add **MakerProgram.fault_kinds to them")  # else the first scan would fail
        self.rig = rig
        self.faults = faults
        self.clock = clock
        self.folder = folder
        self.repeats = self.saves_partial = False
        self._log = log
        self._start_s, self._file_s = start_s, file_s
        self.file_clock = file_clock or ControllerClock()
        self._disk = PendingWrites(self.file_clock)
        self._starts_at_s = math.inf
        self._scan: ScanActivity | None = None
        self._curve: SpectrumActivity | None = None
        self._engages = False

    # -- what a maker's program adds

    @abstractmethod
    def prepare_scan(self) -> None:
        """Copy the panel's values to `rig.setup`, right before a scan.

        Raises:
            AfspmError: invalid values.
        """

    @abstractmethod
    def prepare_curve(self) -> None:
        """Copy the panel's values to `rig.setup`, right before a curve."""

    @abstractmethod
    def scan_files(self, scan: ScanActivity, shown_s: float) -> Sequence[NamedFile]:
        """Return the files of an ended scan; empty: the scan is not saved.

        Args:
            shown_s: the time that the controller's clock shows.
        """

    @abstractmethod
    def curve_files(self, curve: SpectrumActivity, shown_s: float) -> Sequence[NamedFile]:
        """Return the files of an ended curve, like `scan_files`; empty: the curve is not saved."""

    # -- what goes on

    @property
    def now_s(self) -> float:
        return self.clock.now_s()

    @property
    def scanning(self) -> bool:
        """True from the scan command to the end of the scan."""
        return self._scan is not None or math.isfinite(self._starts_at_s)

    @property
    def measuring_curve(self) -> bool:
        """True from the command to the end of a curve."""
        return self._curve is not None

    @property
    def engages(self) -> bool:
        """True while an approach is due but has not started."""
        return self._engages

    @property
    def engaged(self) -> bool:
        """True while the tip is at the sample or on its way there."""
        return self.rig.engaged or self._engages

    def advance(self, now_s: float) -> float | None:
        """Advance to `now_s`; return the time of the next event, apart from events of the rig."""
        if self._engages and not self.rig.busy(now_s):
            self._engages = False
            self.rig.engage(now_s)
        if now_s >= self._starts_at_s and not self.rig.busy(now_s):
            self._starts_at_s = math.inf
            self._begin_scan(now_s)
        if self._scan is not None:
            self._watch_scan(self._scan, now_s)
        if self._curve is not None and not self._curve.running(now_s):
            ended, self._curve = self._curve, None
            self._save(self.curve_files(ended, self.file_clock.shown_s(now_s)), now_s)
        due_s = self._disk.advance(now_s, there=True)
        return min((at_s for at_s in (due_s, self._starts_at_s) if at_s is not None and at_s > now_s), default=None)

    def start_scan(self, now_s: float) -> None:
        """Start a scan. Raises InstrumentBusy."""
        self._refuse_busy()
        if not self.faults.strikes("scan-refused", now_s):
            self._starts_at_s = now_s + self._start_s

    def stop_scan(self, now_s: float) -> None:
        self._starts_at_s = math.inf
        ended, self._scan = self._scan, None
        if ended is not None:
            self.rig.stop_scan(now_s)
            if self.saves_partial:
                self._save(self.scan_files(ended, self.file_clock.shown_s(now_s)), now_s)

    def start_curve(self, kind: str, now_s: float) -> None:
        """Start a curve at the tip's position. Raises InstrumentBusy, InvalidValue."""
        self._refuse_busy()
        if not self.faults.strikes("spectrum-refused", now_s):
            self.prepare_curve()
            self._curve = self.rig.start_spectrum(kind, now_s)

    def stop_curve(self) -> None:
        if self._curve is not None:
            self._curve = None
            self.rig.stop_spectrum(self.now_s)

    def engage(self) -> None:
        """Approach the sample once a running withdrawal has ended. Raises InstrumentBusy."""
        if self.scanning or self.measuring_curve:
            raise InstrumentBusy("a measurement is running")
        self._engages = True

    def stop_engaging(self) -> None:
        """Stop the approach; the tip stays withdrawn."""
        if self._engages or self.rig.doing(self.now_s) == "approach":
            self._engages = False
            self.rig.stop("approach", self.now_s)
            self.rig.engaged = False

    def withdraw(self, now_s: float) -> None:
        """Stop the activity and withdraw the tip."""
        self.stop_scan(now_s)
        self._engages, self._curve = False, None
        self.rig.withdraw(now_s)

    def abandon(self) -> None:
        """Drop the activity after an unexpected error."""
        self._starts_at_s, self._scan, self._curve, self._engages = math.inf, None, None, False

    # -- inside

    def _refuse_busy(self) -> None:
        doing = "scan" if self.scanning else self.rig.doing(self.now_s)
        if doing or self._engages:
            raise busy_with(doing or "approach")

    def _begin_scan(self, now_s: float) -> None:
        # with values that can't be scanned, the scan ends as if stopped at the panel
        try:
            self.prepare_scan()
            self._scan = self.rig.start_scan(now_s)
        except (AfspmError, ArithmeticError, ValueError) as error:
            self._log.warning("the scan was interrupted: %s", error)

    def _watch_scan(self, scan: ScanActivity, now_s: float) -> None:
        if not scan.running(now_s):
            self._scan = None
            self._save(self.scan_files(scan, self.file_clock.shown_s(now_s)), now_s)
            if self.repeats:
                self._starts_at_s = now_s + self._start_s
        elif self.faults.strikes("stopped", now_s):
            self.stop_scan(now_s)
        elif self.faults.strikes("withdrawn", now_s):
            self.withdraw(now_s)

    def _save(self, files: Sequence[NamedFile], now_s: float) -> None:
        if not files or self.faults.strikes("no-file", now_s):
            return
        late, half = (self.faults.strikes(kind, now_s) for kind in ("late-file", "half-file"))
        at_s = now_s + self._file_s + (late.duration_s if late else 0.0)
        rest_at_s = at_s + self._file_s + (half.duration_s if half else 0.0)
        for name, content in files:
            self._disk.save(self.folder / name, content, at_s, rest_at_s)
