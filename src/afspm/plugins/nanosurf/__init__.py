"""Driver of Nanosurf microscopes, over the scripting interface of Nanosurf Studio. See the README in this folder.

**Theory of operation.** Every request is a Lua script, and the reply is its value (`link`, `lua_values`). Quick scripts
share the first connection; each long command (approach, withdrawal, curve) has a separate connection (`session`).

    inputs        values of scripts; new .nhf files in Studio's gallery
    state         the running and the ended measurement (persistent), the running long command (`activity`)
    outputs       scripts (`commands`); scans and force curves from files; lines from a low-level buffer
    invariants    all commands and units are checked before the first is used; values are set all or none; a stop that
                  may have overtaken its start is repeated
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

from afspm.basics import ConfigError, Duration, PlainMapping, PollPeriod, Refused
from afspm.driver import FRAME, POSITION, KeptSettings, ScriptedDriver, Value, VariableRoles, action, frame
from afspm.model import ControlResponse, ScanLines, ScopeState, both_ways, names
from afspm.plugins.nanosurf import commands
from afspm.plugins.nanosurf.activity import FORCE, NanosurfFiles, ScanTime, StudioActivity
from afspm.plugins.nanosurf.link import Link, StudioError
from afspm.plugins.nanosurf.session import Session, new_lines
from afspm.plugins.nanosurf.settings import DIRECTION, SPEED_PATH, UNITS, FrameSettings, Slopes, TipPlace, direction

_AT_FIRST: Final[dict[str, Value]] = {names.SCAN_DIRECTION: names.UP, names.SPEC_KIND: FORCE}
_STORAGE: Final = "data.storage"
_ONE_FRAME: Final = 1
_NEW_FILE: Final = 1
SAVES: Final[dict[str, Value]] = {
    f"{_STORAGE}.nhf_backend_enabled": True,
    f"{_STORAGE}.nhf_auto_store_mode": _NEW_FILE,
}
"""The settings with which Studio saves each measurement to a new file."""
PARTS: Final = f"{_STORAGE}.save_partial_measurements"
"""The setting with which Studio saves a stopped scan as well: its missing lines show that it was stopped."""
_CHANNELS: Final = both_ways(
    {
        "height": ["Height", "Topography", "Z-Axis"],
        "current": ["Current", "Tip Current"],
        "amplitude": ["Amplitude"],
        "phase": ["Phase"],
        "deflection": ["Deflection"],
        "friction": ["Friction force"],
        "other": ["Z-Axis Sensor", "Frequency Shift"],
    },
    "{} Forward",
    "{} Backward",
)


_VARIABLES: Final = VariableRoles.declared(
    {
        "bias": ["Tip voltage", "Bias"],
        "height": ["Z", "Z-Axis", "Z-Axis Sensor"],
        "current": ["Current", "Tip Current"],
        "force": ["Force"],
        "deflection": ["Deflection"],
        "amplitude": ["Amplitude"],
        "phase": ["Phase"],
    },
    towards=["Z-Axis", "Z-Axis Sensor"],
)
"""Both ways are in the same columns, the approach first."""


class Nanosurf(ScriptedDriver[Session, StudioActivity]):
    """The microscope behind Nanosurf Studio.

    Args:
        address: "host:port" of Studio's scripting interface.
        release: release of Studio (Help > About), 13 or later, which decides the commands to use. Before 17 neither
            force curves nor positions of the tip are supported.
        session: name of the measurement session, such as "91-21-004". Default: the only open session.
        gallery_dir: local path of Studio's gallery folder. Default: Studio runs on this computer.
        image_buffer: number of the low-level buffer with the running scan, for its lines. Default: no lines are read.
        reply_timeout_s: longest wait for a reply, real time.
        poll_period_s, common: settings of every driver.
    """

    parameters_file = Path(__file__).with_name("parameters.toml")
    translated = (*FrameSettings.names, *Slopes.names, *POSITION, *_AT_FIRST, names.CONTROLLER)
    channel_roles = _CHANNELS
    variable_roles = _VARIABLES
    maker: ClassVar[str] = "Nanosurf"
    software: ClassVar[str] = "Nanosurf Studio"
    program: ClassVar[str] = StudioActivity.program
    serves_several: ClassVar[bool] = True
    max_pixels: ClassVar[int] = 8192 * 8192
    program_s: ClassVar[float] = 2.0
    never_shows: ClassVar = {
        "which measurement it is": "Studio names no file: the newest is taken",
        "another one begun": "before Studio 19 a stop and a start between two looks seem one scan",
        "stop of a scan": "Studio shows only that no scan runs: an end that comes too soon counts as a stop",
        "stop of a spectrum": "Studio shows nothing of it",
    }
    shadow: ClassVar[str] = "afspm.plugins.nanosurf.shadow.NanosurfShadow"
    link: ClassVar[type[Link]] = Link

    def __init__(
        self,
        *,
        address: str = "127.0.0.1:33030",
        release: int = 19,
        session: str = "",
        gallery_dir: str | None = None,
        image_buffer: int | None = None,
        reply_timeout_s: Duration = 5.0,
        poll_period_s: PollPeriod = 0.25,
        **common: Any,
    ) -> None:
        super().__init__(poll_period_s=poll_period_s, **common)
        if self.common.live_lines_s is not None and image_buffer is None:
            hint = "set `image_buffer`; its number is not published, so ask Nanosurf"
            raise ConfigError("lines of a running scan need `image_buffer`", where="live_lines_s", hint=hint)
        self.controller_at = address
        self._level = max(commands.level(release), 0 if image_buffer is None else commands.BUFFER_LEVEL)
        self._release, self._session_name = release, session
        self._gallery_dir, self._image_buffer = gallery_dir, image_buffer
        self._reply_timeout_s = reply_timeout_s
        self._parts: dict[str, Value] = {}
        self._kept = KeptSettings(_AT_FIRST)
        late = "the tip did not reach the position that it was sent to"
        self._place = TipPlace(self.session, lambda: self.clock.now_s(), lambda: self.log.error(late))
        self.groups = (self._kept, FrameSettings(self.session), Slopes(self.session), self._place)
        if commands.is_before_this_tree(release):
            self._leave_out_what_is_unknown()

    @classmethod
    def technique(cls, settings: PlainMapping) -> str:
        return "AFM"

    def connect(self) -> None:
        self.close()
        session = self._session = Session(
            self._open_link, self._release, self._session_name, self._level, watches=not self.asks_once
        )
        self.prove()
        self.log.info("%s", session.controller)
        if self.lacking:
            text = "before Studio %d curves of force and positions of the tip are not supported: %s"
            self.log.warning(text, commands.WITH_THIS_TREE, commands.LACKING)
        self._check_table(session)
        self._parts = {} if session.missing([PARTS]) else {PARTS: True}
        self._kept.kept_in(self.memory)
        self._files = NanosurfFiles(self.memory, self.log)
        self._activity = StudioActivity(
            session, self._files, self._place, self.memory, self._folder, self._scan_time, self.clock, self.log
        )
        self._save_files(session)
        self._look_at_folder()

    def get(self, vendor: str) -> Value:
        return self.session().values([vendor])[vendor] if vendor != names.CONTROLLER else self.session().controller

    def lines(self, start: int) -> Sequence[ScanLines]:
        """Return new lines of the running scan, from the buffer `image_buffer`."""
        if self._image_buffer is None or self.activity.is_moved:
            return ()
        region, shape = frame(self.in_force(FRAME))
        upwards = self.session().values([DIRECTION])[DIRECTION] != direction(names.DOWN)
        return new_lines(self.session(), self._image_buffer, region, shape, start, upwards=upwards)

    # --- actions ---

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        """Scan the frame once, in the direction `x-scan-direction`."""
        self._save_files(self.session())  # a person may have switched it off
        wanted = direction(str(self._kept[names.SCAN_DIRECTION]))
        self.session().switch({DIRECTION: wanted, "imaging.scan_mode": _ONE_FRAME})
        self.activity.start_scan()

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        self.session().do(commands.STOP)
        self.activity.stopped()

    @action(names.START_SPEC)
    def start_spec(self) -> None:
        """Take a force curve at the tip's target position, with the cycle selected in Studio."""
        self._save_files(self.session())
        self.activity.start_curve()

    @action(names.STOP_SPEC)
    def stop_spec(self) -> None:
        self.session().do(commands.STOP_CURVE)
        self.activity.stopped()

    @action(names.RETRACT, state=ScopeState.COARSE_MOTOR)
    def retract(self) -> None:
        """Stop scan, curve and approach, and withdraw the tip."""
        self.activity.withdraw()

    @action(names.ENGAGE, state=ScopeState.COARSE_MOTOR)
    def engage(self) -> None:
        """Approach the sample, with the approach selected in Studio."""
        self.activity.approach()

    def command(self, text: str) -> None:
        """Run a script, e.g. `root.workflow.approach.stop_approach()`."""
        try:
            self.session().run(text)
        except StudioError as error:
            raise Refused(ControlResponse.ACTION_ERROR, f"Studio: {error}") from error

    # --- inside ---

    def _open_link(self) -> Link:
        return self.link(self.controller_at, self._reply_timeout_s, self.clock.monotonic_s)

    def _scan_time(self) -> ScanTime:
        set_now = self.in_force([*FRAME, names.SCAN_SPEED])
        region, (lines, _) = frame(set_now)
        speed_m_s = float(set_now[names.SCAN_SPEED])
        line_s = SPEED_PATH * region.size_m[0] / speed_m_s if speed_m_s > 0.0 else 0.0
        return ScanTime(region, lines, line_s)

    def _folder(self) -> Path:
        path = f"{_STORAGE}.gallery_directory"
        return Path(self._gallery_dir or str(self.session().values([path])[path]))

    def _save_files(self, session: Session) -> None:
        # The other modes append to the current file or save nothing, and results are recognised by new files.
        found = session.values([*SAVES, *self._parts])
        if found == {**SAVES, **self._parts}:
            return
        if any(found[path] != value for path, value in SAVES.items()):
            self.log.warning("Studio did not save each measurement to a new .nhf file; it does from now on")
        else:
            self.log.info("Studio saves stopped scans, too, from now on: so a stop differs from an end")
        session.switch({**SAVES, **self._parts})

    def _look_at_folder(self) -> None:
        folder = self._folder()
        if not folder.is_dir():
            problem = f"Studio's gallery {folder} does not exist on this computer"
            raise ConfigError(problem, where="gallery_dir", hint='gallery_dir = "/where/it/is/mounted"')
        self._files.look(folder)

    def _leave_out_what_is_unknown(self) -> None:
        if self._image_buffer is not None:
            raise ConfigError(f"image_buffer: {commands.LACKING}", where="image_buffer", hint="leave it out")
        self.table = self.table.without({*POSITION, names.MOVE_SPEED, names.SPEC_KIND})
        self.lacking = dict.fromkeys((names.START_SPEC, names.STOP_SPEC), commands.LACKING)

    def _check_table(self, session: Session) -> None:
        rows = {row.vendor: row for row in self.table.values() if "." in row.vendor}
        is_before = commands.is_before_this_tree(self._release)
        # The tree differs between releases and licences: a missing path would fail in the middle of a night.
        own = {commands.path_in(self._release, path): row for path, row in rows.items()}
        for path in session.missing(rows):
            raise ConfigError(f"Studio has no {path}", where=own[path].name, hint="a path below root.workflow")
        units_of = {path: units for path, units in UNITS.items() if not (is_before and path.startswith("scanner."))}
        expected = {**units_of, **{path: (row.unit,) for path, row in rows.items() if row.type == "float"}}
        # A value in another unit would be converted by a wrong factor: refuse at the start.
        units = session.units(expected)
        for path, unit in units.items():
            if unit not in expected[path]:
                problem = f"Studio has {path} in {unit or 'no unit'}, not in {expected[path][0] or 'none'}"
                name = rows[path].name if path in rows else ""
                hint = f'[microscope.parameters.{name}] unit = "{unit}", with a range' if name else "report it"
                raise ConfigError(problem, where=name or path, hint=hint)
        session.keep_units(units)
