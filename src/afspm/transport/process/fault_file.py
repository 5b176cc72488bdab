"""The file that reports a fault of a component's own code to its supervisor."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from afspm.basics.errors import FileError
from afspm.basics.own_fault import OwnFault
from afspm.storage.atomic import write_atomic


def write_fault(state_dir: Path, name: str, fault: OwnFault) -> None:
    with suppress(FileError):  # on a full disk the fault counts as an ordinary crash
        write_atomic(_path(state_dir, name), [json.dumps(asdict(fault)).encode()])


def take_fault(state_dir: Path, name: str) -> OwnFault | None:
    """Return the reported fault, and remove its file; None without a readable file."""
    try:
        fault = OwnFault(**json.loads(_path(state_dir, name).read_bytes()))
        _path(state_dir, name).unlink()
    except (OSError, ValueError, TypeError):
        return None
    return fault


def _path(state_dir: Path, name: str) -> Path:
    return state_dir / f"{name}.fault.json"
