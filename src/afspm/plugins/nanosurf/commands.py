"""Commands of Nanosurf Studio that the driver uses, and the releases that have them.

The names come from the command tree in nanosurf-core 2.0.7 (MIT). The mark (!) stands for an unconfirmed fact.
"""

from __future__ import annotations

from typing import Final

from afspm.basics.errors import ConfigError

FIRST_RELEASE: Final = 17
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
    afspm_seen.scanning = true
    afspm_seen.started = afspm_seen.started + 1
  end)
  {WORKFLOW}.{FINISHED}.connect(function() afspm_seen.scanning = false end)
end
return {WORKFLOW}.{STARTED}.empty()
"""
"""Connects handlers that count scans; returns true if Studio has not connected the handlers."""

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
  units[i] = node ~= nil and node.unit_get ~= nil and node.unit_get() or ""
end
return units
"""
"""Returns the units of a list of paths; an empty text for a value without a unit."""

PUT_ALL: Final = """
local done = {}
local function same(node, unit)
  local now = node.unit_get()
  if now ~= unit then error("its unit was changed from " .. unit .. " to " .. tostring(now), 0) end
end
local function put(node, field, value)
  local before = node[field .. "_get"]()
  node[field .. "_set"](value)
  table.insert(done, 1, function() node[field .. "_set"](before) end)
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

STOP_ALL: Final = f"""
local imaging, spectroscopy, approach = {WORKFLOW}.imaging, {WORKFLOW}.spectroscopy, {WORKFLOW}.approach
pcall(imaging.stop) pcall(spectroscopy.stop) pcall(approach.stop_approach)
"""
"""Stops scan, curve and approach; an error of one stop does not prevent the others."""


def has_old_commands(release: int) -> bool:
    """Return whether a release (17 or 18) has the old commands, which 19 lacks.

    Raises:
        ConfigError: the release is older than 17.
    """
    if release < FIRST_RELEASE:
        hint = f"{FIRST_RELEASE} or later"
        raise ConfigError(f"Nanosurf Studio {release} is too old for afspm", where="release", hint=hint)
    return release < _WITHOUT_OLD


def used(release: int) -> tuple[str, ...]:
    """Return the paths of all commands used with a release."""
    return (*_ALWAYS, *((IS_SCANNING,) if has_old_commands(release) else _SIGNALS))


def level(release: int) -> int:
    """Return the lowest session level with the used commands: the old commands need the highest level (!)."""
    return 5 if has_old_commands(release) else 1
