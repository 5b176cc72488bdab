"""Measurements with a key, taken exactly once: the intent is on disk before the request, the result after it."""

from __future__ import annotations

import json
import logging
import re
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from afspm import wire
from afspm.basics.errors import FileError, InvalidValue, WireError
from afspm.basics.plain_data import Plain, from_json
from afspm.model import LoggedPacket, MeasurementConditions, Note, Packet, Parameter, Scan, ScanSet, Spectrum
from afspm.model.snapshot import from_plain, to_plain
from afspm.model.variables import VariableRoles
from afspm.storage.atomic import OutageLog, write_atomic
from afspm.storage.disk import is_full
from afspm.storage.memory import Memory
from afspm.storage.segment import head_of, read_packet
from afspm.wire.messages import CONDITIONS

_log = logging.getLogger("afspm.memory")
_HEAD = "result"
LONGEST_KEY = 100  # characters


@dataclass(frozen=True)
class MeasurementResult:
    """The scans or spectra of a measurement, its interruptions as text, and the conditions published with it."""

    things: list[Any]
    interruptions: list[str]
    conditions: MeasurementConditions | None = None

    @property
    def scans(self) -> ScanSet:
        return ScanSet(self.things, self.interruptions)

    @property
    def spectrum(self) -> Spectrum:
        spectrum: Spectrum = self.things[0]
        return spectrum


class KeyedResults:
    """The store of one component's measurements with a key.

    Args:
        folder: state folder of the run; None: nothing survives a restart.
        name: name of the component.
    """

    def __init__(self, folder: Path | None, name: str) -> None:
        self._folder = folder / f"{name}.results" if folder else None
        self._outage = OutageLog("keyed measurements can't be saved", _log)
        self._memory = Memory(folder / f"{name}.scope.json" if folder else None)

    def close(self) -> None:
        """End the thread that writes; a later measurement starts another."""
        self._memory.close()

    @property
    def disk_is_full(self) -> bool:
        """Return whether the disk of the run is full."""
        return self._folder is not None and is_full(self._folder.parent)

    @property
    def pending(self) -> Plain | None:
        """Return the intended measurement that has no result yet; None if there is none.

        It has the entries key, plan, attempt, since_ns and interruptions.
        """
        intent: Plain | None = self._memory.get("pending")
        path = None if intent is None else self._path(intent["key"])
        return None if path is not None and path.exists() else intent

    def next_attempt(self, before: int) -> int:
        """Return an attempt number above `before` and above all numbers so far; `intend` saves it.

        A key may come again, after `forget` or after a measurement that was given up. With an old number the request
        would have an old id, be answered from the cache, and start nothing.
        """
        self._memory["attempts"] = attempt = max(before, int(self._memory.get("attempts", 0))) + 1
        return attempt

    def intend(self, intent: Plain) -> None:
        """Save the intent of a measurement, before the measurement is requested."""
        self._memory["pending"] = intent
        self._memory.save(synced=False)  # a power cut may have it measured again, which costs a scan and no harm

    def intend_note(self, key: str, note: Note) -> Note | None:
        """Save the intent of a note; return the note to send, as first intended. None if it was written already.

        Raises:
            InvalidValue: the key was used for another text.
        """
        notes, print_ = self._memory.setdefault("notes", {}), zlib.crc32(note.text.encode())
        if key not in notes:
            notes[key] = [print_, note.time_ns, note.scan_ns, note.written_ns]
            self._memory.save(synced=False)
        kept_print, *times_ns = notes[key]
        if kept_print != print_:
            raise InvalidValue(
                f"the key {key!r} was used for another note in this run", hint="give each note its own key"
            )
        return Note(times_ns[0], note.who, note.text, *times_ns[1:]) if times_ns else None

    def finish_note(self, key: str, *, is_written: bool) -> None:
        """Save that a note was written; or forget it, if it was refused."""
        print_, *_ = self._memory["notes"].pop(key)
        if is_written:
            self._memory["notes"][key] = [print_]
        self._memory.save(synced=False)

    def before_sweep(self, key: str) -> list[Parameter] | None:
        """Return the parameter values from before an unfinished sweep; None if the sweep has set no parameter."""
        kept = self._memory.get("before_sweep", {}).get(key)
        return None if kept is None else [Parameter(**one) for one in kept]

    def keep_before_sweep(self, key: str, before: Sequence[Parameter] | None) -> None:
        """Save the parameter values from before a sweep; None: they are in force again."""
        kept = self._memory.setdefault("before_sweep", {})
        if before is None:
            kept.pop(key, None)
        else:
            kept[key] = [to_plain(one) for one in before]
        self._memory.save()

    @property
    def is_withdrawn(self) -> bool:
        """Whether the component has withdrawn the tip, and is to bring it back."""
        return bool(self._memory.get("withdrawn", False))

    @is_withdrawn.setter
    def is_withdrawn(self, withdrawn: bool) -> None:
        self._memory["withdrawn"] = withdrawn
        self._memory.save()

    def find(self, key: str, plan: Plain) -> MeasurementResult | None:
        """Return the saved result of a key, from an earlier call or before a restart; None without a readable result.

        Raises:
            InvalidValue: the key was used for another measurement.
            FileError: the file of the result can't be opened or read; a damaged result counts as none.
        """
        path = self._path(key)
        if path is None or not path.exists():
            return None
        try:
            head, things = _read(path)
        except (ValueError, KeyError, WireError) as error:  # a power cut came before it was on the disk
            _log.warning("%s is damaged and measured again: %s: %s", key, path, error)
            return None
        if head["key"] != key or head["plan"] != plan:
            raise InvalidValue(
                f"the key {key!r} was used for another measurement in this run: {head['plan']}",
                hint="give each measurement its own key",
            )
        kept = head.get("conditions")  # none in results of an earlier version
        conditions = None if kept is None else wire.decode(CONDITIONS.name, bytes.fromhex(kept))
        in_force = () if conditions is None else conditions.in_force
        things = [replace(_with_roles(one, head), in_force=in_force) for one in things]
        return MeasurementResult(things, head["interruptions"], conditions)

    def fulfil(self, key: str, plan: Plain, result: MeasurementResult) -> None:
        """Save the result of the intended measurement. If the disk is full, a restarted component measures again."""
        path, is_kept = self._path(key), False
        if path is not None:
            things = [wire.encode(thing) for thing in result.things]
            roles = {one.channel: one.roles for one in result.things if isinstance(one, Scan)}
            head = {
                "key": key,
                "plan": plan,
                "interruptions": result.interruptions,
                "things": len(things),
                "roles": roles,
            }
            curve = next((one for one in result.things if isinstance(one, Spectrum)), None)
            if curve is not None and curve.declared_roles is not None:
                head["variables"] = to_plain(curve.declared_roles)
            if result.conditions is not None:
                head["conditions"] = wire.encode(result.conditions)[1].hex()
            parts: list[bytes | memoryview] = []
            for name, payload in [(_HEAD, json.dumps(head).encode()), *things]:
                parts += [head_of(LoggedPacket(Packet(name, payload), None, 0)), payload]
            with self._outage.trying():
                write_atomic(path, parts, synced=False, soon=True)
                is_kept = True
        self._memory.pop("pending", None)
        if not is_kept:  # otherwise the file shows that the intent is fulfilled
            self._memory.save(synced=False)

    def forget(self, key: str) -> None:
        """Remove the saved result of a key; the next request with this key measures again."""
        path = self._path(key)
        if path is not None:
            # without its file the saved intent, even of an earlier life, would look unfulfilled and get the old scan
            if self.pending is None:
                self._memory.pop("pending", None)
            self._memory.save(synced=False)
            with suppress(OSError):  # a file that stays only takes space
                path.unlink(missing_ok=True)

    def _path(self, key: str) -> Path | None:
        if self._folder is None:
            return None
        # a readable name that is valid on every file system (no case, no reserved characters), and unique for each key
        plain = re.sub(r"[^a-z0-9.-]+", "_", key.lower()).strip(".")[:60]
        return self._folder / f"{plain}-{zlib.crc32(key.encode()):08x}"


