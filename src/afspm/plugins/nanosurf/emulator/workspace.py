"""Studio's workspace: frames, grids and points with their positions, and the queue that measures them."""

from __future__ import annotations

import random
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path, PureWindowsPath
from typing import Final
from xml.etree import ElementTree

from afspm.basics import AfspmError, InvalidValue
from afspm.emulation import InstrumentBusy
from afspm.plugins.nanosurf.emulator.studio import FRAMES, StudioProgram

NO_ITEM: Final = str(uuid.UUID(int=0))
_MOST_ITEMS: Final = 1000
_LONGEST_NAME: Final = 200
_MOST_REPETITIONS: Final = 1000
_FIRST: Final = "Image Pos 1"
_UNFIT_FOR_NAMES: Final = frozenset('\\/:*?"<>|') | {chr(number) for number in range(32)}


@dataclass
class WorkspaceItem:
    """A place to measure: a "frame", a "grid" of curves or a "point" for a single curve.

    Attributes:
        columns, rows: pixels of a frame, curves of a grid.
    """

    kind: str
    name: str
    x_m: float
    y_m: float
    width_m: float = 0.0
    height_m: float = 0.0
    columns: int = 1
    rows: int = 1
    rotation_deg: float = 0.0

    def __post_init__(self) -> None:
        if len(self.name) > _LONGEST_NAME:
            raise InvalidValue(f"a name of {len(self.name)} characters", hint=f"at most {_LONGEST_NAME}")


class Workspace:
    """The items by id. Files are in the gallery; folders in paths on Studio's computer are ignored."""

    def __init__(self, program: StudioProgram) -> None:
        self._program = program
        self._chance = random.Random(program.rig.seed)
        self._items: dict[str, WorkspaceItem] = {}
        self.add("frame", _FIRST, 0.0, 0.0)

    def __getitem__(self, item_id: str) -> WorkspaceItem:
        """Return an item. Raises InvalidValue: the id is unknown."""
        if item_id not in self._items:
            raise InvalidValue(f"there is no item {item_id!r} in the workspace")
        return self._items[item_id]

    def add(self, kind: str, name: str, x_m: float, y_m: float) -> str:
        """Add an item, with the size of the panel's frame or grid; return the item's id.

        Raises:
            InvalidValue: the workspace has 1000 items, or the name is too long.
        """
        if len(self._items) >= _MOST_ITEMS:
            raise InvalidValue(f"a workspace has at most {_MOST_ITEMS} items")
        sizes = [self._program.values[path] for path in FRAMES.get(kind, ())[2:]]
        made = WorkspaceItem(kind, str(name), float(x_m), float(y_m), *sizes)
        item_id = str(uuid.UUID(int=self._chance.getrandbits(128), version=4))
        self._items[item_id] = made
        return item_id

    def id_of(self, name: str) -> str:
        """Return the id of an item by name; all zeros: unknown."""
        return next((item_id for item_id, item in self._items.items() if item.name == name), NO_ITEM)

    def change(self, item_id: str, **values: object) -> None:
        """Change an item.

        Raises:
            InvalidValue: the id is unknown, the name is too long, or a size or number is not above 0.
        """
        before = self[item_id]
        changed = WorkspaceItem(**{**asdict(before), **values})
        sizes = changed.width_m, changed.height_m, changed.columns, changed.rows
        if changed.kind != "point" and not min(sizes) > 0:
            raise InvalidValue(f"{changed.name}: sizes and numbers are above zero, not {sizes}")
        self._items[item_id] = changed

    def delete(self, item_id: str) -> None:
        """Delete an item. Raises InvalidValue: the id is unknown."""
        self[item_id]
        del self._items[item_id]

    def clear(self) -> None:
        self._items.clear()

    def ids(self) -> list[str]:
        """Return the ids in the order of creation."""
        return list(self._items)

    def save(self, path: str) -> None:
        """Write the items to a file. Raises InvalidValue: the path is unfit, or writing fails."""
        root = ElementTree.Element("workspace")
        for item_id, item in self._items.items():
            ElementTree.SubElement(root, "item", {"id": item_id, **{key: str(of) for key, of in asdict(item).items()}})
        try:
            self._file(path).write_bytes(ElementTree.tostring(root))
        except OSError as error:
            raise InvalidValue(f"{path!r} can't be written: {error}") from error

    def load(self, path: str) -> None:
        """Replace the items by the items of a saved file.

        Raises:
            InvalidValue: the file is missing or damaged, or the path is unfit.
        """
        kinds = {
            field.name: {"str": str, "int": int, "float": float}[str(field.type)] for field in fields(WorkspaceItem)
        }
        try:
            read = list(ElementTree.fromstring(self._file(path).read_bytes()))
            items = {
                one.attrib["id"]: WorkspaceItem(**{name: kind(one.attrib[name]) for name, kind in kinds.items()})
                for one in read[:_MOST_ITEMS]
            }
        except (OSError, KeyError, ValueError, ElementTree.ParseError) as error:
            raise InvalidValue(f"{path!r} can't be loaded: {error}") from error
        self._items = items

    def _file(self, path: str) -> Path:
        name = PureWindowsPath(path).name
        if not name.endswith(".xml") or not _UNFIT_FOR_NAMES.isdisjoint(name) or len(name) > _LONGEST_NAME:
            raise InvalidValue(f"{path!r} is no path of an .xml file")
        return self._program.folder / name


