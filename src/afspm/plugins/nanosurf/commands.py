"""Commands of Nanosurf Studio that the driver uses, and the releases that have them.

The names come from the command tree in nanosurf-core 2.0.7 (MIT), those before release 17 from nanosurf 1.9.4 (MIT),
which users' scripts have for Studio 13. A mark (! ID) names a row of claims.toml.
"""

from __future__ import annotations

from typing import Final

from afspm.basics import ConfigError

FIRST_RELEASE: Final = 13
"""The oldest release for which a public script is known; older ones may have other commands."""
WITH_THIS_TREE: Final = 17
"""First release with the tree of this module; older ones have the names in `_BEFORE`."""
_WITHOUT_OLD: Final = 19
"""First release without the commands that are older than release 17."""

WORKFLOW: Final = "root.workflow"
START, STOP = "imaging.start", "imaging.stop"
IS_SCANNING: Final = "imaging.is_scanning"
STARTED, FINISHED = "imaging.scanning_started", "imaging.scanning_finished"
APPROACH, WITHDRAW = "approach.approach", "approach.withdraw"
TAKE_CURVE, STOP_CURVE = "spectroscopy.acquire", "spectroscopy.stop"
MOVE: Final = "scanner.move_to_target_offsets"
GRID: Final = tuple(f"spectroscopy.grid_{name}" for name in ("center_offset_x", "center_offset_y", "columns", "rows"))
"""Paths of the values of the grid of curves: centre, columns and rows."""

_ALWAYS: Final = (START, STOP, APPROACH, WITHDRAW, TAKE_CURVE, STOP_CURVE, MOVE, *GRID)
_SIGNALS: Final = (f"{STARTED}.connect", f"{STARTED}.empty", f"{FINISHED}.connect")

WATCH: Final = f"""
if not afspm_seen then
  afspm_seen = {{scanning = false, started = 0}}
  {WORKFLOW}.{STARTED}.connect(function()
    if not afspm_seen.scanning then afspm_seen.started = afspm_seen.started + 1 end
    afspm_seen.scanning = true
  end)
  {WORKFLOW}.{FINISHED}.connect(function() afspm_seen.scanning = false end)
end
return {WORKFLOW}.{STARTED}.empty()
"""
"""Connects handlers that count scans; returns true if Studio has not connected the handlers.

A start without an end before it counts as the same scan, such as one that goes on after a pause."""

MISSING: Final = """
local missing = {}
for _, path in ipairs({%s}) do
  local node = root.workflow
  for name in path:gmatch("[^.]+") do node = type(node) == "table" and node[name] or nil end
  if node == nil then missing[#missing + 1] = path end
end
return missing
"""
"""Returns the paths of a list that the tree lacks."""


UNITS: Final = """
local units = {}
for i, path in ipairs({%s}) do
  local node = root.workflow
  for name in path:gmatch("[^.]+") do node = type(node) == "table" and node[name] or nil end
  units[i] = node ~= nil and (node.unit_get ~= nil and node.unit_get() or node.unit) or ""
end
return units
"""
"""Returns the units of a list of paths; an empty text for a value without a unit."""

PUT_ALL: Final = """
local done = {}
local function get(node, field)
  if node[field .. "_get"] then return node[field .. "_get"]() end
  return node[field]
end
local function set(node, field, value)
  if node[field .. "_set"] then node[field .. "_set"](value) else node[field] = value end
end
local function same(node, unit)
  local now = get(node, "unit")
  if now ~= unit then error("its unit was changed from " .. unit .. " to " .. tostring(now), 0) end
end
local function put(node, field, value)
  local before = get(node, field)
  set(node, field, value)
  table.insert(done, 1, function() set(node, field, before) end)
end
local fine, problem = pcall(function() %s end)
if not fine then
  for _, back in ipairs(done) do pcall(back) end
  error(problem, 0)
end
return 0
"""
"""Sets values; if a unit was changed, or Studio refuses a value, restores the values set before and fails."""

BUFFER_LEVEL: Final = 2
"""The lowest session level with low-level buffers."""
BUFFER_LINES: Final = """
local found, acquisition, buffer = {}, root.core.acquisition, %d
acquisition.synchronize_lu_data_buffer(buffer)
if acquisition.lu_data_buffer_state(buffer) ~= 3 then return found end
for channel = 0, acquisition.lu_data_buffer_channel_count(buffer) - 1 do
  found[#found + 1] = {
    acquisition.lu_data_buffer_channel_name(buffer, channel), acquisition.lu_data_buffer_channel_unit(buffer, channel),
    acquisition.lu_data_buffer_channel_range(buffer, channel), acquisition.lu_data_buffer_channel_data(buffer, channel),
  }
end
return found
"""
"""Returns name, unit, range and values of each channel of a low-level buffer.

Nothing is returned while the buffer is not synchronized. The values are integers: the largest signed 32-bit integer
stands for the range."""

