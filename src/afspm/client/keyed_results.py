"""Keyed measurements happen exactly once: the intent is on disk before the request, the result after it."""

from __future__ import annotations

import json
import logging
import re
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from afspm import wire
from afspm.errors import FileError, InvalidValue, WireError
from afspm.process.memory import Memory
from afspm.storage.atomic import OutageLog, write_atomic

_log = logging.getLogger("afspm.memory")
_MAGIC = b"afspm-result-1\n"
_LENGTH = struct.Struct("<Q")
LONGEST_KEY = 100


@dataclass(frozen=True)
class MeasurementResult:
    """The scans or spectra of a measurement, and what interrupted it, for a person."""

    things: list[Any]
    interruptions: list[str]


class KeyedResults:
    """The measurements of one component that have a key.

    Args:
        folder: the state folder of the run; None keeps nothing over a restart.
        name: of the component.
    """

    def __init__(self, folder: Path | None, name: str) -> None:
        self._folder = folder / f"{name}.results" if folder else None
        self._outage = OutageLog("what is measured can't be kept", _log)
        self._memory = Memory(folder / f"{name}.scope.json" if folder else None)

    @property
    def pending(self) -> dict[str, Any] | None:
        """The intent that was written down and not fulfilled: key, plan, attempt, since_ns, interruptions."""
        return self._memory.get("pending")

    def intend(self, intent: dict[str, Any]) -> None:
        """Write down what is going to be asked for, before it is."""
        self._memory["pending"] = intent
        self._memory.save()

    def find(self, key: str, plan: dict[str, Any]) -> MeasurementResult | None:
        """Return the result of an earlier life, or of an earlier call, with the same key.

        Raises:
            InvalidValue: the key was used for something else.
            FileError: it can't be read.
        """
        path = self._path(key)
        if path is None or not path.exists():
            return None
        head, things = _read(path)
        if head["key"] != key or head["plan"] != plan:
            raise InvalidValue(
                f"the key {key!r} was used for another measurement in this run: {head['plan']}",
                hint="give each measurement its own key",
            )
        return MeasurementResult(things, head["interruptions"])

    def fulfil(self, key: str, plan: dict[str, Any], result: MeasurementResult) -> None:
        """Keep the result; the intent is fulfilled. Where the disk is full, another life measures it again."""
        path = self._path(key)
        if path is not None:
            head = {"key": key, "plan": plan, "interruptions": result.interruptions}
            parts: list[bytes] = [json.dumps(head).encode()]
            for thing in result.things:
                message, payload = wire.encode(thing)
                parts += [message.encode(), payload]
            with self._outage.trying():
                write_atomic(path, [_MAGIC, *(piece for part in parts for piece in (_LENGTH.pack(len(part)), part))])
        self._memory.pop("pending", None)
        self._memory.save()

    def forget(self, key: str) -> None:
        """Remove what is kept of a key; a component that asks for it again measures again."""
        path = self._path(key)
        if path is not None:
            with suppress(OSError):  # what stays is only space
                path.unlink(missing_ok=True)

    def _path(self, key: str) -> Path | None:
        if self._folder is None:
            return None
        # readable, safe on every file system (no case, no reserved characters), and different for different keys
        plain = re.sub(r"[^a-z0-9.-]+", "_", key.lower()).strip(".")[:60]
        return self._folder / f"{plain}-{zlib.crc32(key.encode()):08x}"


def check_key(key: str) -> str:
    """Return a key as it may be used in request ids. Raises InvalidValue: it may not."""
    if not key or len(key.encode()) > LONGEST_KEY or "/" in key or not key.isprintable():
        raise InvalidValue(f"{key!r} can't be a key", hint=f"1 to {LONGEST_KEY} printable characters without '/'")
    return key


def _read(path: Path) -> tuple[dict[str, Any], list[Any]]:
    try:
        data = memoryview(path.read_bytes())
        if bytes(data[: len(_MAGIC)]) != _MAGIC:
            raise ValueError("not a result")
        parts, at = [], len(_MAGIC)
        while at < len(data):
            begin = at + _LENGTH.size
            at = begin + _LENGTH.unpack_from(data, at)[0]
            parts.append(data[begin:at])
        names, payloads = parts[1::2], parts[2::2]
        things = [wire.decode(str(name, "utf-8"), part) for name, part in zip(names, payloads, strict=True)]
        return json.loads(bytes(parts[0])), things
    except (OSError, ValueError, struct.error, WireError, IndexError) as error:
        raise FileError(f"can't be read: {error}", where=str(path), hint="remove it to measure anew") from error
