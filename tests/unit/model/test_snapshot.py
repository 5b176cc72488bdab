"""Snapshots come back as they were, and nothing else is taken for one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from afspm.model.snapshot import SnapshotError, from_plain, load, take, to_plain


class Colour(Enum):
    RED = "red"


class Number(IntEnum):
    TWO = 2


@dataclass(frozen=True)
class Leaf:
    size_m: tuple[float, float]
    name: str | None = None


@dataclass(frozen=True)
class Tree:
    leaves: tuple[Leaf, ...] = ()
    by_number: Mapping[int, Leaf] = field(default_factory=dict)
    colour: Colour = Colour.RED
    number: Number = Number.TWO
    data: bytes = b"\x00\xff"
    best: Leaf | None = None
    is_big: bool = False


TREE = Tree((Leaf((1e-9, 2.0)), Leaf((0.0, 1.0), "b")), {3: Leaf((1.0, 1.0))}, best=Leaf((5.0, 5.0)))


def again(tree: Tree) -> Tree:
    return load(Tree, json.loads(json.dumps(take(tree, 1))), 1)


def test_a_tree_comes_back_from_json() -> None:
    assert again(TREE) == TREE
    assert again(Tree()) == Tree()


def test_arrays_come_back_with_type_and_shape() -> None:
    @dataclass
    class Holder:
        values: Any

    values = np.arange(6, dtype="<f4").reshape(2, 3)
    plain = json.loads(json.dumps(to_plain(Holder(values))))["values"]
    back = from_plain(NDArray[np.float32], plain)  # type: ignore[type-abstract]
    assert back.dtype == values.dtype
    assert np.array_equal(back, values)


def test_another_version_is_refused() -> None:
    with pytest.raises(SnapshotError, match="version 1"):
        load(Tree, take(TREE, 1), 2)
    with pytest.raises(SnapshotError):
        load(Tree, {"mode": 2}, 1)


@pytest.mark.parametrize(
    "change",
    [
        {"colour": "GREEN"},
        {"number": 2},
        {"leaves": [{"size_m": [1.0]}]},
        {"leaves": [{"size_m": [1.0, 2.0], "name": 3}]},
        {"is_big": 1},
        {"data": "%%"},
        {"unknown": 1},
        {"best": []},
    ],
)
def test_what_it_does_not_know_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(SnapshotError):
        from_plain(Tree, {**to_plain(TREE), **change})


def test_a_missing_field_is_refused() -> None:
    plain = to_plain(TREE)
    del plain["colour"]
    with pytest.raises(SnapshotError, match="colour"):
        from_plain(Tree, plain)


def test_what_has_no_plain_form_is_refused() -> None:
    with pytest.raises(SnapshotError):
        to_plain(object())
