"""Returns 1 if the page, or what it shows, has changed since its tests were last green; for `.ci/run`.

`--green`, by which `make test-ui` ends, writes the present state into tests/ui/last_green.txt, to be committed: a clean
checkout knows of no earlier run. The state is a hash of the page, of its tests, of the modules of the record that the
page imports, of the tests' helpers, and of NiceGUI's version. Other modules that the page imports have tests of their
own, and would change the hash with almost every commit.
"""

from __future__ import annotations

import ast
import hashlib
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
LAST_GREEN: Final = Path("tests/ui/last_green.txt")
OWN: Final = ("src/afspm/plugins/web", "tests/ui")
SHOWN: Final = (
    *(f"src/afspm/{room}/" for room in ("record", "night", "drawing", "report")),
    *("tests/", "benchmarks/"),
)
"""Of the modules that files of `OWN` import, those in these folders count."""
IMPORTED_FROM: Final = ("src", "tests/support", "")
FRAMEWORK: Final = "nicegui"


def state(root: Path = ROOT) -> str:
    """Return the hash: of names and texts, so that it does not depend on the system or its line ends."""
    found = hashlib.sha256(_version_of_framework(root).encode())
    for file in sources(root):
        found.update(b"\0" + file.encode() + b"\0" + (root / file).read_bytes().replace(b"\r\n", b"\n"))
    return found.hexdigest()


def sources(root: Path = ROOT) -> list[str]:
    """Return the files, relative to the root."""
    own = [file for folder in OWN for file in (root / folder).rglob("*") if _counts(file.relative_to(root))]
    named = {found for file in own if file.suffix == ".py" for found in _imported(root, file)}
    shown = {file.relative_to(root).as_posix() for file in named}
    return sorted({file.relative_to(root).as_posix() for file in own} | {one for one in shown if one.startswith(SHOWN)})


def _counts(file: Path) -> bool:
    hidden = any(part.startswith((".", "__pycache__")) for part in file.parts)
    return "." in file.name and not hidden and file != LAST_GREEN


def _imported(root: Path, file: Path) -> Iterator[Path]:
    for module, name, _ in _imports(file):
        if (found := _home(root, module, name) if name else _module(root, module)) is not None:
            yield found


def _home(root: Path, module: str, name: str) -> Path | None:
    """Return the file that defines a name: a package's door names it with its module."""
    file = _module(root, module)
    if (inside := _module(root, f"{module}.{name}")) is not None or file is None or file.name != "__init__.py":
        return inside or file
    inner = next(((whence, own) for whence, own, called in _imports(file) if called == name and own), None)
    return file if inner is None else _home(root, *inner)


@cache
def _imports(file: Path) -> list[tuple[str, str, str]]:
    """Return (module, name in it, name here) of each import of a file; of a whole module without names."""
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(one.name, "", "") for one in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found += [(node.module, one.name, one.asname or one.name) for one in node.names]
    return found


def _module(root: Path, name: str) -> Path | None:
    for folder in IMPORTED_FROM:
        bare = root.joinpath(folder, *name.split("."))
        for file in (bare.with_suffix(".py"), bare / "__init__.py"):
            if file.is_file():
                return file
    return None


def _version_of_framework(root: Path) -> str:
    found = re.search(rf'^name = "{FRAMEWORK}"\nversion = "(.+)"$', (root / "uv.lock").read_text("utf-8"), re.MULTILINE)
    if found is None:
        sys.exit(f"uv.lock has no version of {FRAMEWORK}")
    return found[1]


def main(arguments: list[str]) -> int:
    now, file = state(), ROOT / LAST_GREEN
    if arguments == ["--green"]:
        file.write_text(f"{now}\n", encoding="utf-8", newline="\n")
        sys.stdout.write(f"The page's tests are green; commit {LAST_GREEN}, if it has changed\n")
        return 0
    if file.is_file() and file.read_text(encoding="utf-8").strip() == now:
        sys.stdout.write("Neither the page nor what it shows has changed since its tests were last green\n")
        return 0
    sys.stdout.write(f"The page, or what it shows, has changed since its tests were last green ({LAST_GREEN})\n")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
