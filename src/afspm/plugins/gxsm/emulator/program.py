"""The emulated program GXSM: settings, measurements with the simulated instrument, and saving of files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from afspm import read
from afspm.basics import NS_PER_S, Clock, InvalidValue, Plain
from afspm.driver import FileContent
from afspm.emulation import ControllerClock, Faults, ScanActivity, SimulatedInstrument, SpectrumActivity, SweptCurve
from afspm.model import Region
from afspm.plugins.gxsm.emulator import files
from afspm.plugins.gxsm.emulator.entries import GxsmEntries, GxsmEntry, lengths, simulated_3, subscan
from afspm.plugins.gxsm.emulator.file_writer import GxsmFileWriter
from afspm.plugins.gxsm.emulator.files import CHANNELS, SIMULATED_3, UNITS, GxsmChannel
from afspm.plugins.gxsm.scan_memory import stored

CARDS: Final = {"SRanger": "SRangerMK2:SPM", "RPSPMC": "RPSPMC:SPM", "simulator": "SPM-SIM:SPM"}
FAULT_KINDS: Final[Mapping[str, str]] = {
    "refused": "a value is refused as out of range: a dialog opens on the screen",
    "takes-all": "for the duration, values beyond GXSM's own limits are taken as sent",
    "no-start": "a scan does not begin, without an error",
    "panel-stop": "the scan is stopped at the panel",
}
ANGSTROM_M: Final = 1e-10
SHOWS_S: Final = 0.15
"""Delay of the scanning bit after the start of a scan."""
NAMED_S: Final = 0.04
"""Time after the start of a scan during which the previous scan's file names are reported."""
IGAIN: Final = 10.0
"""Integral gain of the simulated feedback that corresponds to an integral gain of 1 in GXSM."""
UNFINISHED_S: Final = 0.25
"""Duration of GXSM's own work after the end of a scan; a file saved meanwhile has no end time."""
_PIXELS_S: Final = 0.045
"""Duration of a line in GXSM's own simulator, in addition to the duration of the line's pixels."""
_NEVER_WRITTEN: Final = -296
"""The line that Gxsm4's simulator reports at the start of its first scan."""
NO_CHANNEL: Final = "no channel is set"
"""The dialog that takes all later starts, even with channels, until a person closes it."""
_PULSE_S: Final = 1.0
_MIXER: Final = ("dsp-fbs-mx0-current-set", "nA", 1.0)
_MIXERS: Final = {
    "current": ("dsp-fbs-mx0-current-set", "nA", 1e-9),
    "frequency-shift": ("dsp-fbs-mx1-freq-set", "Hz", 1.0),
}
"""Entry of the setpoint, unit, and SI value of this unit, by the mode of the feedback."""
_COLUMNS: Final = {
    "Bias": "Bias-mon",
    "Z": "Z-mon",
    "Current": "CurrentSim1",
    "Frequency Shift": "dFreq",
    "Frequency Shift Retrace": "dFreq Retrace",
}


@dataclass(frozen=True)
class GxsmSettings:
    """Settings of the emulated program; see the arguments of `GxsmEmulator`."""

    version: int
    card: str
    user_unit: str
    decimal_comma: bool
    auto_save: bool
    probe_auto_save: bool
    reach_m: float
    display_units: Mapping[str, str]
    channels_set: bool


@dataclass
class GxsmPanel:
    """The switches of GXSM's panel.

    Attributes:
        auto_save, probe_auto_save: automatic saving of scans, of spectra.
        repeats: True if each complete scan is followed by another scan.
        layers: number of scans that *Multi Layer* makes of one; they are saved together, after the last.
        original: path of the file that was opened last; empty: none since the start of GXSM.
        subscan: first column, columns, first row and rows of *SubScan*; zeros: off.
        movie: number of columns and rows of the pictures of the last *Movie*; None: there was none.
    """

    auto_save: bool
    probe_auto_save: bool
    repeats: bool = False
    layers: int = 1
    original: str = ""
    subscan: list[int] = field(default_factory=lambda: [0, 0, 0, 0])
    movie: tuple[int, int] | None = None