_STOPS: Final = (STOP, STOP_CURVE, "approach.stop_approach")

_BEFORE: Final = {
    **{
        f"imaging.{name}": f"imaging.property.{name}"
        for name in (
            "points_per_line", "lines_per_frame", "scan_range_fast_axis", "scan_range_slow_axis", "rotation",
            "line_rate", "slope_x", "slope_y", "scan_mode", "slow_axis_scan_direction",
        )
    },
    "imaging.frame_center_offset_x": "imaging.property.image_offset_x",
    "imaging.frame_center_offset_y": "imaging.property.image_offset_y",
    "z_control.setpoint": "z_controller.property.setpoint",
    "z_control.i_gain": "z_controller.property.i_gain",
    "data.storage.gallery_directory": "storage.property.gallery_directory",
    "data.storage.nhf_backend_enabled": "storage.property.nhf_backend_enabled",
    "data.storage.nhf_auto_store_mode": "storage.property.nhf_auto_store_mode",
    "data.storage.save_partial_measurements": "storage.property.auto_save_partial_measurements",
    START: "imaging.start_imaging",
    STOP: "imaging.stop_imaging",
    APPROACH: "approach.start_approach",
    WITHDRAW: "approach.start_withdraw",
    "approach.stop_approach": "approach.abort",
}  # fmt: skip
"""Paths before release 17, by the paths of this module (! image-offset, move-signals)."""
_MOVE_SIGNALS: Final = tuple(
    f"approach.signal.{name}.connect"
    for name in ("approach_started", "withdraw_started", "approach_or_withdraw_finished")
)

WATCH_MOVES: Final = f"""
if not afspm_moves then
  afspm_moves = {{running = false}}
  local signal = {WORKFLOW}.approach.signal
  signal.approach_started.connect(function() afspm_moves.running = true end)
  signal.withdraw_started.connect(function() afspm_moves.running = true end)
  signal.approach_or_withdraw_finished.connect(function() afspm_moves.running = false end)
end
return {WORKFLOW}.approach.signal.approach_or_withdraw_finished.empty()
"""
"""Before release 17: connects handlers that watch approach and withdrawal, whose commands do not wait for the end."""

LACKING: Final = f"commands for it are known from Nanosurf Studio {WITH_THIS_TREE} on"


def is_before_this_tree(release: int) -> bool:
    """Return whether a release has the names of `_BEFORE`."""
    return release < WITH_THIS_TREE


def path_in(release: int, path: str) -> str:
    """Return the path of a value or command in the tree of a release."""
    return _BEFORE.get(path, path) if is_before_this_tree(release) else path


def stop_all(release: int) -> str:
    """Return the script that stops scan, curve and approach; an error of one stop does not prevent the others."""
    known = [path for path in _STOPS if path in _BEFORE or not is_before_this_tree(release)]
    return " ".join(f"pcall({WORKFLOW}.{path_in(release, path)})" for path in known)


def has_old_commands(release: int) -> bool:
    """Return whether a release before 19 has the old commands, which 19 lacks.

    Raises:
        ConfigError: the release is older than `FIRST_RELEASE`.
    """
    if release < FIRST_RELEASE:
        problem = f"Nanosurf Studio {release} is too old: afspm knows the commands of {FIRST_RELEASE} and later"
        raise ConfigError(problem, where="release", hint="update Studio, or send a script that controls this release")
    return release < _WITHOUT_OLD


def used(release: int) -> tuple[str, ...]:
    """Return the paths of all commands used with a release."""
    if is_before_this_tree(release):
        return (START, STOP, APPROACH, WITHDRAW, IS_SCANNING, *_MOVE_SIGNALS)
    return (*_ALWAYS, *((IS_SCANNING,) if has_old_commands(release) else _SIGNALS))


def level(release: int) -> int:
    """Return the lowest session level with the used commands: the old commands need the highest (! licence-level).

    Before release 17 the number is no level: 1 is the microscope's own tree.
    """
    return 5 if has_old_commands(release) and not is_before_this_tree(release) else 1
