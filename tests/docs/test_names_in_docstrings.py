"""Back-quoted names in docstrings exist."""

from __future__ import annotations

import ast
import builtins
import keyword
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import afspm
from afspm.basics import entry_points

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "afspm"
PACKAGES = tuple(ROOT / "packages" / f"afspm-{name}" / "src" for name in ("agents", "bench", "lab", "published"))
WORD = re.compile(r"[A-Za-z_]\w*")
QUOTED = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)(?:\([^`]*\))?`(?!`)")
PARTS = {
    file: file.relative_to(root).with_suffix("").parts
    for root in (SOURCE, *PACKAGES)
    for file in sorted(root.rglob("*.py"))
    if "generated" not in file.parts
}
MODULES = {".".join(parts).removesuffix(".__init__") for parts in PARTS.values()}
EXTERNAL = frozenset(sys.stdlib_module_names) | {"numpy", "np", "zmq", "h5py", "matplotlib", "plt", "xarray", "sidpy"}
FOREIGN = frozenset(
    {"PeakList", "afspm.ipf", "ncdump", "on_peak_list", "spm.ncm.sweepAutoFullRange", "tip_bias_voltage", "x_sample"}
)
"""Examples, symbols, programs, and what our objects are called elsewhere."""
PUBLIC = frozenset(afspm.__all__) | {group.removeprefix("afspm.") for group in entry_points.GROUPS}


@dataclass
class Names:
    """The names in the package's modules.

    Attributes:
        identifiers: the identifiers, with the names of the modules.
        words: these, with every word of plain strings (keys of tables, names of messages) and of other files.
        quoted: the back-quoted names of docstrings, each with its place.
    """

    identifiers: set[str]
    words: set[str]
    quoted: list[tuple[str, str]]

    @classmethod
    def of_package(cls) -> Names:
        found = cls({*dir(builtins), *keyword.kwlist, *EXTERNAL}, set(FOREIGN), [])
        for file in PARTS:
            found._add(file)
        for other in (*(ROOT / "proto").rglob("*.proto"), *SOURCE.rglob("*.toml"), ROOT / "pyproject.toml"):
            found.words.update(WORD.findall(other.read_text(encoding="utf-8")))
        found.words |= found.identifiers
        return found

    def _add(self, file: Path) -> None:
        # one walk for all, and a node's docstring comes before the strings in it: parsing takes long enough
        docstrings = set()
        self.identifiers.update(PARTS[file])
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            match node:
                case ast.Name(id=name):
                    self.identifiers.add(name)
                case ast.Attribute(attr=name) | ast.arg(arg=name) | ast.alias(name=name):
                    self.identifiers.update(name.split("."))
                case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                    self.identifiers.add(name)
                case ast.keyword(arg=str(name)):
                    self.identifiers.add(name)
                case ast.Expr(value=ast.Constant(value=str(text)) as docstring):
                    docstrings.add(docstring)
                    place = f"{file.relative_to(ROOT)}:{docstring.lineno}"
                    self.quoted += [(place, name.rstrip(".")) for name in QUOTED.findall(text)]
                case ast.Constant(value=str(text)) if node not in docstrings:
                    self.words.update(WORD.findall(text))


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
    names = Names.of_package()
    missing = [
        f"{place}: `{name}`" for place, name in names.quoted if not _is_there(name, names.identifiers, names.words)
    ]
    assert names.quoted
    assert not missing, "\n".join(missing)
