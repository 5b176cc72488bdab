"""Aliases of `type` statements: the type behind the name, on each version of Python."""

from __future__ import annotations

import sys
import typing
from collections.abc import Callable
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pytest
import typing_extensions
from numpy.typing import NDArray

from afspm.basics.type_aliases import unaliased
from afspm.experiment import component_settings
from afspm.experiment.document import read
from afspm.model.snapshot import from_plain, to_plain
from afspm.simulation.settings import build

# as Any: a type checker knows no aliases that are made by a call
A, B = map(TypeVar, ("A", "B"))
Tuple: Any = tuple
List: Any = list
Dict: Any = dict
Array: Any = NDArray
MAKERS: list[Any] = [typing_extensions.TypeAliasType]
if sys.version_info >= (3, 12):
    MAKERS.append(typing.TypeAliasType)

pytestmark = pytest.mark.parametrize("alias", MAKERS, ids=lambda one: str(one.__module__))
Maker = Callable[..., Any]


@dataclass(frozen=True)
class Leaf:
    name: str


def test_alias_stands_for_its_type(alias: Maker) -> None:
    assert unaliased(alias("Name", str)) is str
    assert unaliased(alias("Twice", alias("Once", list[int]))) == list[int]
    assert unaliased(alias("Maybe", Leaf | None)) == Leaf | None


def test_arguments_of_an_alias_are_put_in(alias: Maker) -> None:
    assert unaliased(alias("Swapped", Tuple[B, A], type_params=(A, B))[int, str]) == Tuple[str, int]
    assert unaliased(alias("Same", A, type_params=(A,))[int]) is int
    assert unaliased(alias("Both", Tuple[A, A], type_params=(A,))[int]) == Tuple[int, int]
    assert unaliased(alias("Fixed", List[str], type_params=(A,))[int]) == List[str]
    images = alias("Images", alias("Row", List[A], type_params=(A,))[B], type_params=(B,))
    assert unaliased(images[float]) == List[float]


def test_other_types_are_unchanged(alias: Maker) -> None:
    for other in (int, list[int], Leaf | None, Annotated[int, []], Any, None):
        assert unaliased(other) is other


def test_snapshot_reads_aliases_at_every_depth(alias: Maker) -> None:
    image = alias("Image", Array[A], type_params=(A,))
    leaves = alias("Leaves", Dict[str, alias("Listed", Tuple[A, ...], type_params=(A,))[Leaf]])
    state = (np.eye(2, dtype=np.float32), {"a": (Leaf("x"), Leaf("y"))}, None)
    kind = Tuple[image[np.float32], leaves, alias("Maybe", alias("Name", str) | None)]
    again = from_plain(kind, to_plain(state, lists=True))
    assert again[0].dtype == np.float32
    np.testing.assert_array_equal(again[0], state[0])
    assert again[1:] == state[1:]


def test_settings_of_the_simulation_may_be_aliases(alias: Maker) -> None:
    sizes = alias("Sizes", Tuple[alias("Size", float), ...])
    kind = make_dataclass("Settings", [("sizes_m", sizes, ())], frozen=True)
    assert build(kind, {"sizes_m": [1, 2]}, "sample") == kind((1.0, 2.0))


def test_settings_of_a_component_may_be_aliases(alias: Maker, tmp_path: Path) -> None:
    class Component:
        def __init__(self, on: bool = False) -> None: ...

    Component.__init__.__annotations__["on"] = alias("Switch", bool)
    file = tmp_path / "experiment.toml"
    file.write_text("[own]\non = 1\n", encoding="utf-8")
    document = read([file])
    component_settings.resolve(Component, {"on": 1}, ("own",), document)
    assert document.findings.errors, "1 is not accepted as true"
