"""The tree of commands in Lua: `root` of the application, and `root` of a measurement session."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Any, Final

from afspm.basics import Plain, PlainMapping
from afspm.emulation import ScriptFailed
from afspm.plugins.nanosurf.emulator.studio import CYCLES, MODES, PANEL, PROCEDURES_S, SETPOINT, StudioProgram
from afspm.plugins.nanosurf.emulator.workspace import MeasurementQueue, Workspace

SESSION: Final = "91-01-000"
"""Name of the only session: the maker's client has this name for a simulated controller."""
FIRST_WITH_THIS_TREE: Final = 17
LAST_WITH_OLD_COMMANDS: Final = 18
ALL_LEVELS: Final = 5
_INT32: Final = 2**31 - 1
_FIELDS: Final = ("unit", "units", "min", "max")
"""Fields of a property besides its value."""
_SYNCHRONIZED: Final = 3
_MEMORY: Final = 64 << 20
"""Highest memory of all scripts together, in bytes."""
_ROOM: Final = 16 << 20
"""Highest memory that scripts may keep after their end, in bytes. All scripts share one Lua, as in Studio. If
collecting garbage does not help, a new Lua replaces it: deleting globals is not enough, since handlers of signals keep
values."""
_WRAPPER: Final = Path(__file__).with_name("wrapper.py.in")

_SCAN_SIGNALS: Final = ("scanning_started", "scanning_finished")
_MOVE_SIGNALS: Final = ("approach_started", "withdraw_started", "approach_or_withdraw_finished")
_BEFORE: Final = {
    "imaging.property.points_per_line": "imaging.points_per_line",
    "imaging.property.lines_per_frame": "imaging.lines_per_frame",
    "imaging.property.scan_range_fast_axis": "imaging.scan_range_fast_axis",
    "imaging.property.scan_range_slow_axis": "imaging.scan_range_slow_axis",
    "imaging.property.image_offset_x": "imaging.frame_center_offset_x",
    "imaging.property.image_offset_y": "imaging.frame_center_offset_y",
    "imaging.property.rotation": "imaging.rotation",
    "imaging.property.line_rate": "imaging.line_rate",
    "imaging.property.slope_x": "imaging.slope_x",
    "imaging.property.slope_y": "imaging.slope_y",
    "imaging.property.scan_mode": "imaging.scan_mode",
    "imaging.property.slow_axis_scan_direction": "imaging.slow_axis_scan_direction",
    "z_controller.property.setpoint": SETPOINT,
    "z_controller.property.i_gain": "z_control.i_gain",
    "approach.property.approach_speed": "approach.approach_speed",
    "storage.property.gallery_directory": "data.storage.gallery_directory",
    "storage.property.name_pattern": "data.storage.file_basename",
    "storage.property.next_file_index": "data.storage.next_file_index",
    "storage.property.nhf_backend_enabled": "data.storage.nhf_backend_enabled",
    "storage.property.nhf_auto_store_mode": "data.storage.nhf_auto_store_mode",
    "storage.property.auto_save_partial_measurements": "data.storage.save_partial_measurements",
}
"""Values before release 17, with the panels' paths; the names are those of nanosurf 1.9.4."""

Nested = Plain


