"""Driver of Park microscopes, over SmartScan's SmartRemote. See the README in this folder.

**Theory of operation.** A request is a query or a JavaScript expression in JSON-RPC over ZeroMQ (`link`). An expression
is wrapped in a function that returns its error. Each long script has a separate connection (`session`). Several answers
of SmartScan are unconfirmed: the driver accepts each plausible form, and refuses unknown words instead of guessing.

    inputs        replies; new TIFF files below SmartScan's base folder, one for each channel and direction
    state         the running and the ended measurement, the target position of the tip: persistent; the running
                  long script (`activity`)
    outputs       expressions; scans and curves from files
    invariants    a reply of unknown form ends the connection; the files of a scan are read once no further file appears
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

from afspm.basics import ConfigError, Duration, Length, PlainMapping, PollPeriod, Refused, lengths_text
from afspm.driver import FRAME, POSITION, KeptSettings, LongCall, ScriptedDriver, Value, VariableRoles, action, frame
from afspm.model import ControlResponse, Region, ScopeState, both_ways, names
from afspm.plugins.park.activity import STOP, STOP_CURVE, SmartScanActivity
from afspm.plugins.park.link import Link, SmartScanError
from afspm.plugins.park.result_files import SETTLE_S, ParkFiles
from afspm.plugins.park.session import FALSE, TRUE, Session
from afspm.plugins.park.settings import MICROMETRE, FrameSettings, Gains, TipPlace

_SCANNING: Final = TRUE | {"scanning", "running"}
_IDLE: Final = FALSE | {"idle", "ready", "done", "stopped"}
_AT_FIRST: Final[dict[str, Value]] = {names.SPEC_KIND: "force"}
_FOLDER: Final = "dataLocation.baseDir"
_CHANNELS: Final = both_ways(
    {
        "height": ["Height", "Z Height", "Topography"],
        "current": ["Current"],
        "amplitude": ["Amplitude", "NCM Amplitude"],
        "phase": ["Phase", "NCM Phase"],
        "frequency shift": ["Frequency Shift", "NCM Frequency"],
        "friction": ["Lateral Force"],
        "other": ["Z Drive", "Error Signal"],
    },
    "{} Forward",
    "{} Backward",
)


_VARIABLES: Final = VariableRoles.declared(
    {
        "bias": ["Bias", "Sample Bias", "Tip Bias"],
        "height": ["Z", "Z Height", "Z Drive", "Z Scan"],
        "current": ["Current"],
        "force": ["Force"],
        "deflection": ["Deflection"],
    }
)
"""Both ways are in the same columns, the approach first. The heights grow away from the sample."""


class Park(ScriptedDriver[Session, SmartScanActivity]):
    """The microscope behind SmartScan.

    Args:
        address: address of SmartRemote, e.g. "tcp://192.168.0.10:5581".
        data_dir: local path of SmartScan's base folder of data. Default: SmartScan runs on this computer.
        lift: distance that the stage withdraws after the scanner in `x-retract`; 0: the stage does not move.
        scanning_words, idle_words: further words in SmartScan's answers for scanning and idle.
        reply_timeout_s: longest wait for a reply, real time.
        poll_period_s, common: settings of every driver.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*FrameSettings.names, *Gains.names, *POSITION, *_AT_FIRST, names.CONTROLLER)
    channel_roles = _CHANNELS
    variable_roles = _VARIABLES
    bias_reference = "tip"  # (! tip-bias)
    maker: ClassVar[str] = "Park Systems"
    software: ClassVar[str] = "SmartScan"
    program: ClassVar[str] = SmartScanActivity.program
    serves_several: ClassVar[bool] = True
    max_pixels: ClassVar[int] = 8192 * 8192
    program_s: ClassVar[float] = 2.0 + SETTLE_S
    coarse_commands: ClassVar[str] = r"\b(zstage|xystage)\b"
    never_shows: ClassVar = {
        "which measurement it is": "SmartScan names no file: all new ones are taken",
        "another one begun": "a stop and a start between two looks seem one scan",
        "end in the file": "a file has one time, which is read as the start (! one-time)",
        "missing rows": "no mark of a row that was not scanned is known (! no-missing-rows)",
        "stop of a scan": "SmartScan shows only that no scan runs: an end that comes too soon counts as a stop",
        "stop of a spectrum": "SmartScan shows nothing of it, nor how long a curve takes",
    }
    shadow: ClassVar[str] = "afspm.plugins.park.shadow.ParkShadow"
    link: ClassVar[type[Link]] = Link

    def __init__(
        self,
        *,
        address: str = "tcp://127.0.0.1:5581",
        data_dir: str | None = None,
        lift: Length = 0.0,
        scanning_words: Sequence[str] = (),
        idle_words: Sequence[str] = (),
        reply_timeout_s: Duration = 5.0,
        poll_period_s: PollPeriod = 0.25,
        **common: Any,
    ) -> None:
        super().__init__(poll_period_s=poll_period_s, **common)
        if lift < 0.0:
            raise ConfigError(
                f"a lift of {lengths_text([lift])} would move the tip to the sample", where="lift", hint="0 or more"
            )
        self.controller_at = address
        self._data_dir, self._lift_m, self._reply_timeout_s = data_dir, lift, reply_timeout_s
        self._scanning = _SCANNING | {word.casefold() for word in scanning_words}
        self._idle = _IDLE | {word.casefold() for word in idle_words}
        both = self._scanning & self._idle
        if both:
            raise ConfigError(
                f"{', '.join(sorted(both))} would mean both scanning and idle",
                where="idle_words",
                hint="remove them from one list",
            )
        self._place = TipPlace(self.session, self._begun)
        self._kept = KeptSettings(_AT_FIRST)
        self._gains = Gains(self.session)
        self.groups = (self._kept, FrameSettings(self.session, self._see_frame), self._gains, self._place)
        self._whole_table = self.table

    @classmethod
    def technique(cls, settings: PlainMapping) -> str:
        return "AFM"

    def connect(self) -> None:
        self.close()
        session = self._session = Session(self._open_link, self._scanning, self._idle)
        self.prove()
        # Another SmartScan may answer after a reconnection: start from the complete table.
        self.table = self._whole_table
        if not self._gains.are_reported():
            self.log.warning("SmartScan does not report the gains of its feedback: they are not supported")
            self.table = self.table.without(Gains.names)
        if not session.is_number(self._whole_table[names.SAMPLE_BIAS].vendor):
            self.log.warning("SmartScan does not report the bias of the sample: it is neither set nor watched")
            self.table = self.table.without([names.SAMPLE_BIAS])
        for group in (self._kept, self._place):
            group.kept_in(self.memory)
        self._files = ParkFiles(self.memory, self.log, self.clock.monotonic_s)
        self._activity = SmartScanActivity(
            session, self._files, self.memory, self._folder, self._frame_in_force, self.clock, self.log
        )
        # last: the tip can be withdrawn even without the folder
        folder = self._folder()
        if not folder.is_dir():
            problem = f"SmartScan's folder of data {folder} does not exist on this computer"
            raise ConfigError(problem, where="data_dir", hint='data_dir = "/where/it/is/mounted"')
        self._files.look(folder)

    def get(self, vendor: str) -> Value:
        return "SmartScan" if vendor == names.CONTROLLER else self.session().values([vendor])[vendor]

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once."""
        self.activity.start_scan()

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        self.session().do(STOP)
        self.activity.stopped()

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        """Take a curve of the kind `x-spec-kind` at the tip's target position, with SmartScan's settings."""
        self.activity.start_curve(str(self._kept[names.SPEC_KIND]), self._place.xy_m())

    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        self.session().do(STOP_CURVE)
        self.activity.stopped()

    @action(names.RETRACT, state=ScopeState.COARSE_MOTOR)
    def retract(self) -> None:
        """Stop scan, curve and approach, and withdraw the tip: by the scanner, then by the stage if `lift` is set."""
        self.activity.withdraw(self._lift_m / MICROMETRE)

    @action(names.ENGAGE, state=ScopeState.COARSE_MOTOR)
    def engage(self) -> None:
        """Approach the sample by SmartScan's quick and safe approach."""
        self.activity.approach()

    def command(self, text: str) -> None:
        """Evaluate an expression, e.g. `spm.ncm.sweepAutoFullRange()`. After 0.5 s the microscope counts as busy."""
        try:
            self.activity.evaluate(text)
        except SmartScanError as error:
            raise Refused(ControlResponse.ACTION_ERROR, f"SmartScan: {error}") from error

    # --- inside ---

    def _open_link(self) -> Link:
        return self.link(self.controller_at, self._reply_timeout_s, self.clock.monotonic_s)

    def _begun(self, call: LongCall) -> None:
        self.activity.watch(call)

    def _see_frame(self, region: Region, rows: int, lines_per_s: float) -> None:
        # read for the first time before the activity exists
        if self._activity is not None:
            self._activity.see_frame(region, rows, lines_per_s)

    def _frame_in_force(self) -> Region:
        return frame(self.in_force(FRAME))[0]

    def _folder(self) -> Path:
        return Path(self._data_dir or str(self.session().values([_FOLDER])[_FOLDER]))
