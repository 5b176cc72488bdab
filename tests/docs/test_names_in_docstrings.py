"""Names in back-quotes in docstrings and comments are names of something that is there."""

from __future__ import annotations

import ast
import builtins
import keyword
import re
import sys
import tomllib
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
FOREIGN = frozenset({"PeakList", "afspm.ipf", "ncdump", "on_peak_list", "tip_bias_voltage", "x_sample"})
"""Examples, symbols, programs, and what our objects are called elsewhere."""
PUBLIC = frozenset(afspm.__all__) | {group.removeprefix("afspm.") for group in entry_points.GROUPS}


def _words(tree: ast.Module) -> Iterator[str]:
    """Yield every identifier of a module, and every word of its plain strings (keys of tables, names of messages)."""
    docstrings = {id(node) for node in _docstring_nodes(tree)}
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.alias(name=name):
                yield from name.split(".")
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.keyword(arg=str(name)):
                yield name
            case ast.Constant(value=str(text)) if id(node) not in docstrings:
                yield from re.findall(r"[A-Za-z_]\w*", text)


def _docstring_nodes(tree: ast.Module) -> Iterator[ast.Constant]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value


def _known() -> set[str]:
    known = {*dir(builtins), *keyword.kwlist, *EXTERNAL, *FOREIGN}
    for file in FILES:
        known.update(_words(ast.parse(file.read_text(encoding="utf-8"))))
        known.update(file.relative_to(SOURCE).with_suffix("").parts)
    for proto in (ROOT / "proto").rglob("*.proto"):
        known.update(re.findall(r"[A-Za-z_]\w*", proto.read_text(encoding="utf-8")))
    known.update(re.findall(r"[A-Za-z_]\w*", str(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8")))))
    for parameters in SOURCE.rglob("*.toml"):
        known.update(re.findall(r"[A-Za-z_]\w*", parameters.read_text(encoding="utf-8")))
    return known


def _is_there(name: str, known: set[str]) -> bool:
    first, _, rest = name.partition(".")
    if name in FOREIGN:
        return True
    if first == "afspm":
        return rest.partition(".")[0] in PUBLIC or _resolves(rest)
    if rest and (SOURCE / first).is_dir():  # a room
        return _resolves(name)
    return all(part in known for part in name.split(".") if part)


def _resolves(path: str) -> bool:
    """Whether a dotted path is a module, or a module and names in it."""
    parts = path.split(".")
    return not path or any(
        ".".join(parts[:count]) in MODULES for count in range(len(parts), max(0, len(parts) - 3), -1)
    )


def test_quoted_names_in_docstrings_exist() -> None:
    known = _known()
    missing = []
    for file in FILES:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in _docstring_nodes(tree):
            missing += [
                f"{file.relative_to(ROOT)}:{node.lineno}: `{name}`"
                for name in QUOTED.findall(str(node.value))
                if not _is_there(name.rstrip("."), known)
            ]
    assert not missing, "\n".join(missing)
