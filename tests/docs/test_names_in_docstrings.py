"""Back-quoted names in docstrings exist."""

from __future__ import annotations

import ast
import builtins
import keyword
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import afspm
from afspm.basics import entry_points

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "afspm"
QUOTED = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)(?:\([^`]*\))?`(?!`)")
FILES = [file for file in sorted(SOURCE.rglob("*.py")) if "generated" not in file.parts]
MODULES = {".".join(file.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__") for file in FILES}
EXTERNAL = frozenset(sys.stdlib_module_names) | {"numpy", "np", "zmq", "h5py", "matplotlib", "plt", "xarray", "sidpy"}
FOREIGN = frozenset(
    {"PeakList", "afspm.ipf", "ncdump", "on_peak_list", "spm.ncm.sweepAutoFullRange", "tip_bias_voltage", "x_sample"}
)
"""Examples, symbols, programs, and what our objects are called elsewhere."""
PUBLIC = frozenset(afspm.__all__) | {group.removeprefix("afspm.") for group in entry_points.GROUPS}


def _identifiers(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.alias(name=name):
                yield from name.split(".")
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.keyword(arg=str(name)):
                yield name


def _words(tree: ast.Module) -> Iterator[str]:
    """Yield every word of the plain strings of a module (keys of tables, names of messages)."""
    docstrings = {id(node) for node in _docstring_nodes(tree)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield from re.findall(r"[A-Za-z_]\w*", node.value)


def _docstring_nodes(tree: ast.Module) -> Iterator[ast.Constant]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value


def _known() -> tuple[set[str], set[str]]:
    """Return the identifiers of the package with the names of its modules, and these with all other words."""
    identifiers, words = {*dir(builtins), *keyword.kwlist, *EXTERNAL}, set(FOREIGN)
    for file in FILES:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        identifiers.update(_identifiers(tree), file.relative_to(SOURCE).with_suffix("").parts)
        words.update(_words(tree))
    others = [*(ROOT / "proto").rglob("*.proto"), *SOURCE.rglob("*.toml"), ROOT / "pyproject.toml"]
    for other in others:
        words.update(re.findall(r"[A-Za-z_]\w*", other.read_text(encoding="utf-8")))
    return identifiers, identifiers | words


def _is_there(name: str, identifiers: set[str], words: set[str]) -> bool:
    first, _, rest = name.partition(".")
    if name in FOREIGN or name.endswith((".csv", ".toml")):
        return True
    if first == "afspm":
        return rest.partition(".")[0] in PUBLIC or _resolves(rest)
    if rest and (SOURCE / first).is_dir():  # a room
        return _resolves(name)
    if "." in rest and name.rpartition(".")[2][:1].isupper():  # a class, by its module
        module = name.rpartition(".")[0]
        return any(f".{one}".endswith(f".{module}") for one in MODULES) and name.rpartition(".")[2] in words
    return (first in identifiers if rest else True) and all(part in words for part in name.split(".") if part)


def _resolves(path: str) -> bool:
    """Whether a dotted path is a module, or a module and names in it."""
    parts = path.split(".")
    return not path or any(
        ".".join(parts[:count]) in MODULES for count in range(len(parts), max(0, len(parts) - 3), -1)
    )


def test_quoted_names_in_docstrings_exist() -> None:
    identifiers, words = _known()
    missing = []
    for file in FILES:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in _docstring_nodes(tree):
            missing += [
                f"{file.relative_to(ROOT)}:{node.lineno}: `{name}`"
                for name in QUOTED.findall(str(node.value))
                if not _is_there(name.rstrip("."), identifiers, words)
            ]
    assert not missing, "\n".join(missing)
