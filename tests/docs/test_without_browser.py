"""`make check` passes where `make dev` found no browser, and left out the package that drives one."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path


def test_types_are_checked_without_the_packages_of_the_browser() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    overrides = project["tool"]["mypy"]["overrides"]
    may_be_missing = {name for one in overrides if one.get("ignore_missing_imports") for name in one["module"]}
    for requirement in project["dependency-groups"]["browser"]:
        assert f"{re.split('[<>=]', requirement)[0]}.*" in may_be_missing
