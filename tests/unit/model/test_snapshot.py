"""Snapshots of dataclasses: saved values come back unchanged, and other data are refused."""

from __future__ import annotations

import json
import sys
from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from afspm.basics.errors import InvalidValue
from afspm.model.snapshot import restored, snapshot, to_plain


class Colour(Enum):
    RED = "red"


@dataclass(frozen=True)
class Leaf:
    name: str
    pair: tuple[float, int]
    colour: Colour = Colour.RED


@dataclass(frozen=True, eq=False)
class Tree:
    values: NDArray[np.float64]
    leaf: Leaf | None = None
    leaves: tuple[Leaf, ...] = ()
    queue: deque[int] = field(default_factory=deque)
    by_number: dict[int, Leaf] = field(default_factory=dict)
    names: frozenset[str] = frozenset()
    message: bytes = b""


LEAF = Leaf("a", (1.5, 2))
TREE = Tree(
    np.array([[0.1, np.pi], [1e-300, -0.0]]),
    LEAF,
    (LEAF, LEAF),
    deque([1, 2]),
    {3: LEAF},
    frozenset({"x"}),
    bytes(range(256)),
)


def test_half_imported_numpy_has_no_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another thread may be importing it at that moment."""
    monkeypatch.setitem(sys.modules, "numpy", ModuleType("numpy"))
    assert to_plain((1, "a", None)) == [1, "a", None]


@pytest.mark.parametrize("lists", [False, True])
def test_a_tree_comes_back_to_the_last_bit(lists: bool) -> None:
    plain = snapshot(TREE, "tree", 1, lists=lists)
    again = restored(Tree, json.loads(json.dumps(plain)) if lists else plain, "tree", 1)
    assert again.values.tobytes() == TREE.values.tobytes()
    for name in ("leaf", "leaves", "queue", "by_number", "names", "message"):
        assert getattr(again, name) == getattr(TREE, name)


@pytest.mark.parametrize("changed", [{"kind": "shrub"}, {"version": 2}, {"kind": None}])
def test_another_kind_or_version_is_refused(changed: dict[str, object]) -> None:
    with pytest.raises(InvalidValue, match="instead of 'tree', version 1"):
        restored(Tree, {**snapshot(TREE, "tree", 1), **changed}, "tree", 1)


@pytest.mark.parametrize(
    "changed",
    [
        {"values": None},
        {"leaf": 1},
        {"leaves": [{"name": 3, "pair": [1.0, 2]}]},
        {"leaf": {}},
        {"unheard_of": 1},
        {"message": "no base64"},
    ],
)
def test_a_damaged_snapshot_is_refused(changed: dict[str, object]) -> None:
    with pytest.raises(InvalidValue, match="damaged"):
        restored(Tree, {**snapshot(TREE, "tree", 1), **changed}, "tree", 1)


def test_a_missing_field_is_refused() -> None:
    plain = snapshot(TREE, "tree", 1)
    del plain["values"]
    with pytest.raises(InvalidValue, match="damaged"):
        restored(Tree, plain, "tree", 1)