@dataclass
class GxsmScan:
    """The last scan that was started, and GXSM's memory of its values.

    Attributes:
        activity: the simulated scan; None before the first scan.
        frame: OffsetX, OffsetY, RangeX, RangeY in ångström and Rotation in degrees, at the start of the scan.
        runs: True until GXSM has registered the end of the scan.
        saved: True if the scan has been saved.
        shows_s: delay of the scanning bit after the start of the scan.
        next_follows: True if another scan is due to start.
        follows: True if the due scan is a repetition, which shows at once in the scanning bit and the file names.
        layer: number of the layer, see `GxsmPanel`.
        number, own: number in the scan's file names; paths of its files, empty until they are saved.
        before: file names of the previous scan, reported at first; None: own file names from the start.
        y_before: line reported until the first line of the scan is complete.
        memory: image of stored values before the scan, by channel.
        elsewhere: line from which the scan goes on in a frame that was moved meanwhile, and this scan; in order.
        subscan: part of the frame at the start of the scan, see `GxsmPanel`.
        ended_s: end of the last ended scan in GXSM's clock; 0.0: none.
        ended_before_s: `ended_s` at the start of the scan: a file saved during the scan has it.
        opened: the picture that a person has opened in a channel during the scan, and the lines complete before: the
            scan goes on in it.
    """

    activity: ScanActivity | None = None
    frame: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    runs: bool = False
    saved: bool = False
    shows_s: float = SHOWS_S
    next_follows: bool = False
    follows: bool = False
    layer: int = 0
    number: int = 0
    before: list[Path] | None = None
    y_before: int = 0
    memory: dict[GxsmChannel, np.ndarray] = field(default_factory=dict)
    own: list[Path] = field(default_factory=list)
    elsewhere: list[tuple[int, ScanActivity]] = field(default_factory=list)
    subscan: list[int] = field(default_factory=lambda: [0, 0, 0, 0])
    ended_s: float = 0.0
    ended_before_s: float = 0.0
    opened: dict[GxsmChannel, tuple[int, FileContent]] = field(default_factory=dict)


