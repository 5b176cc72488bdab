"""The lines of a running scan, from one of Studio's low-level buffers (a licence of a higher level has these).

Which buffer holds the image, and that its values are the lines as they were scanned, is not known (!).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from afspm.model import Region, ScanLines
from afspm.plugins.nanosurf.session import Session

_LARGEST: Final = 2**31 - 1
LEVEL: Final = 2
"""Of the session, from which on the buffers are there."""
_SCRIPT: Final = """
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


def new_lines(
    session: Session, buffer: int, region: Region, shape: tuple[int, int], start: int, *, upwards: bool
) -> list[ScanLines]:
    """Return the complete lines beyond the first `start` that all channels have, in the order of the scan."""
    found = session.run(_SCRIPT % buffer)[0]
    channels = [_channel(one, shape[1]) for one in found.values()]
    done = min((len(values) for _, _, values in channels), default=0)
    if done <= start:
        return []
    first = start if upwards else shape[0] - done
    lines = []
    for name, unit, values in channels:
        rows = values[start:done] if upwards else values[start:done][::-1]
        lines.append(ScanLines(region, shape, name, unit, first, np.ascontiguousarray(rows)))
    return lines


def _channel(told: dict[int, Any], columns: int) -> tuple[str, str, np.ndarray]:
    """Name, unit and complete lines of a channel."""
    name, unit, span, raw = (told[number] for number in (1, 2, 3, 4))
    values = np.array(list(raw.values()), dtype=np.float64) / _LARGEST * float(span)
    rows = len(values) // columns
    return str(name), str(unit), values[: rows * columns].reshape(rows, columns)