class CommandTree:
    """Both trees in one Lua engine, and the scripts that run in them.

    Args:
        release: release of Studio; 19 has no `is_scanning`, and before 17 there is another tree.
        image_buffer: number of the low-level buffer with the running scan.
        level_chosen: called with the level when a client selects the session, None for the application.
    """

    def __init__(
        self,
        program: StudioProgram,
        release: int,
        image_buffer: int,
        level_chosen: Callable[[int | None], None],
        log: logging.Logger,
    ) -> None:
        self._program, self._release, self._image_buffer = program, release, image_buffer
        self._buffered: list[tuple[str, str, list[float]]] = []
        self._level_chosen, self._log = level_chosen, log
        self._is_moving, self._begun = False, ""
        self._workspace = Workspace(program)
        self._queue = MeasurementQueue(program, self._workspace)
        program.on_signal = self._signalled
        self._open()

    def _open(self) -> None:
        # A new Lua has nothing that scripts have stored in the previous one.
        from lupa import lua54

        self._lua = lua54.LuaRuntime(
            register_eval=False, register_builtins=False, unpack_returned_tuples=True, max_memory=_MEMORY
        )
        self._prelude = self._lua.execute(Path(__file__).with_name("prelude.lua").read_text(encoding="utf-8"))
        self._signals = {name: self._prelude.signal() for name in (*_SCAN_SIGNALS, *_MOVE_SIGNALS)}
        shared = self._shared()
        self._roots: dict[int | None, object] = {None: self._prelude.environment(self._in_lua(shared))}
        is_before = self._release < FIRST_WITH_THIS_TREE
        workflow = self._old_workflow() if is_before else self._workflow()
        for level in range(1, ALL_LEVELS + 1):
            self._roots[level] = self._prelude.environment(self._in_lua({**shared, **self._session(workflow, level)}))

    def start(self, script: str, level: int | None) -> tuple[object, str | None]:
        """Return (script, None), or (None, reply with the error) if the script can't be compiled.

        Raises:
            ScriptFailed: the memory is used up.
        """
        with self._bounded():
            started = self._prelude.start(script, self._roots[level])
        return started if isinstance(started, tuple) else ((self._prelude, started), None)

    def step(self, script: Any) -> str | None:
        """Continue a script; return its reply, or None while the script waits for the instrument.

        Raises:
            ScriptFailed: the memory is used up.
        """
        prelude, started = script
        if prelude is not self._prelude:
            raise ScriptFailed("another script has used up the memory, which ended all")
        with self._bounded():
            reply: str | None = prelude.step(started)
        return reply

    @contextmanager
    def _bounded(self) -> Iterator[None]:
        # Scripts of all clients share the memory: a script that stores too much would end the emulator.
        from lupa import lua54

        try:
            yield
        except lua54.LuaMemoryError as error:
            raise ScriptFailed("not enough memory") from error
        finally:
            if self._lua.get_memory_used() > _ROOM:
                self._prelude.collect()
                if self._lua.get_memory_used() > _ROOM:
                    self._log.warning("scripts have used up the memory: what they kept is gone")
                    self._open()

    # -- inside

    def _signalled(self, name: str) -> None:
        try:
            with self._bounded():
                self._signals[name].call()
        except ScriptFailed as error:
            self._log.warning("the handlers of %s were not called: %s", name, error)

    def _function(self, call: Callable[..., object]) -> object:
        return self._prelude.as_function(call)

    def _table(self, nested: PlainMapping) -> object:
        return self._lua.table_from({name: self._in_lua(inner) for name, inner in nested.items()})

    def _in_lua(self, inner: Any) -> object:
        if isinstance(inner, dict):
            return self._prelude.branch(self._table(inner))
        return self._function(inner) if _is_python(inner) else inner

    def _shared(self) -> Nested:
        version: Nested = {
            "major": lambda: self._release,
            "minor": lambda: 0,
            "name": lambda: "Nanosurf Studio SIMULATED",
        }
        if self._release >= FIRST_WITH_THIS_TREE:
            version["full"] = lambda: f"{self._release}.0.0"
        session = {
            "list": lambda: self._lua.table_from([SESSION]),
            "select": self._select,
            "select_main": lambda *_: self._level_chosen(None),
        }
        python = {"create_python_wrapper": self._prelude.with_plain_tree(self._write_wrapper)}
        return {
            "session": session,
            "version": version,
            "scripting": {"wrapper": {"python": python}},
            "util": {"fill_environments": lambda: None},
        }

    def _select(self, session: str, level: float = 1) -> None:
        if session != SESSION or not 1 <= level <= ALL_LEVELS:
            raise ScriptFailed(f"there is no session {session!r} with level {level}")
        self._level_chosen(int(level))

    def _session(self, workflow: Nested, level: int) -> Nested:
        # A licence of a higher level adds commands to the application's own commands.
        imaging = workflow["imaging"]
        # The real tree has the old commands at the highest level only.
        if level == ALL_LEVELS and FIRST_WITH_THIS_TREE <= self._release <= LAST_WITH_OLD_COMMANDS:
            imaging = {**imaging, "is_scanning": lambda: self._program.scanning}
        found: Nested = {"workflow": {**workflow, "imaging": imaging}}
        if level > 1 and self._release >= FIRST_WITH_THIS_TREE:
            found["core"] = {"acquisition": self._buffers()}
        return found

    def _workflow(self) -> Nested:
        workflow: Nested = {}
        for path in PANEL:
            _put(workflow, path, self._property(path))
        program = self._program
        busy = program.rig.busy
        workflow["imaging"] |= {
            **{name: self._signals[name] for name in _SCAN_SIGNALS},
            "start": lambda: program.start_scan(self._now_s),
            "stop": lambda: program.stop_scan(self._now_s),
            "pause": lambda: program.pause(self._now_s),
            "resume": lambda: program.resume(self._now_s),
            "acquire": self._blocking(lambda: program.start_scan(self._now_s), lambda: program.scanning),
        }
        workflow["approach"] |= {
            "approach": self._blocking(program.engage, lambda: program.engages or busy(self._now_s)),
            "approach_async": program.engage,
            "withdraw": self._blocking(lambda: program.withdraw(self._now_s), lambda: busy(self._now_s)),
            "stop_approach": program.stop_engaging,
        }
        workflow["spectroscopy"] |= {
            "start": lambda: program.start_curves(self._now_s),
            "stop": program.stop_curve,
            "acquire": self._blocking(lambda: program.start_curves(self._now_s), lambda: program.measuring_curve),
            "select_cycle": program.select_cycle,
            "select_cycle_by_id": program.select_cycle,
            "cycle_count": lambda: len(CYCLES),
            "cycle_id": lambda number: dict(enumerate(CYCLES)).get(number),
        }
        workflow["scanner"]["move_to_target_offsets"] = program.move
        workflow["mode"]["current_mode_name"] = lambda: program.values["mode.name"]
        for mode, commands in MODES.items():
            workflow["mode"][mode] = {command: lambda mode=mode: program.load_mode(mode) for command in commands}
        for path in PROCEDURES_S:
            _put(workflow, path, self._procedure(path))
        workflow["probe"]["cantilever_calibration"]["apply"] = program.apply_calibration
        workflow["workspace"] = self._workspace_commands()
        workflow["automation"] |= self._automation_commands()
        return workflow

    def _old_workflow(self) -> Nested:
        # The tree before release 17, without spectroscopy. Its commands do not wait for their end.
        workflow: Nested = {}
        for path, panel in _BEFORE.items():
            _put(workflow, path, self._property(panel, bare=True))
        program = self._program
        program.when_advanced = self._watch_move
        workflow["imaging"] |= {
            "start_imaging": lambda: program.start_scan(self._now_s),
            "stop_imaging": lambda: program.stop_scan(self._now_s),
            "is_scanning": lambda: program.scanning,
            "signal": {name: self._signals[name] for name in _SCAN_SIGNALS},
        }
        workflow["approach"] |= {
            "start_approach": lambda: self._move("approach_started", program.engage),
            "start_withdraw": lambda: self._move("withdraw_started", lambda: program.withdraw(self._now_s)),
            "abort": program.stop_engaging,
            "signal": {name: self._signals[name] for name in _MOVE_SIGNALS},
        }
        return workflow

    def _move(self, signal: str, begin: Callable[[], None]) -> None:
        begin()
        self._is_moving, self._begun = True, signal

    def _watch_move(self, now_s: float) -> bool:
        # not in `_move`: handlers can't be called while the script of a client runs
        if self._begun:
            self._signalled(self._begun)
            self._begun = ""
        if self._is_moving and not self._program.engages and not self._program.rig.busy(now_s):
            self._is_moving = False
            self._signalled("approach_or_withdraw_finished")
        return False

    def _procedure(self, path: str) -> object:
        program = self._program
        return self._blocking(partial(program.begin_procedure, path), lambda: program.rig.doing(self._now_s) == path)

    def _workspace_commands(self) -> Nested:
        # the field names in the results of `get_item_…` are made up (! dates-in-names)
        items = self._workspace

        def getter(**names: str) -> Callable[[str], object]:
            def get(item_id: str) -> object:
                return self._lua.table_from({name: getattr(items[item_id], of) for name, of in names.items()})

            return get

        return {
            **{f"add_{kind}": partial(items.add, kind) for kind in ("frame", "grid", "point")},
            "item_id_by_name": items.id_of,
            "item_count": lambda: len(items.ids()),
            "item_exists": lambda item_id: item_id in items.ids(),
            "all_item_ids": lambda: self._lua.table_from(items.ids()),
            "delete_item": items.delete,
            "clear": items.clear,
            "save_to_file": items.save,
            "load_from_file": items.load,
            "get_item_name": lambda item_id: items[item_id].name,
            "get_item_position": getter(x="x_m", y="y_m"),
            "get_item_size": getter(width="width_m", height="height_m"),
            "get_item_resolution": getter(columns="columns", rows="rows"),
            "get_item_rotation": lambda item_id: items[item_id].rotation_deg,
            "set_item_name": lambda item_id, name: items.change(item_id, name=str(name)),
            "set_item_position": lambda item_id, x, y: items.change(item_id, x_m=float(x), y_m=float(y)),
            "set_item_size": lambda item_id, width, height: items.change(
                item_id, width_m=float(width), height_m=float(height)
            ),
            "set_item_resolution": lambda item_id, columns, rows: items.change(
                item_id, columns=int(columns), rows=int(rows)
            ),
            "set_item_rotation": lambda item_id, angle: items.change(item_id, rotation_deg=float(angle)),
        }

    def _automation_commands(self) -> Nested:
        queue = self._queue

        def ids(given: Any) -> list[str]:
            return [given] if isinstance(given, str) else list(given.values())

        def processing(begin: Callable[..., None]) -> object:
            return self._blocking(begin, lambda: queue.running, lambda: queue.message)

        return {
            "add_to_queue": lambda given, repetitions=1: queue.add(ids(given), int(repetitions)),
            "remove_from_queue": queue.remove,
            "clear_queue": lambda: queue.entries.clear(),
            "queue_size": lambda: len(queue.entries),
            "is_running": lambda: queue.running,
            "abort": queue.abort,
            "start": lambda: queue.process(queue.entries),
            "process_queue": processing(lambda: queue.process(queue.entries)),
            "process_item": processing(lambda item_id: queue.process([(item_id, 1)])),
        }

    @property
    def _now_s(self) -> float:
        return self._program.now_s

    def _blocking(
        self, call: Callable[..., None], waiting: Callable[[], bool], message: Callable[[], str] = lambda: ""
    ) -> object:
        return self._prelude.blocking(call, waiting, message)

    def _property(self, path: str, *, bare: bool = False) -> object:
        row, program = PANEL[path], self._program
        field = "value_raw" if row.enum else "value"
        fields: Nested = {field: {"get": lambda: program.get(path), "set": lambda value: program.put(path, value)}}
        if path == SETPOINT:
            fields["unit"] = {"get": lambda: program.setpoint_unit, "set": program.set_setpoint_unit}
            fields["units"] = {"get": lambda: self._lua.table_from(list(program.setpoint_units))}
        elif row.unit:
            fields["unit"] = {"get": lambda: row.unit}
        if row.unit and row.low > -1e300:
            fields["min"] = {"get": lambda: program.bounds(path)[0]}
            fields["max"] = {"get": lambda: program.bounds(path)[1]}
        table = {name: self._lua.table_from(access) for name, access in fields.items()}
        enum = self._lua.table_from(dict(row.enum)) if row.enum else None
        return self._prelude.property(self._lua.table_from(table), enum, bare)

    def _buffers(self) -> Nested:
        def numbers(buffer: float, channel: float) -> object:
            values = self._channel(buffer, channel)[2]
            span = self._span(values)
            return self._lua.table_from([round(value / span * _INT32) for value in values])

        def known(buffer: float) -> bool:
            return buffer == self._image_buffer

        def synchronize(buffer: float) -> None:
            # until the next call all reads are of one moment: a line that ends in between would have another range
            if known(buffer):
                self._buffered = self._program.lines()

        return {
            "reserve_lu_data_buffer": lambda buffer: None,
            "synchronize_lu_data_buffer": synchronize,
            "lu_data_buffer_state": lambda buffer: _SYNCHRONIZED if known(buffer) and self._buffered else 0,
            "lu_data_buffer_channel_count": lambda buffer: len(self._buffered) if known(buffer) else 0,
            "lu_data_buffer_channel_name": lambda buffer, channel: self._channel(buffer, channel)[0],
            "lu_data_buffer_channel_unit": lambda buffer, channel: self._channel(buffer, channel)[1],
            "lu_data_buffer_channel_range": lambda buffer, channel: self._span(self._channel(buffer, channel)[2]),
            "lu_data_buffer_channel_data": numbers,
        }

    def _channel(self, buffer: float, channel: float) -> tuple[str, str, list[float]]:
        if buffer != self._image_buffer or not 0 <= channel < len(self._buffered):
            raise ScriptFailed(f"there is no channel {channel} in the buffer {buffer}")
        return self._buffered[int(channel)]

    @staticmethod
    def _span(values: list[float]) -> float:
        return max(map(abs, values), default=1.0) or 1.0

    def _write_wrapper(self, root: object, name: str, path: str) -> None:
        # The maker's client requests Python classes for the tree, by the path of its own file.
        file = Path(path)
        if not (PureWindowsPath(path).name.startswith("cmd_tree_") and file.suffix == ".py" and file.parent.is_dir()):
            raise ScriptFailed(f"{path!r} is not the file of a wrapper")
        tree = json.dumps(_described(root))
        text = _WRAPPER.read_text(encoding="utf-8").replace("@TREE@", repr(tree)).replace("@ROOT@", repr(name))
        file.write_text(text, encoding="utf-8")


def _put(tree: Nested, path: str, node: object) -> None:
    *parents, name = path.split(".")
    for parent in parents:
        tree = tree.setdefault(parent, {})
    tree[name] = node


def _is_python(value: object) -> bool:
    return callable(value) and type(value).__module__ != "lupa" and not type(value).__module__.startswith("lupa.")


def _described(table: Any) -> Nested:
    from lupa import lua54

    found: Nested = {}
    for name, inner in table.items():
        kind = lua54.lua_type(inner)
        if kind == "table":
            choices = inner["enum"]
            is_property = inner["value_get"] is not None or inner["value_raw_get"] is not None
            if is_property:
                fields = {one: inner[f"{one}_set"] is not None for one in _FIELDS if inner[f"{one}_get"] is not None}
                found[str(name)] = {"enum": dict(choices.items()) if choices is not None else None, "fields": fields}
            else:
                found[str(name)] = {"node": _described(inner)}
        elif kind == "function":
            found[str(name)] = "function"
    return found