class GxsmProgram:
    """The emulated GXSM without its transports: panel, measurements and files.

    Attributes:
        panel: switches of GXSM's panel.
        channels: channels that a scan records.
        dialogs: texts of dialogs on the screen.
        scan: the last started scan.
        has_crashed: True once a call has ended the program.
    """

    def __init__(
        self,
        rig: SimulatedInstrument,
        faults: Faults,
        clock: Clock,
        file_clock: ControllerClock,
        folder: Path,
        settings: GxsmSettings,
    ) -> None:
        self.rig, self.faults, self.clock, self.folder = rig, faults, clock, folder
        self._file_clock = file_clock
        self.version, self.card = version, card = settings.version, settings.card
        self.dialogs: list[str] = []
        self.panel = GxsmPanel(settings.auto_save, settings.probe_auto_save)
        self.entries = GxsmEntries(
            version, settings.user_unit, decimal_comma=settings.decimal_comma, dialogs=self.dialogs.append
        )
        known = SIMULATED_3 if (version, card) == (3, "simulator") else CHANNELS[version]
        shown = settings.display_units
        self._known_channels = [
            replace(one, unit=(shown[one.label], UNITS[shown[one.label]][0])) if one.label in shown else one
            for one in known
            if one.source in rig.channels
        ]
        self.channels: list[GxsmChannel] = list(self._known_channels) if settings.channels_set else []
        # Unattended nights go on after a crash: with scans from before it, a person has also begun a scan since then.
        self._is_named = settings.channels_set and any(folder.glob("*.nc"))
        self.has_crashed = False
        self.saving = GxsmFileWriter(folder, faults, file_clock)
        self.scan = GxsmScan()
        self._pictures: dict[GxsmChannel, list[np.ndarray]] = {}  # opened since the start, each a time element
        self.curve: SpectrumActivity | None = None
        self._bias_since_s = -math.inf
        self._curves = 0
        for ref, entry in lengths(settings.reach_m / ANGSTROM_M, self._on_change).items():
            self.entries.add(ref, entry)
        for ref, entry in {**self._of_hardware(), **(subscan(self._on_subscan) if version == 4 else {})}.items():
            self.entries.add(ref, entry)

    def _on_change(self, ref: str) -> Callable[[float], None]:
        if ref in ("OffsetX", "OffsetY"):
            return lambda _: self._go_elsewhere() if self.scan.runs else self._move()
        if ref in ("ScanX", "ScanY"):
            return lambda _: self._move()
        return lambda _: self._go_elsewhere()

    def _on_subscan(self, place: int) -> Callable[[float], None]:
        return lambda value: self.panel.subscan.__setitem__(place, int(value))

    def _go_elsewhere(self) -> None:
        # The hardware moves at once: the lines that follow are scanned at the new place. Range and points belong to the
        # next scan, so that the size of the running scan stays.
        now_s, rig, scan = self.clock.now_s(), self.rig, self.scan.activity
        if scan is None or not self.scan.runs or not scan.running(now_s):
            return
        moved = replace(scan, region=replace(self._scanned(self.frame()), size_m=scan.region.size_m))
        rig.drawing.wait()
        rig.drawing.rewind()
        rig.drawing.start(moved, rig.drawing.prepared(moved, engaged=rig.engaged))
        line, region = scan.lines_done(now_s), moved.region
        self.scan.elsewhere.append((line, moved))
        facts = {"center_m": region.center_m, "size_m": region.size_m, "angle_rad": region.angle_rad}
        rig.note(now_s, "scan moved", {"number": scan.number, "from_line": line, **facts})

    def _scanned(self, region: Region) -> Region:
        # the real simulator turns its picture against the direction of the frame
        return replace(region, angle_rad=-region.angle_rad) if self.card == "simulator" else region

    def _of_hardware(self) -> dict[str, GxsmEntry]:
        rig, loop = self.rig, self.rig.setup.feedback
        bias = GxsmEntry(rig.setup.bias_v, -10.0, 10.0, "V", on_change=self._bias)
        if self.card == "simulator":
            speed = GxsmEntry(1.0, 0.01, 4000.0, "px/s", "{:.2f}")
            return {"sim-stm-speed": speed, "sim-stm-bias": bias, **(simulated_3() if self.version == 3 else {})}

        def fed_back(name: str, factor: float = 1.0) -> Callable[[float], None]:
            def on_change(value: float) -> None:
                changed: Plain = {name: value * factor}
                rig.setup.feedback = replace(rig.setup.feedback, **changed)

            return on_change

        def sloped(axis: int) -> Callable[[float], None]:
            return lambda value: setattr(
                rig.setup, "slope", (*rig.setup.slope[:axis], value, *rig.setup.slope[axis + 1 :])
            )

        speed = GxsmEntry(
            2e4, 1e-3, 1e7, on_change=lambda value: setattr(rig.setup, "move_speed_m_s", value * ANGSTROM_M)
        )
        mixer, unit, factor = _MIXERS.get(rig.world.settings.feedback.mode, _MIXER)
        setpoint = GxsmEntry((loop.setpoint or 0.0) / factor, -1e3, 1e3, unit, on_change=fed_back("setpoint", factor))
        found = {
            "dsp-fbs-bias": bias,
            "dsp-fbs-mx0-current-set": GxsmEntry(0.0, -100.0, 100.0, "nA"),
            mixer: setpoint,
            "dsp-fbs-mx0-current-level": GxsmEntry(0.0, -100.0, 100.0, "nA"),
            "dsp-fbs-cp": GxsmEntry(
                loop.proportional_gain or 0.0, -100.0, 200.0, on_change=fed_back("proportional_gain")
            ),
            "dsp-fbs-ci": GxsmEntry(
                (loop.integral_gain or 0) / IGAIN, -100, 200, on_change=fed_back("integral_gain", IGAIN)
            ),
            "dsp-fbs-scan-speed-scan": GxsmEntry(1e4, 1e-3, 1e7),
            "dsp-fbs-scan-speed-move": speed,
            "dsp-adv-scan-slope-x": GxsmEntry(0.0, -0.2, 0.2, on_change=sloped(0)),
            "dsp-adv-scan-slope-y": GxsmEntry(0.0, -0.2, 0.2, on_change=sloped(1)),
            "dsp-gvp-du00": GxsmEntry(0.0, -10.0, 10.0, "V"),
        }
        iv = rig.world.settings.iv
        found |= {
            self._of_iv("Start"): GxsmEntry(-iv.range_v, -10.0, 10.0, "V"),
            self._of_iv("End"): GxsmEntry(iv.range_v, -10.0, 10.0, "V"),
            self._of_iv("Points"): GxsmEntry(iv.points, 2.0, 1e5, whole=True),
        }
        if self.card == "RPSPMC":
            return {**found, "dsp-GVP-VPJR": GxsmEntry(0.0)}
        zs = {"dsp-Z-start": GxsmEntry(0.0, -1e4, 1e4), "dsp-Z-end": GxsmEntry(0.0, -1e4, 1e4)}
        return {**found, **zs, "dsp-Z-Slope": GxsmEntry(100.0, 1e-3, 1e6), "dsp-fbs-motor": GxsmEntry(0.0, -10.0, 10.0)}

    def _of_iv(self, entry: str) -> str:
        return f"dsp-IV-{entry}{'' if self.card == 'RPSPMC' else '00'}"

    def _bias(self, value: float) -> None:
        # A bias voltage in force for less than a second counts as a pulse on the simulated tip.
        now_s = self.clock.now_s()
        if now_s - self._bias_since_s < _PULSE_S:
            self.rig.pulsed(self.rig.setup.bias_v, now_s - self._bias_since_s, now_s)
        self.rig.setup.bias_v, self._bias_since_s = value, now_s

    # --- what happens by itself ---

    def advance(self, now_s: float) -> float | None:
        """Advance scans, spectra and files to now; return the time of the next change, None if there is none."""
        if self.scan.runs and self.faults.strikes("panel-stop", now_s):
            self.rig.stop_scan(now_s)
        if self.scan.runs and self.scan.activity is not None and not self.scan.activity.running(now_s):
            self.scan.runs, self.scan.ended_s = False, self._file_clock.shown_s(self.scan.activity.end_s)
            is_whole = self.scan.activity.stopped_s is None
            self.scan.layer = (self.scan.layer + 1) % self.panel.layers if is_whole else 0
            if self.panel.auto_save and not self.scan.layer:
                self.save(now_s, finished=True)
            self.scan.next_follows = self.scan.follows = is_whole and (self.panel.repeats or self.scan.layer > 0)
        if self.curve is not None and not self.curve.running(now_s):
            curve, self.curve = self.curve, None
            if self.panel.probe_auto_save:
                self._save_curve(curve, now_s)
        next_s = self.saving.advance(now_s)
        if self.scan.next_follows and now_s >= self.saving.done_s:
            self.start_scan()
        return min(next_s or math.inf, self.saving.done_s) if self.scan.next_follows else next_s

    @property
    def is_between_repeats(self) -> bool:
        """True during and between repeated scans, so that GXSM's scanning bit stays set."""
        is_whole = self.scan.activity is not None and self.scan.activity.stopped_s is None
        return (self.panel.repeats or self.panel.layers > 1) and is_whole and (self.scan.runs or self.scan.next_follows)

    def stop_scan(self) -> None:
        """Stop the running scan, and cancel the scan that is due to start."""
        self.scan.next_follows = False
        self.rig.stop_scan(self.clock.now_s())

    # --- scans ---

    def start_scan(self) -> None:
        """Start a scan if possible, at the earliest when all files are written. GXSM reports no failure."""
        now_s = self.clock.now_s()
        self.scan.next_follows = now_s < self.saving.done_s
        if self.scan.next_follows:
            return
        follows, self.scan.follows = self.scan.follows, False
        self.rig.stop_move(now_s)
        if self.rig.busy(now_s) or self.faults.strikes("no-start", now_s) or NO_CHANNEL in self.dialogs:
            return
        if not self.channels:
            self.dialogs.append(NO_CHANNEL)
            return
        entries, columns, rows = self.entries, int(self.entries["PointsX"]), int(self.entries["PointsY"])
        region = self._scanned(self.frame())
        self.rig.setup.region, self.rig.setup.shape, self.rig.setup.upwards = region, (rows, columns), False
        if self.card == "simulator":
            self.rig.setup.line_s = _PIXELS_S + len(self.channels) * columns / entries["sim-stm-speed"]
        else:
            self.rig.setup.line_s = 2.0 * entries["RangeX"] / entries["dsp-fbs-scan-speed-scan"]
        try:
            started = self.rig.start_scan(now_s)
        except InvalidValue as error:
            self.dialogs.append(str(error))
            return
        self.scan.memory = {one: _resized(self.image(one), (rows, columns)) for one in self.channels}
        is_first = self.scan.activity is None and self.card == "simulator" and self.version == 4
        self.scan.y_before = _NEVER_WRITTEN if is_first else self.y_current(now_s)
        self.scan.before, self.scan.own = None if follows else self.names(now_s), []
        self.scan.elsewhere, self.scan.subscan, self.scan.opened = [], list(self.panel.subscan), {}
        self.scan.ended_before_s = self.scan.ended_s
        self.scan.number = self.saving.next_number()
        self.scan.shows_s = 0.0 if follows else SHOWS_S
        self.scan.activity = started
        self.scan.frame = tuple(entries[ref] for ref in ("OffsetX", "OffsetY", "RangeX", "RangeY", "Rotation"))  # type: ignore[assignment]
        self.scan.runs, self.scan.saved = True, False

    def y_current(self, now_s: float) -> int:
        """Return the index of the last complete line.

        Before the first line is complete, that is the previous scan's last line; after the end or a stop, the last line
        of the frame.
        """
        scan = self.scan.activity
        if scan is None:
            return 0
        if not scan.running(now_s):
            return scan.shape[0] - 1
        done = scan.lines_done(now_s)
        return done - 1 if done else self.scan.y_before

    def frame(self) -> Region:
        """Return the frame of the next scan."""
        x, y, width, height = (self.entries[ref] * ANGSTROM_M for ref in ("OffsetX", "OffsetY", "RangeX", "RangeY"))
        return Region((x, y), (width, height), -math.radians(self.entries["Rotation"]))

    def names(self, now_s: float) -> list[Path]:
        """Return the reported paths of the channels' files, existing or not; empty before the first scan."""
        if not self.channels:
            return []
        if self.scan.activity is None:
            return [self.saving.named(one, self.saving.counter) for one in self._endings()] if self._is_named else []
        if self.scan.before is not None and now_s < self.scan.activity.start_s + NAMED_S:
            return self.scan.before
        if self.scan.own:
            return self.scan.own
        return [self.saving.named(ending, self.scan.number) for ending in self._endings()]

    def shown(self, path: Path) -> str:
        """Return a path as GXSM reports it; relative ("./name") in the default folder."""
        return f"./{path.name}" if path.parent == self.folder else str(path)

    def image(self, channel: GxsmChannel) -> np.ndarray:
        """Return a channel of GXSM's memory as stored values; rows not yet scanned hold the previous scan."""
        if self.scan.activity is None or channel not in self.scan.memory:
            return np.zeros((0, 0), np.float32)
        now_s = self.clock.now_s()
        until_s = now_s if self.scan.runs else self.scan.activity.stopped_s
        scanned = channel.raw(self.scan.activity.channels(until_s)[channel.source][1])
        for line, moved in self.scan.elsewhere:
            scanned[line:] = channel.raw(moved.channels(until_s)[channel.source][1])[line:]
        left, width, top, height = self.scan.subscan
        if width:
            inside = np.zeros(scanned.shape, bool)
            inside[top : top + height, left : left + width] = True
            scanned[~inside] = np.nan
        if channel in self.scan.opened:
            scanned[: self.scan.opened[channel][0]] = np.nan
        return np.where(np.isnan(scanned), self.scan.memory[channel], scanned)

    # --- a person ---

    def set_channels(self) -> None:
        """Set the channels at the panel; GXSM reports them from their first scan on."""
        self.channels = list(self._known_channels)

    def close_dialogs(self) -> None:
        self.dialogs.clear()

    def pause_scan(self) -> None:
        """Pause the scan; GXSM's own simulator has no status bit for it."""
        if self.scan.activity is not None:
            self.scan.activity.pause(self.clock.now_s())

    def resume_scan(self) -> None:
        if self.scan.activity is not None:
            self.scan.activity.resume(self.clock.now_s())

    def switch_feedback(self, *, on: bool) -> None:
        self.rig.switch_feedback(self.clock.now_s(), on=on)
        self.rig.adjust(self.clock.now_s())

    def open_file(self, path: Path) -> None:
        """Open a file: its path becomes the "basename" of all later scans, and its frame the next scan's."""
        self.panel.original = str(path)
        scan = read(path).scans[0]
        (x, y), (width, height) = scan.region.center_m, scan.region.size_m
        for ref, length_m in (("OffsetX", x), ("OffsetY", y), ("RangeX", width), ("RangeY", height)):
            self.entries.put(ref, length_m / ANGSTROM_M)
        self.entries.put("Rotation", -math.degrees(scan.region.angle_rad))
        self.entries.put("PointsX", scan.shape[1])
        self.entries.put("PointsY", scan.shape[0])

    def open_here(self, path: Path, number: int = 0) -> None:
        """Open a file in the window of a channel. During a scan the picture replaces the lines scanned so far."""
        assert self.scan.activity is not None
        self.open_file(path)
        channel, content, shape = self.channels[number], read(path), self.scan.activity.shape
        picture = _resized(stored(content).astype(np.float32), shape)
        self.scan.memory[channel] = picture
        self.scan.opened[channel] = self.scan.activity.lines_done(self.clock.now_s()), content
        self._pictures.setdefault(channel, []).append(picture)

    def save_as(self, path: Path, number: int = 0) -> None:
        """Save a channel under another name, at once."""
        path.write_bytes(self._file(self.channels[number], path, finished=self._is_finished(self.clock.now_s())))

    def keep_movie(self) -> None:
        """Keep the last scan as the picture of a *Movie*."""
        assert self.scan.activity is not None
        rows, columns = self.scan.activity.shape
        self.panel.movie = columns, rows

    def retrieve(self) -> None:
        """Copy the picture of the last *Movie* over the memory; with another size, that ends GXSM during a scan."""
        scan = self.scan.activity
        if self.panel.movie is not None and scan is not None and self.scan.runs:
            self.has_crashed = self.has_crashed or self.panel.movie != scan.shape[::-1]

    def save(self, now_s: float, *, finished: bool = False) -> None:
        """Save the last scan, if any; a saved scan is saved again under the next number.

        Args:
            finished: True if GXSM has finished its own work on the scan; False: decided by the time since its end.
        """
        if self.scan.activity is None:
            return
        if self.scan.saved:
            self.scan.own = []
        own = [self.saving.free(ending, self.scan.number) for ending in self._endings()]
        finished = finished or self._is_finished(now_s)
        pairs = zip(own, self.channels, strict=True)
        self.saving.write([(path, self._file(one, path, finished=finished)) for path, one in pairs], now_s)
        self.saving.counted(own)
        self.scan.own, self.scan.saved = own, True

    def _is_finished(self, now_s: float) -> bool:
        return self.scan.activity is not None and now_s >= self.scan.activity.end_s + UNFINISHED_S

    def _endings(self) -> list[str]:
        return [channel.ending(master=number == 0) for number, channel in enumerate(self.channels)]

    def _file(self, channel: GxsmChannel, path: Path, *, finished: bool) -> bytes:
        scan = self.scan.activity
        assert scan is not None
        image, (_, opened) = self.image(channel), self.scan.opened.get(channel, (0, None))
        pictures = [_resized(one, scan.shape) for one in self._pictures.get(channel, ())]
        saved = files.GxsmScanFile(
            str(path),
            channel.label,
            image[None] if opened is None or len(pictures) == 1 else np.stack(pictures),
            channel.dz,
            channel.unit,
            self.scan.frame,
            self._file_clock.shown_s(scan.start_s) if opened is None else (opened.start_ns or 0) / NS_PER_S,
            self._file_clock.shown_s(scan.end_s) if finished else self.scan.ended_before_s,
            CARDS[self.card],
            scan.bias_v,
            self.panel.original,
        )
        return files.netcdf3(saved) if self.version == 3 else files.netcdf4(saved)

    # --- the tip ---

    def move_tip(self, x: float, y: float) -> float:
        """Move the tip to x, y in ångström from the frame's centre; return 0, or -1 if outside the frame."""
        sides = self.entries["RangeX"], self.entries["RangeY"]
        if not all(abs(value) <= side / 2 * (1 + 1e-9) for value, side in zip((x, y), sides, strict=True)):
            return -1
        self.entries.put("ScanX", x)
        self.entries.put("ScanY", y)
        self._move()
        return 0

    def _move(self) -> None:
        if self.rig.doing(self.clock.now_s()) in ("", "move"):
            self.rig.move_probe(self.tip_m(), self.clock.now_s())

    def tip_m(self) -> tuple[float, float]:
        """Return the target position of the tip, (x, y) in m."""
        angle, (cx, cy) = -math.radians(self.entries["Rotation"]), self.frame().center_m
        u, v = (self.entries[ref] * ANGSTROM_M for ref in ("ScanX", "ScanY"))
        return cx + math.cos(angle) * u - math.sin(angle) * v, cy + math.sin(angle) * u + math.cos(angle) * v

    # --- spectra ---

    def take_curve(self, kind: str) -> None:
        """Start a spectrum if possible. GXSM reports no failure."""
        if self.rig.busy(self.clock.now_s()):
            return
        try:
            self.curve = self.rig.start_spectrum(kind, self.clock.now_s(), curve=self._swept(kind))
        except InvalidValue as error:
            self.dialogs.append(str(error))

    def _swept(self, kind: str) -> SweptCurve:
        if kind != "IV" or self.card == "simulator":
            return SweptCurve()
        first_v, last_v, points = (self.entries[self._of_iv(entry)] for entry in ("Start", "End", "Points"))
        return SweptCurve((first_v, last_v), int(points))

    def columns(self, curve: SpectrumActivity) -> dict[str, np.ndarray]:
        """Return a spectrum's columns by GXSM's labels."""
        blanks = "    " if self.card == "RPSPMC" else ""
        found = {}
        for name, unit, values in zip(curve.names, curve.units, curve.values.T, strict=True):
            scale, shown = {"m": (1e10, "Å"), "A": (1e9, "nA")}.get(unit, (1.0, unit))
            found[f"{blanks}{_COLUMNS.get(name, name)} ({shown})"] = values * scale
        return found

    def _save_curve(self, curve: SpectrumActivity, now_s: float) -> None:
        self._curves += 1
        path = self._curve_path()
        while self.card == "RPSPMC" and path.exists():  # RPSPMC skips existing names, other hardware overwrites them
            self._curves += 1
            path = self._curve_path()
        offset = self.entries["OffsetX"], self.entries["OffsetY"]
        version = "00.03" if self.card == "RPSPMC" else "00.02"
        shown_s, bias_v = self._file_clock.shown_s(now_s), self.rig.setup.bias_v
        saved = files.GxsmSpectrumFile(str(path), self.columns(curve), shown_s, offset, bias_v, version)
        self.saving.write([(path, files.vpdata(saved))], now_s)

    def _curve_path(self) -> Path:
        return self.folder / f"scan{self.saving.counter:03d}-VP{self._curves:03d}-VP.vpdata"


def _resized(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    # Where both sizes overlap, the memory keeps its values; the rest is zero.
    found = np.zeros(shape, np.float32)
    rows, columns = (min(pair) for pair in zip(shape, image.shape, strict=True))
    found[:rows, :columns] = image[:rows, :columns]
    return found
