"""Template packages, which are checked and tested as they are; `afspm new` copies them under another name."""

from __future__ import annotations

import re
from pathlib import Path

from afspm.basics import ConfigError, FileError

_NAMES = {
    "driver": ("my_scope", "MyScope"),
    "component": ("my_component", "MyComponent"),
    "experiment": ("my_experiment", "MyExperiment"),
}
"""Module and class of each kind, which are renamed in the copy."""
_SKIPPED = {"__pycache__", "__init__.pyc"}


def write(kind: str, name: str, into: Path) -> Path:
    """Write a skeleton.

    Args:
        kind: "driver", "component" or "experiment".
        name: name of its folder; "my-scope" becomes my_scope, with the class MyScope.

    Returns:
        the new folder in `into`.

    Raises:
        ConfigError: the name is invalid.
        FileError: the folder exists, or can't be written.
    """
    module = re.sub(r"[\s-]+", "_", name.strip()).lower()
    if not module.isidentifier() or module in ("afspm", "tests"):
        raise ConfigError(f"{name!r} can't be the name of a package", hint="letters, digits and _, e.g. my_scope")
    class_name = "".join(part[:1].upper() + part[1:] for part in module.split("_"))
    target = into / module
    source = Path(__file__).with_name(kind)
    own_module, own_class = _NAMES[kind]
    try:
        target.mkdir(parents=True)
        for file in sorted(source.rglob("*")):
            if file.is_file() and _SKIPPED.isdisjoint(file.parts):
                written = target / str(file.relative_to(source)).replace(own_module, module)
                written.parent.mkdir(parents=True, exist_ok=True)
                text = file.read_text(encoding="utf-8")
                written.write_text(text.replace(own_module, module).replace(own_class, class_name), encoding="utf-8")
    except FileExistsError:
        raise FileError("this folder already exists", where=str(target), hint="choose another name") from None
    except OSError as error:
        raise FileError(f"can't be written: {error.strerror or error}", where=str(target)) from error
    return target