class MeasurementQueue:
    """The queue of Studio's automation, which measures items one after the other.

    Attributes:
        entries: ids, each with its number of repetitions.
        message: reason for an early end; empty: none.
    """

    def __init__(self, program: StudioProgram, workspace: Workspace) -> None:
        self._program, self._workspace = program, workspace
        self.entries: list[tuple[str, int]] = []
        self.message = ""
        self._left: Iterator[str] | None = None
        program.when_advanced = self.advance

    @property
    def running(self) -> bool:
        """True from `process` until all items are measured, or until `abort` or an error."""
        return self._left is not None

    def add(self, item_ids: list[str], repetitions: int = 1) -> None:
        """Add items. Raises InvalidValue: unknown items, too many items or too many repetitions."""
        for item_id in item_ids:
            self._workspace[item_id]
        if not 1 <= repetitions <= _MOST_REPETITIONS or len(self.entries) + len(item_ids) > _MOST_ITEMS:
            raise InvalidValue(f"{len(item_ids)} items {repetitions} times are not added to the queue")
        self.entries += [(item_id, int(repetitions)) for item_id in item_ids]

    def remove(self, item_id: str) -> None:
        """Remove an item. Raises InvalidValue: the item is not in the queue."""
        kept = [entry for entry in self.entries if entry[0] != item_id]
        if len(kept) == len(self.entries):
            raise InvalidValue(f"{item_id!r} is not in the queue")
        self.entries = kept

    def process(self, entries: list[tuple[str, int]]) -> None:
        """Start measuring items, each as often as its entry demands.

        Raises:
            InstrumentBusy: the queue or the instrument is busy. InvalidValue: an item is unknown.
        """
        for item_id, _ in entries:
            self._workspace[item_id]
        if self.running or self._program.occupied(self._program.now_s):
            raise InstrumentBusy("a measurement is running")
        self.message = ""
        self._left = (item_id for item_id, times in entries for _ in range(times))
        self.advance(self._program.now_s)

    def abort(self) -> None:
        """Stop the queue after the present item."""
        self._left = None

    def advance(self, now_s: float) -> bool:
        """Start the next item if the instrument is free; return True if a measurement was started."""
        program, begun = self._program, False
        while self._left is not None and not program.occupied(now_s):
            item_id = next(self._left, None)
            if item_id is None:
                self._left = None
                break
            try:
                item = self._workspace[item_id]
                program.measure_at(item.kind, item.name, self._values_of(item), now_s)
                begun = True
            except AfspmError as error:
                self.message, self._left = str(error), None
        return begun

    @staticmethod
    def _values_of(item: WorkspaceItem) -> tuple[float, ...]:
        return item.x_m, item.y_m, item.width_m, item.height_m, item.columns, item.rows, item.rotation_deg
