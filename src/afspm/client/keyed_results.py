"""What a keyed scan or spectrum needs to be there exactly once: the intent before, the result after, both on disk."""

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
    """What came of a measurement.

    Attributes:
        things: the scans or spectra.
        interruptions: what got in between, for a person.
    """

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
        self._told = OutageLog("what is measured can't be kept", _log)
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
        """The result of an earlier life, or of an earlier call, with the same key.

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
            parts = [_MAGIC, *_framed(json.dumps(head).encode())]
            for thing in result.things:
                message, payload = wire.encode(thing)
                parts += [*_framed(message.encode()), *_framed(payload)]
            with self._told.trying():
                write_atomic(path, parts)
        self._memory.pop("pending", None)
        self._memory.save()

    def forget(self, key: str) -> None:
        """Remove what is kept of a key that nobody will ask for again; whoever does, measures again."""
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
    """A key as it may be used in request ids.

    Raises:
        InvalidValue: it may not.
    """
    if not key or len(key.encode()) > LONGEST_KEY or "/" in key or not key.isprintable():
        raise InvalidValue(f"{key!r} can't be a key", hint=f"1 to {LONGEST_KEY} printable characters without '/'")
    return key


def _framed(part: bytes) -> tuple[bytes, bytes]:
    return _LENGTH.pack(len(part)), part


def _read(path: Path) -> tuple[dict[str, Any], list[Any]]:
    try:
        data = memoryview(path.read_bytes())
        if bytes(data[: len(_MAGIC)]) != _MAGIC:
            raise ValueError("not a result")
        parts = []
        at = len(_MAGIC)
        while at < len(data):
            (length,) = _LENGTH.unpack_from(data, at)
            at += _LENGTH.size
            parts.append(data[at : at + length])
            at += length
        head = json.loads(bytes(parts[0]))
        return head, [wire.decode(str(n, "utf-8"), p) for n, p in zip(parts[1::2], parts[2::2], strict=True)]
    except (OSError, ValueError, struct.error, WireError, IndexError) as error:
        raise FileError(f"can't be read: {error}", where=str(path), hint="remove it to measure anew") from error