def kept_in(state_dir: Path, name: str) -> list[str]:
    """Return the names of the files with a component's saved measurements."""
    return sorted(path.name for path in (state_dir / f"{name}.results").glob("*"))


def check_key(key: str) -> str:
    """Return `key` if it is valid as a part of request ids.

    Raises:
        InvalidValue: the key is not valid.
    """
    if not isinstance(key, str) or not key or len(key.encode()) > LONGEST_KEY or "/" in key or not key.isprintable():
        raise InvalidValue(f"{key!r} can't be a key", hint=f"1 to {LONGEST_KEY} printable characters without '/'")
    return key


def _with_roles(thing: Any, head: Plain) -> Any:
    if isinstance(thing, Spectrum) and (kept := head.get("variables")) is not None:
        return replace(thing, declared_roles=from_plain(VariableRoles, kept))
    roles = head.get("roles", {})
    return replace(thing, roles=tuple(roles.get(thing.channel, ()))) if isinstance(thing, Scan) else thing


def _read(path: Path) -> tuple[Plain, list[object]]:
    try:
        with path.open("rb") as file:
            packets = [entry.packet for entry in iter(lambda: read_packet(file), None)]
        if not packets or packets[0].envelope != _HEAD:
            raise ValueError("the file is not a result")
        head = from_json(bytes(packets[0].payload))
        if len(packets) != 1 + head["things"]:
            raise ValueError("the file is incomplete")
        return head, [wire.decode(packet.envelope, packet.payload) for packet in packets[1:]]
    except OSError as error:
        raise FileError(f"can't be read: {error}", where=str(path), hint="remove it to measure again") from error
