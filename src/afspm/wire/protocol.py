"""The protocol between processes: its version, signals and bounds.

Requests and their outcomes are numbered in `model` (`ControlRequest`, `ControlResponse`, `ResponseDetail`).
"""

from __future__ import annotations

from typing import Final

PROTOCOL_VERSION: Final = 2

KILL: Final = b"KILL"
"""The packet of one frame by which all subscribers learn that the experiment has ended."""
CLOSE: Final = bytes([100])
"""The request of one frame by which the scheduler tells its translator, which subscribes to nobody, the same."""
BEAT: Final = b"\x00"
CLOSING: Final = b"\x01"
LONGEST_ID: Final = 200
LONGEST_ENVELOPE: Final = 1000
"""Bytes."""
