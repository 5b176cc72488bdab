"""Where the files of Asylum's computer are seen from here. Pure."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path, PureWindowsPath

from afspm.errors import ConfigError


def local(igor_path: str, folders: Mapping[str, str]) -> Path:
    """A path of Igor's, "C:Users:Me:Data:", here.

    Args:
        folders: beginnings of such paths, and where those are from here; the longest that fits counts.

    Raises:
        ConfigError: it is on another computer, and nothing says where to see it from here.
    """
    parts = _parts(igor_path)
    fitting = [(start, here) for start, here in folders.items() if _begins(parts, _parts(start))]
    if fitting:
        start, here = max(fitting, key=lambda one: len(_parts(one[0])))
        return Path(here, *parts[len(_parts(start)) :])
    if igor_path.startswith(":"):  # a computer without drives
        return Path("/", *parts)
    if sys.platform != "win32" or len(parts[0]) != 1:
        hint = f'folders = {{ "{igor_path}" = "/where/it/is/mounted" }}'
        raise ConfigError(f"Asylum saves to {igor_path!r}, which is not on this computer", where="folders", hint=hint)
    return Path(str(PureWindowsPath(f"{parts[0]}:/", *parts[1:])))


def _begins(parts: list[str], start: list[str]) -> bool:
    """Windows does not tell upper from lower case."""
    return [part.casefold() for part in parts[: len(start)]] == [part.casefold() for part in start]


def _parts(igor_path: str) -> list[str]:
    """Also of a path as Windows writes it."""
    return [part for part in igor_path.replace("\\", ":").split(":") if part]
